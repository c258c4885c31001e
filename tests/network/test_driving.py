"""Plant and controller with a bad link between them: slow down, stop, go on.

The messages of control travel by TCP, as everything does by default: what the link loses arrives
late and holds up what comes after it, so an actuation can be 0.1 s late, and Zenoh's qualities of
service change nothing about it. By UDP a loss is a loss and nothing waits; but Zenoh sends its own
declarations over it once as well, so a connection that is made over a bad link may be deaf. That
is why the drive by UDP begins on a good one.
"""

import os
import shutil
import socket
import stat
import subprocess
import textwrap
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import pytest

from bayesrace.configuration import read_configuration
from bayesrace.files import temporary_folder
from bayesrace.log import LogReader
from bayesrace.messages import STATE
from bayesrace.transport import free_endpoint
from bayesrace.transport.relay import Relay
from tests.network.cars import Course, Program, gentle_course, start_controller, start_plant
from tests.network.observer import STANDING_MPS, Journey, Observer, drive_on, observing
from tests.programs import PATIENCE_S, ROOT, run, until

pytestmark = pytest.mark.wall_clock

BAD: Final = {"delay_s": 0.02, "jitter_s": 0.005, "loss": 0.05}


@dataclass
class Rig:
    """A car on its way over a link."""

    link: Relay
    course: Course
    plant: Program
    controller: Program
    observer: Observer
    log: Path
    _cleanup: ExitStack

    def drive_on(self) -> None:
        """Waits until the car has got a good deal further."""
        drive_on(self.observer)

    def partition(self, seconds: float, direction: str = "") -> tuple[int, int, dict[str, Any]]:
        """Holds the link for a while: when it began and ended [ns], and the last state in it."""
        self.link.hold(direction)
        begin_ns = time.monotonic_ns()
        time.sleep(seconds)
        last = self.observer.state()
        end_ns = time.monotonic_ns()
        self.link.release()
        return begin_ns, end_ns, last

    def finish(self) -> tuple[Journey, dict[str, int], dict[str, int]]:
        """Ends everything in order: the log, and the counters of plant and controller."""
        self.observer.stop()
        until(lambda: self.observer.status("controller").get("phase") == "waiting", "a quiet end")
        plant, controller = (
            self.observer.status(source)["counters"] for source in ("plant", "controller")
        )
        self.controller.end()
        self.plant.end()
        self._cleanup.close()
        return Journey(self.log, self.course.track), plant, controller


