"""Without a link every process names the endpoint, and ``doctor`` says why there is none."""

import shutil
from pathlib import Path
from typing import Final

import pytest

from bayesrace.gp.weights import write_weights, zero_weights
from bayesrace.operation.certificates import add, init
from bayesrace.operation.doctor import probe
from bayesrace.raceline.line import write_raceline
from bayesrace.tracks import write_track
from bayesrace.transport import Credentials, Endpoints, free_endpoint, open_session
from tests.command_line import Cli, refused
from tests.conftest import Circuit
from tests.programs import until
from tests.security.authority import CAR, Bundles, bundles, written
from tests.security.intruder import listening

__all__ = ["bundles"]

pytestmark = pytest.mark.wall_clock

ABSENT: Final = "nothing listens at"
FOREIGN: Final = "of another authority"
NO_LINK: Final = "no link to {} yet"


# What 'bayesrace doctor' finds at an endpoint ----------------------------------------------------


@pytest.mark.parametrize(
    ("at_plant", "at_controller", "words"),
    [
        ("foreign-plant", "controller", (FOREIGN, "bayesrace certs init")),
        ("plant", "foreign-controller", (FOREIGN, "bayesrace certs init")),
        ("expired", "controller", ("has a certificate that has expired: renew it there",)),
        ("", "controller", ("is not encrypted",)),
        ("plant", "", ("asks for a certificate", "[tls]")),
        ("plant", "controller", ()),
    ],
)
def test_what_is_wrong_with_an_endpoint_is_found(
    bundles: Bundles, at_plant: str, at_controller: str, words: tuple[str, ...]
) -> None:
    """A certificate that one of the ends refuses; encryption at one end only; nothing at all."""
    where = free_endpoint("tls")
    listened = where if at_plant else where.replace("tls/", "tcp/")
    tried = where if at_controller else where.replace("tls/", "tcp/")
    credentials = bundles.credentials(at_controller) if at_controller else None
    with listening(listened, bundles.path(at_plant) if at_plant else None):
        found = probe(tried, credentials)
    assert all(word in found for word in (tried, *words)) if words else found == ""


def test_another_host_name_is_found(bundles: Bundles) -> None:
    where = free_endpoint("tls").replace("127.0.0.1", "127.0.0.2")
    with listening(where, bundles.path("plant")):
        found = probe(where, bundles.credentials("controller"))
    assert "has a certificate for other hosts" in found
    assert "--renew --host 127.0.0.2" in found


# In a session ------------------------------------------------------------------------------------


def test_a_session_without_a_link_names_the_endpoint_and_waits(
    bundles: Bundles, caplog: pytest.LogCaptureFixture
) -> None:
    """In one line, whatever is wrong; it is linked once that is mended."""
    where = free_endpoint("tls")
    endpoints = bundles.endpoints("controller", connect=(where,))
    with (
        listening(where, bundles.path("foreign-plant")),
        open_session(endpoints, "controller") as session,
    ):
        assert NO_LINK.format(where) in caplog.text
        assert not session.info.links()
    with (
        open_session(endpoints, "controller") as session,
        open_session(bundles.endpoints("plant", listen=(where,)), "plant"),
    ):
        until(session.info.links, "the link", 10.0)
    assert caplog.text.count(NO_LINK.format(where)) == 2
    assert caplog.text.count("'bayesrace doctor'") == 2


# Every process -----------------------------------------------------------------------------------

COMMANDS: Final = (
    ("controller", "controller"), ("status", "viewer"), ("stop", "director"), ("go", "director"),
    ("rollback", "learning"), ("publish", "learning"), ("learn", "learning"),
    ("drive", "director"), ("latency", "director"), ("plant", "plant"), ("router", "router"),
)  # fmt: skip
COMMANDING: Final = ("status", "stop", "go", "rollback", "publish")
WAITING: Final = ("plant", "controller", "router")
"""For a valid certificate, too (:mod:`tests.test_waiting`)."""


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
    arguments: dict[str, tuple[str | Path, ...]], caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    """A certificate for another role; an expired one; for commands, no link in time."""
    where, others = free_endpoint("tls"), arguments.get(command, ())
    other = "viewer" if role == "plant" else "plant"
    config = written(tmp_path, bundles, where, where, **{role: other})
    refused(cli(command, *others, "--config", config), f"for the role {other}", f"--role {role}")
    if command not in WAITING:
        expired = tmp_path / "certs" / role
        shutil.copytree(bundles.path("expired"), expired)
        config = written(tmp_path, Bundles(tmp_path / "certs"), where, where)
        refused(cli(command, *others, "--config", config), "has expired", "--renew")
    if command in COMMANDING:
        with listening(where, bundles.path("foreign-plant")):
            config = written(tmp_path, bundles, where, where)
            outcome = cli(command, *others, "--timeout", "0.5", "--config", config)
        refused(outcome, f"no connection to {where}", "bayesrace doctor")
        assert NO_LINK.format(where) not in caplog.text  # said once


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


# doctor ------------------------------------------------------------------------------------------


def test_doctor_tries_everything(cli: Cli, bundles: Bundles, tmp_path: Path) -> None:
    plant_at, controller_at = free_endpoint("tls"), free_endpoint("tls")
    config = written(tmp_path, bundles, plant_at, controller_at)
    with open_session(bundles.endpoints("plant", listen=(plant_at,)), "plant") as session:
        token = session.liveliness().declare_token(f"bayesrace/{CAR}/alive/plant/1")
        found = cli("doctor", "--config", config)
        token.undeclare()
    assert found.code == 1
    lines = found.out.splitlines()
    assert f"ok     {plant_at} answers" in lines
    assert any(line.startswith(f"FAULT  {ABSENT} {controller_at}") for line in lines)
    assert any(line.startswith(f"FAULT  car '{CAR}': plant; no controller") for line in lines)
    assert any("certificate 'one-viewer': viewer, car 'orca'" in line for line in lines)


def test_doctor_says_what_else_may_be_wrong(cli: Cli, bundles: Bundles, tmp_path: Path) -> None:
    where, beyond = free_endpoint("tls"), tmp_path / "beyond.toml"
    beyond.write_text("[network]\nplant = ['tcp/10.0.0.1:1']\n")
    assert "could drive the car" in cli("doctor", "--config", beyond).out
    shutil.copytree(bundles.path("revoked"), tmp_path / "certs" / "controller")
    (tmp_path / "certs" / "controller" / "key.pem").chmod(0o640)
    config = written(tmp_path, Bundles(tmp_path / "certs"), where, where)
    assert "FAULT  others can read the private key" in cli("doctor", "--config", config).out


def test_an_older_list_of_members_is_said_by_commands_and_doctor(cli: Cli, tmp_path: Path) -> None:
    """A plant that does not have this machine's certificate in its list closes every link."""
    certs, folder = tmp_path / "certs", tmp_path / "plant"
    init(certs)
    shutil.copytree(add(certs, "plant", "plant", CAR), folder)
    for name in ("director", "viewer"):
        add(certs, name, name)
    where = free_endpoint("tls")
    config = written(tmp_path, Bundles(certs), where, where)
    older = Endpoints(listen=(where,), credentials=Credentials.read(folder))
    with open_session(older, "plant") as session:
        token = session.liveliness().declare_token(f"bayesrace/{CAR}/alive/plant/1")
        commanded = cli("status", "--timeout", "0.5", "--config", config)
        examined = cli("doctor", "--config", config)
        token.undeclare()
    words = ("newest members.json",)
    refused(commanded, *words)
    assert examined.code == 1
    assert all(word in examined.out for word in words)
