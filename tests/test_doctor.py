"""Processes report who they see and where they listen: ``doctor`` compares that with the
configuration, and ``drive`` begins no run that no controller would drive."""

import shutil
import socket
from pathlib import Path
from typing import Any, Final

import pytest

from bayesrace.errors import InputError
from bayesrace.operation.certificates import add, init
from bayesrace.transport import Credentials, Director, Endpoints, free_endpoint, open_session
from bayesrace.transport.endpoints import unreachable
from tests.command_line import Cli, refused
from tests.fake_processes import Fakes, fakes
from tests.native_programs import PROGRAMS, STRICT, gcc
from tests.network.cars import Course, Program, gentle_course, start_controller, start_plant
from tests.programs import PATIENCE_S, until
from tests.security.authority import Bundles, written

__all__ = ["fakes"]

CAR: Final = "orca"
TOGETHER: Final = f"ok     car '{CAR}': controller and plant"


def configured(folder: Path, plant: str, *controllers: str) -> tuple[str, Path]:
    """Option that names a file with these endpoints."""
    path = folder / "bayesrace.toml"
    path.write_text(f'[network]\nplant = ["{plant}"]\ncontroller = {list(controllers)}\n')
    return "--config", path


def faults(cli: Cli, *options: str | Path) -> str:
    """What the doctor finds wrong."""
    found = cli("doctor", *options)
    wrong = [line[7:] for line in found.out.splitlines() if line.startswith("FAULT")]
    assert found.code == bool(wrong)
    return "\n".join(wrong)


# Links -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def course(tmp_path_factory: pytest.TempPathFactory) -> Course:
    return gentle_course(tmp_path_factory.mktemp("course"))


@pytest.mark.wall_clock
def test_plant_and_controller_that_do_not_see_each_other_are_named_and_not_driven(
    cli: Cli, tmp_path: Path, course: Course
) -> None:
    """The controller has another endpoint of the plant; who looks on reaches both."""
    plant_at, controller_at, elsewhere = (free_endpoint() for _ in range(3))
    config, log = configured(tmp_path, plant_at, controller_at), tmp_path / "run.mcap"
    with (
        start_plant(tmp_path, plant_at) as plant,
        start_controller(tmp_path, course, elsewhere, controller_at) as controller,
    ):
        until(lambda: f"plant at {elsewhere}" in controller.said(), "the controller")
        until(lambda: plant_at in plant.said(), "the plant")
        found = faults(cli, *config)
        track = ("--track", course.track_file, "--mode", "realtime", "--log", log)
        driven = cli("drive", *track, *config)
        with open_session(Endpoints(connect=(plant_at,))) as session:
            director = Director(session, CAR)
            director.wait_for(("plant",), PATIENCE_S)
            status = director.status("plant")
    words = (
        "the plant does not see the controller, the controller does not see the plant",
        f"the controller connects to {elsewhere}, the plant listens at {plant_at}",
        "--endpoint",
    )
    assert all(word in found for word in words), found
    refused(driven, *words)
    assert (status.run, status.phase, dict(status.seen)) == (0, "idle", {})


def test_a_second_controller_is_named_wherever_it_listens(
    cli: Cli, tmp_path: Path, fakes: Fakes
) -> None:
    plant = fakes(CAR, "plant")
    (plant_at,) = plant.endpoints.listen
    ends = [free_endpoint(), free_endpoint()]
    for end in ends:
        fakes(CAR, "controller", endpoints=Endpoints(listen=(end,), connect=(plant_at,)))
    found = faults(cli, *configured(tmp_path, plant_at, ends[0]))
    assert "the plant sees another controller (tcp/127.0.0.1:" in found
    assert f"beside that at {ends[0]}: end all but one" in found
    found = faults(cli, *configured(tmp_path, plant_at, *ends))
    assert all(f"beside that at {end}: end all but one" in found for end in ends)
    where = Endpoints(connect=(plant_at, ends[0]))
    with open_session(where) as session, pytest.raises(InputError, match="sees another controller"):
        Director(session, CAR).wait_for(("plant", "controller"), 2.0)


def test_processes_that_listen_at_each_others_endpoint_are_named(
    cli: Cli, tmp_path: Path, fakes: Fakes
) -> None:
    (plant_at,) = fakes(CAR, "plant").endpoints.listen
    controller_at = free_endpoint()
    where = Endpoints(listen=(controller_at,), connect=(plant_at,))
    fakes(CAR, "controller", endpoints=where)
    right = cli("doctor", *configured(tmp_path, plant_at, controller_at))
    assert (right.code, TOGETHER in right.out) == (0, True), right.out
    found = faults(cli, *configured(tmp_path, controller_at, plant_at))
    words = "which the configuration has for the other of the two: exchange"
    assert f"the controller of car 'orca' listens at {controller_at}, {words}" in found
    assert f"the plant of car 'orca' listens at {plant_at}, {words}" in found


def test_a_process_that_does_not_answer_is_named(cli: Cli, tmp_path: Path, fakes: Fakes) -> None:
    (plant_at,) = fakes(CAR, "plant", mute=True).endpoints.listen
    found = faults(cli, *configured(tmp_path, plant_at, free_endpoint()))
    assert "the plant of car 'orca' does not answer within 1 s" in found