@pytest.fixture(scope="module", params=["Python", "C"])
def course(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Course:
    return gentle_course(tmp_path_factory.mktemp("course"), language=request.param)


@contextmanager
def driving(
    folder: Path, course: Course, conditions: Mapping[str, float], protocol: str = "tcp"
) -> Iterator[Rig]:
    """A plant, a controller that connects to it over a link, and a run without end."""
    plant_at, controller_at = (free_endpoint().replace("tcp", protocol) for _ in range(2))
    log = folder / "run.mcap"
    with ExitStack() as cleanup:
        link = cleanup.enter_context(Relay(plant_at))
        link.set(**conditions)
        plant = cleanup.enter_context(start_plant(folder, plant_at))
        driver = start_controller(folder, course, link.endpoint, controller_at)
        controller = cleanup.enter_context(driver)
        following = cleanup.enter_context(ExitStack())
        observed = observing((plant_at, controller_at), "orca", course.track, log)
        observer = following.enter_context(observed)
        observer.start(1)
        yield Rig(link, course, plant, controller, observer, log, following)


def assert_nothing_was_broken(plant: dict[str, int], controller: dict[str, int]) -> None:
    """Late and lost is one thing; refused, raised or rejected would be another."""
    for name in ("refused", "overflowed", "rejected"):
        assert plant[name] == 0, (name, plant)
    for name in ("refused", "raised"):
        assert controller[name] == controller.get("states_stale", 0) == 0, (name, controller)


def assert_all_is_accounted_for(plant: dict[str, int], controller: dict[str, int]) -> None:
    """Sent is received or counted as lost, but for what is sent around the end of the run: the
    plant no longer listens, and the controller falls silent a second later."""
    missing = plant["states_sent"] - controller["states_received"] - controller["states_lost"]
    assert 0 <= missing < 100, (plant, controller)
    missing = (
        controller["actuations_sent"] - plant["actuations_received"] - plant["actuations_lost"]
    )
    assert 0 <= missing < 100, (plant, controller)


def test_a_car_stops_in_a_partition_and_goes_on(tmp_path: Path, course: Course) -> None:
    """20 ms delay, 5 ms jitter, 5 % loss, from before the connection on; 2 s of nothing."""
    with driving(tmp_path, course, BAD) as rig:
        rig.drive_on()
        begin_ns, end_ns, last = rig.partition(2.0)
        rig.drive_on()
        journey, plant, controller = rig.finish()
    assert journey.off_track_m() < 0.0
    cut = journey.between(begin_ns, end_ns)
    assert cut[0].x[3] > 0.3
    assert abs(last["x"][3]) < STANDING_MPS
    assert abs(cut[-1].x[3]) < STANDING_MPS
    # what was on its way arrives, nothing else: the plant alone has stopped the car
    assert plant["planned"] + plant["braked"] > 0
    assert_nothing_was_broken(plant, controller)
    assert_all_is_accounted_for(plant, controller)
    assert min(rig.link.lost.values()) > 0


@pytest.mark.check
def test_a_drive_from_the_command_line_outlasts_a_short_partition(
    course: Course, tmp_path: Path
) -> None:
    """As a person does it: plant, controller, drive. A second is less than Zenoh's lease, so the
    connections stay."""
    plant_at, controller_at = free_endpoint(), free_endpoint()
    log = tmp_path / "run.mcap"
    where = ("--track", course.track_file, "--endpoint", plant_at, "--endpoint", controller_at)
    options = ("--mode", "realtime", "--laps", "2", "--max-time", "200", "--log", log)
    with (
        Relay(plant_at) as link,
        start_plant(tmp_path, plant_at) as plant,
        start_controller(tmp_path, course, link.endpoint, controller_at) as controller,
        Program(tmp_path / "drive.txt", "drive", *where, *options) as drive,
    ):
        link.set(**BAD)
        until(lambda: log.exists() and _laps(log) >= 1, "a lap")
        begin_ns = time.monotonic_ns()
        link.hold()
        time.sleep(1.0)
        end_ns = time.monotonic_ns()
        link.release()
        assert drive.process.wait(PATIENCE_S) == 0, drive.said()
        assert "2 lap(s) done" in drive.said()
        controller.end()
        plant.end()
    journey = Journey(log, course.track)
    assert journey.off_track_m() < 0.0
    meanwhile = [state.x[3] for state in journey.between(begin_ns, end_ns)]
    assert meanwhile[-1] < 0.2 * meanwhile[0]
    assert journey.states[-1].lap == 2


def _laps(log: Path) -> int:
    return max((state.lap for state in LogReader(log).select(STATE)), default=0)


@pytest.mark.check
@pytest.mark.parametrize("direction", ["forth", "back"])
def test_a_link_that_fails_one_way(tmp_path: Path, course: Course, direction: str) -> None:
    """forth: the controller is blind, brakes and falls silent. back: the car hears nothing."""
    with driving(tmp_path, course, {"delay_s": 0.01}) as rig:
        rig.drive_on()
        _, _, last = rig.partition(1.5, direction)
        rig.drive_on()
        journey, plant, controller = rig.finish()
    assert abs(last["x"][3]) < STANDING_MPS
    assert journey.off_track_m() < 0.0
    if direction == "forth":
        assert controller["brake"] + controller["stop"] > 0
    assert plant["planned"] + plant["braked"] > 0
    assert_nothing_was_broken(plant, controller)


@pytest.mark.check
def test_losses_by_udp_are_counted_and_hold_up_nothing(tmp_path: Path, course: Course) -> None:
    with driving(tmp_path, course, {}, "udp") as rig:
        rig.drive_on()
        rig.link.set(**BAD)
        for _ in range(4):
            rig.drive_on()
        rig.link.set()
        journey, plant, controller = rig.finish()
    assert journey.off_track_m() < 0.0
    assert controller["states_lost"] > 0
    assert plant["actuations_lost"] > 0
    assert_nothing_was_broken(plant, controller)
    assert_all_is_accounted_for(plant, controller)


@pytest.mark.check
def test_two_machines_from_nothing(tmp_path: Path) -> None:
    """As docs/security.md sets them up: each with the folder of its certificate, one configuration
    file, and addresses in the certificates that are verified."""
    yours, folder = tmp_path / "yours", ("--folder", tmp_path / "yours" / "certs")
    yours.mkdir()
    course = gentle_course(tmp_path)
    hosts = {"plant": "127.0.0.2", "controller": "127.0.0.3"}
    assert run("certs", "init", *folder).returncode == 0
    for role, address in hosts.items():
        of = ("--role", role, "--car", "orca", "--host", address)
        assert run("certs", "add", role, *of, *folder).returncode == 0
    assert run("certs", "add", "director", "--role", "director", *folder).returncode == 0
    where = {
        role: free_endpoint("tls").replace("127.0.0.1", address) for role, address in hosts.items()
    }
    config = (
        f'[network]\nplant = ["{where["plant"]}"]\ncontroller = ["{where["controller"]}"]\n'
        '[tls]\nfolder = "certs"\n'
    )
    given = {}
    for name in ("yours", *hosts):
        given[name] = ("--config", tmp_path / name / "bayesrace.toml")
        (tmp_path / name).mkdir(exist_ok=True)
        (tmp_path / name / "bayesrace.toml").write_text(config)
    for name in hosts:  # and nothing else
        shutil.copytree(yours / "certs" / name, tmp_path / name / "certs" / name)
    out, log = tmp_path / "out", tmp_path / "run.mcap"
    lap = ("drive", "--track", course.track_file, "--laps", "1", "--mode", "realtime", "--log", log)
    drives = ("controller", *course.arguments, *given["controller"])
    with (
        Program(out, "plant", *given["plant"]),
        Program(out, *drives) as controller,
        Program(tmp_path / "drive.txt", *lap, *given["yours"]) as drive,
    ):
        assert drive.process.wait(PATIENCE_S) == 0, drive.said() + controller.said()
        doctor = run("doctor", *given["yours"])
        assert doctor.returncode == 0, doctor.stdout
        assert "car 'orca': controller and plant" in doctor.stdout
    assert max(state.lap for state in LogReader(log).select(STATE)) == 1


@pytest.mark.check
def test_one_machine_with_other_users_from_nothing() -> None:
    """As docs/security.md sets it up: the home is open to others, the folder of sockets is not."""
    page = (ROOT / "docs" / "security.md").read_text().partition("**One machine with other users.")
    commands = textwrap.dedent(page[2].partition("\n\n")[2].partition("\n\n")[0])
    with temporary_folder("/tmp") as home:  # noqa: S108 (a socket's path is short)
        home.chmod(0o755)
        course = gentle_course(home)
        yours = {**os.environ, "HOME": str(home)}
        subprocess.run(["sh", "-euc", commands], cwd=home, env=yours, check=True)
        given = ("--config", home / "bayesrace.toml")
        doctor = run("doctor", *given)
        assert doctor.returncode == 1
        assert f"nothing listens at unixsock-stream/{home}" in doctor.stdout
        lap = ("drive", "--track", course.track_file, "--laps", "1", "--mode", "realtime")
        with (
            Program(home / "plant.txt", "plant", *given),
            Program(home / "out.txt", "controller", *course.arguments, *given) as controller,
        ):
            driven = run(*lap, "--log", home / "run.mcap", *given)
            assert driven.returncode == 0, driven.stderr + controller.said()
            doctor = run("doctor", *given)
            assert doctor.returncode == 0, doctor.stdout
            for endpoint in read_configuration(home / "bayesrace.toml").network.everyone:
                path = endpoint.removeprefix("unixsock-stream/")
                assert stat.S_IMODE(Path(path).parent.stat().st_mode) == 0o700
                connect(path)
                if os.geteuid() == 0:
                    with another_user(), pytest.raises(PermissionError):
                        connect(path)


def connect(path: str) -> None:
    """Like any process that knows the socket's path."""
    with socket.socket(socket.AF_UNIX) as one:
        one.connect(path)


@contextmanager
def another_user() -> Iterator[None]:
    """This process is nobody for the block."""
    os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(0)
