"""Why there is no link is said by every process, and ends those that waiting cannot help."""

import json
import re
import shutil
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import pytest

from bayesrace.errors import InputError
from bayesrace.gp.weights import write_weights, zero_weights
from bayesrace.messages import Role
from bayesrace.raceline.line import write_raceline
from bayesrace.tracks import write_track
from bayesrace.transport import Credentials, Endpoints, free_endpoint, open_session
from bayesrace.transport.probe import probe
from operation.certificates import add, init
from tests.command_line import Cli, refused
from tests.conftest import Circuit
from tests.programs import finish, start, until
from tests.security.authority import CAR, Bundles, bundles, written
from tests.security.intruder import listening

__all__ = ["bundles"]

pytestmark = pytest.mark.wall_clock

ABSENT: Final = "nobody listens at"
FOREIGN: Final = "of another authority"
NAME: Final = "certificate for other hosts"


def why_not(endpoints: Endpoints, role: Role) -> str:
    """What a process says that ends at its start."""
    with pytest.raises(InputError) as error, open_session(endpoints, role):
        pass
    return str(error.value)


# In a session ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("at_plant", "at_controller", "words"),
    [
        ("foreign-plant", "controller", FOREIGN),
        ("plant", "foreign-controller", FOREIGN),
        ("expired", "controller", "has a certificate that has expired: renew it there"),
    ],
)
def test_a_refused_certificate_is_said_at_either_end(
    bundles: Bundles, at_plant: str, at_controller: str, words: str
) -> None:
    where = free_endpoint("tls")
    with ExitStack() as stack:
        if at_plant == "plant":
            ends = bundles.endpoints(at_plant, listen=(where,))
            stack.enter_context(open_session(ends, "plant"))
        else:
            stack.enter_context(listening(where, bundles.path(at_plant)))
        said = why_not(bundles.endpoints(at_controller, connect=(where,)), "controller")
    assert words in said
    assert where in said
    assert "bayesrace certs" in said


def test_a_certificate_that_is_gone_meanwhile_is_said(bundles: Bundles, tmp_path: Path) -> None:
    where = free_endpoint("tls")
    shutil.copytree(bundles.path("controller"), tmp_path / "own")
    credentials = Credentials.read(tmp_path / "own")
    shutil.rmtree(tmp_path / "own")
    with listening(where, bundles.path("plant")):
        found = probe(where, credentials)
    assert found is not None
    assert re.search("'controller' in .*/own cannot be read .*: copy the folder again", found.text)


def test_another_host_name_is_said(bundles: Bundles) -> None:
    where = free_endpoint("tls").replace("127.0.0.1", "127.0.0.2")
    with open_session(bundles.endpoints("plant", listen=(where,)), "plant"):
        said = why_not(bundles.endpoints("controller", connect=(where,)), "controller")
    assert NAME in said
    assert "--renew --host 127.0.0.2" in said


def test_encryption_at_one_end_only_is_said(bundles: Bundles) -> None:
    where = free_endpoint("tls")
    plain = where.replace("tls/", "tcp/")
    with listening(plain, None):
        said = why_not(bundles.endpoints("controller", connect=(where,)), "controller")
    assert "is not encrypted" in said
    with (
        open_session(bundles.endpoints("plant", listen=(where,)), "plant"),
        pytest.raises(InputError, match=f"{plain} asks for a certificate") as error,
        open_session(Endpoints(connect=(plain,)), "controller"),
    ):
        time.sleep(10.0)  # the watch interrupts it
    assert where not in str(error.value)


def test_who_is_absent_is_said_once_and_waited_for(
    bundles: Bundles, caplog: pytest.LogCaptureFixture
) -> None:
    """And what waiting does not help, as soon as it is there."""
    where = free_endpoint("tls")
    with open_session(bundles.endpoints("controller", connect=(where,)), "controller") as session:
        until(lambda: ABSENT in caplog.text, "who is absent", 10.0)
        with listening(where, bundles.path("foreign-plant")):
            until(lambda: FOREIGN in caplog.text, "why there is no link", 10.0)
        with open_session(bundles.endpoints("plant", listen=(where,)), "plant"):
            until(lambda: session.info.links(), "the link", 10.0)
    assert caplog.text.count(FOREIGN) == 1
    assert caplog.text.count(ABSENT) <= 2


# Every process -----------------------------------------------------------------------------------

COMMANDS: Final = (
    ("controller", "controller"), ("status", "viewer"), ("stop", "director"), ("go", "director"),
    ("rollback", "learning"), ("publish", "learning"), ("learn", "learning"),
    ("drive", "director"), ("latency", "director"), ("plant", "plant"), ("router", "router"),
)  # fmt: skip
LISTENING: Final = ("plant", "router")


@pytest.fixture
def arguments(
    cli: Cli, circuit: Circuit, kinematic_artefact: Path, tmp_path: Path
) -> dict[str, tuple[str | Path, ...]]:
    """What each command needs besides."""
    track, line, weights = (tmp_path / name for name in ("t.csv", "l.csv", "w.bin"))
    write_track(track, circuit.track)
    write_raceline(line, circuit.line)
    write_weights(weights, zero_weights("orca", "any"))
    drives = ("--artefact", kinematic_artefact, "--track", track, "--raceline", line)
    return {
        "controller": drives,
        "publish": (weights,),
        "latency": ("--attach",),
        "router": ("--listen", free_endpoint("tls")),
    }