# Names -------------------------------------------------------------------------------------------


def test_a_name_that_means_loopback_on_its_own_machine_is_named(
    cli: Cli, tmp_path: Path, fakes: Fakes, monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    """As Debian's /etc/hosts has it: what listens there is reached from nowhere else."""
    port = free_endpoint().rpartition(":")[2]
    named = f"tcp/LOCALHOST:{port}"  # a name that every machine resolves so
    fakes(CAR, "plant", endpoints=Endpoints(listen=(named,), insecure=True))
    words = (f"{named}: 'LOCALHOST' is 127.0.0.1", f"tcp/0.0.0.0:{port}", "/etc/hosts")
    assert all(word in caplog.text for word in words), caplog.text
    found = faults(cli, *configured(tmp_path, f"tcp/127.0.0.1:{port}", free_endpoint()))
    assert all(word in found for word in words), found

    def resolve(host: str, port: int, *_: Any, **__: Any) -> list[Any]:
        numeric = {"car.example": "127.0.1.1", "other.example": "192.0.2.7"}.get(host, host)
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (numeric, port))]

    monkeypatch.setattr(socket, "getaddrinfo", resolve)
    assert "'car.example' is 127.0.1.1" in unreachable("tls/car.example:1")
    for fine in ("tls/other.example:1", "tls/0.0.0.0:1", "tls/localhost:1", "tls/127.0.1.1:1"):
        assert unreachable(fine) == ""


# Certificates and clocks -------------------------------------------------------------------------


def test_what_is_missing_of_the_certificates_is_named(cli: Cli, tmp_path: Path) -> None:
    folder = tmp_path / "certs"
    init(folder)
    for role in ("plant", "viewer"):
        add(folder, role, role)
    where = free_endpoint("tls")
    config = ("--config", written(tmp_path, Bundles(folder), where, free_endpoint("tls")))
    assert f"no director's certificate in {folder}" in faults(cli, *config)
    shutil.move(folder / "authority", tmp_path)  # another machine makes them
    assert "director's" not in faults(cli, *config)
    assert "ok     no director's certificate" in cli("doctor", *config).out
    (folder / "plant" / "members.json").unlink()
    assert f"{folder / 'plant' / 'members.json'}" in faults(cli, *config)
    refused(cli("config", "check", *config), f"{folder / 'plant' / 'members.json'}")


def test_a_clock_far_from_this_one_is_named(cli: Cli, tmp_path: Path, fakes: Fakes) -> None:
    (plant_at,) = fakes(CAR, "plant", clock_s=400 * 86400.0).endpoints.listen
    found = faults(cli, *configured(tmp_path, plant_at, free_endpoint()))
    assert "the clock of the plant's machine says 20" in found
    assert "set the wrong one" in found


def test_a_certificate_beyond_its_time_is_said_with_both_times(tmp_path: Path) -> None:
    init(tmp_path)
    folder = add(tmp_path, "late", "plant", days=-35)
    words = r"has expired: it counts from 20.* to 20.*, and the clock .* says 20.*: set the clock"
    with pytest.raises(InputError, match=words):
        Credentials.read(folder)


@pytest.mark.check
@pytest.mark.parametrize(
    ("where", "words"),
    [
        (
            "plant",
            "refuses certificate 'director' as expired or not valid yet, and by the clock here",
        ),
        ("doctor", "has a certificate that has expired: renew it there"),
    ],
)
def test_a_clock_400_days_ahead_is_named_as_a_clock(tmp_path: Path, where: str, words: str) -> None:
    """Where the certificate of that very machine lasts longer; otherwise the process waits."""
    library = tmp_path / "ahead.so"
    gcc(*STRICT, "-shared", "-fPIC", "-o", library, PROGRAMS / "clock_ahead.c")
    ahead = ("env", f"LD_PRELOAD={library}", f"CLOCK_AHEAD_S={400 * 86400}")
    prefix = {"plant": (), "doctor": (), where: ahead}
    folder, plant_at = tmp_path / "certs", free_endpoint("tls")
    init(folder)
    add(folder, "plant", "plant", days=1000 if where == "plant" else 365)
    add(folder, "director", "director", days=1000 if where == "doctor" else 365)
    # each machine has its own alone
    for name in ("plant", "director"):
        shutil.copytree(folder / name, tmp_path / f"of-{name}" / name)
    written(tmp_path, Bundles(tmp_path / "of-plant"), plant_at, free_endpoint("tls"))
    of_plant = (tmp_path / "bayesrace.toml").rename(tmp_path / "plant.toml")
    mine = written(tmp_path, Bundles(tmp_path / "of-director"), plant_at, free_endpoint("tls"))
    said = tmp_path / "plant.txt"
    with Program(said, "plant", "--config", of_plant, prefix=prefix["plant"]) as plant:
        until(lambda: "plant of car" in plant.said(), "the plant")
        out = tmp_path / "doctor.txt"
        with Program(out, "doctor", "--config", mine, prefix=prefix["doctor"]) as doctor:
            assert doctor.process.wait(PATIENCE_S) == 1
        (line,) = (line for line in doctor.said().splitlines() if plant_at in line)
    assert f"{plant_at} {words}" in line
    assert "set the clock" in line