@pytest.mark.parametrize(("command", "role"), COMMANDS)
def test_every_command_that_cannot_work_says_why_and_ends(
    cli: Cli, bundles: Bundles, tmp_path: Path, command: str, role: str,
    arguments: dict[str, tuple[str | Path, ...]],
) -> None:  # fmt: skip
    """A certificate for another role; an expired one; another authority at the other end."""
    where, others = free_endpoint("tls"), arguments.get(command, ())
    other = "viewer" if role == "plant" else "plant"
    config = written(tmp_path, bundles, where, where, **{role: other})
    refused(cli(command, *others, "--config", config), f"for the role {other}", f"--role {role}")
    expired = tmp_path / "certs" / role
    shutil.copytree(bundles.path("expired"), expired)
    config = written(tmp_path, Bundles(tmp_path / "certs"), where, where)
    refused(cli(command, *others, "--config", config), "has expired", "--renew")
    if command in LISTENING:  # and connect to nobody
        return
    with listening(where, bundles.path("foreign-plant")):
        config = written(tmp_path, bundles, where, where)
        refused(cli(command, *others, "--config", config), FOREIGN, "bayesrace certs init")


@pytest.mark.parametrize("command", ["plant", "controller", "drive", "learn"])
def test_a_certificate_for_another_car_is_refused(
    cli: Cli, bundles: Bundles, tmp_path: Path, command: str,
    arguments: dict[str, tuple[str | Path, ...]],
) -> None:  # fmt: skip
    where = free_endpoint("tls")
    names = {"drive": "director", "learn": "learning"}
    if command in names:  # the certificates made for all tests are for every car
        folder = tmp_path / "certs"
        init(folder)
        add(folder, names[command], names[command], "blue")  # type: ignore[arg-type]
        config = written(tmp_path, Bundles(folder), where, where)
    else:
        config = written(tmp_path, bundles, where, where, **{command: f"blue-{command}"})
    outcome = cli(command, *arguments.get(command, ()), "--config", config)
    refused(outcome, "is for car 'blue', not for 'orca'", "--name blue")


def test_a_controller_without_a_plant_says_so_and_waits(
    bundles: Bundles, tmp_path: Path, arguments: dict[str, tuple[str | Path, ...]]
) -> None:
    plant_at, here = free_endpoint("tls"), free_endpoint("tls")
    config = written(tmp_path, bundles, plant_at, here)
    process = start("controller", *arguments["controller"], "--config", config)
    assert process.stderr is not None
    lines = [process.stderr.readline() for _ in range(3)]
    assert process.poll() is None
    process.kill()
    finish(process)
    assert re.search(f"{ABSENT} {plant_at}", "".join(lines))


# doctor ------------------------------------------------------------------------------------------


def test_doctor_tries_everything(cli: Cli, bundles: Bundles, tmp_path: Path) -> None:
    plant_at, controller_at = free_endpoint("tls"), free_endpoint("tls")
    config = written(tmp_path, bundles, plant_at, controller_at)
    with open_session(bundles.endpoints("plant", listen=(plant_at,)), "plant") as session:
        token = session.liveliness().declare_token(f"bayesrace/{CAR}/alive/plant")
        found = cli("doctor", "--config", config)
        token.undeclare()
    assert found.code == 1
    lines = found.out.splitlines()
    assert f"ok     {plant_at} answers" in lines
    assert any(line.startswith(f"FAULT  {ABSENT} {controller_at}") for line in lines)
    assert any(line.startswith(f"FAULT  car '{CAR}': plant; no controller") for line in lines)
    assert any("certificate 'one-viewer': viewer, car 'orca'" in line for line in lines)


def test_doctor_says_what_else_may_be_wrong(cli: Cli, bundles: Bundles, tmp_path: Path) -> None:
    where = free_endpoint("tls")
    config = written(tmp_path, bundles, where, where)
    with listening(where, bundles.path("foreign-plant")):
        found = cli("doctor", "--config", config)
    assert found.code == 1
    assert f"FAULT  {where} has a certificate {FOREIGN}" in found.out
    beyond = tmp_path / "beyond.toml"
    beyond.write_text("[network]\nplant = ['tcp/10.0.0.1:1']\n")
    assert "could drive the car" in cli("doctor", "--config", beyond).out
    shutil.copytree(bundles.path("revoked"), tmp_path / "certs" / "controller")
    (tmp_path / "certs" / "controller" / "key.pem").chmod(0o640)
    config = written(tmp_path, Bundles(tmp_path / "certs"), where, where)
    assert "FAULT  others can read the private key" in cli("doctor", "--config", config).out


def test_an_older_list_of_members_is_said_by_commands_and_doctor(
    cli: Cli, bundles: Bundles, tmp_path: Path
) -> None:
    """A plant that does not have this machine's certificate in its list drops every message."""
    folder = tmp_path / "plant"
    shutil.copytree(bundles.path("plant"), folder)
    content = json.loads((folder / "members.json").read_text())
    for name in ("director", "viewer"):
        del content["members"][name]
    (folder / "members.json").write_text(json.dumps(content))
    where = free_endpoint("tls")
    config = written(tmp_path, bundles, where, where)
    older = Endpoints(listen=(where,), credentials=Credentials.read(folder))
    with open_session(older, "plant") as session:
        token = session.liveliness().declare_token(f"bayesrace/{CAR}/alive/plant")
        commanded = cli("status", "--timeout", "0.5", "--config", config)
        examined = cli("doctor", "--config", config)
        token.undeclare()
    words = (f"linked to {where}", "no car is visible", "newest members.json", "start it again")
    refused(commanded, *words)
    assert examined.code == 1
    assert all(word in examined.out for word in words)
