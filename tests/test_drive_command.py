"""The parts run by hand, in terminals of their own: by files, directed by ``bayesrace drive``."""

import json
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import pytest

from bayesrace.controller.settings import MpcSettings
from bayesrace.log import LogReader
from bayesrace.messages import ACTUATION, EVENT, STATE, TELEMETRY
from bayesrace.operation.doctor import probe
from bayesrace.operation.host import HostProgram
from bayesrace.transport import free_endpoint
from bayesrace.vehicles import Car
from tests.command_line import Cli, course_files, refused
from tests.conftest import Circuit
from tests.network.cars import free_port, started_host
from tests.programs import finish, peanut, run, start, until

LONG = ("--laps", "10000", "--max-time", "3600")


@pytest.fixture
def course(circuit: Circuit, tmp_path: Path) -> tuple[str | Path, ...]:
    """Options that name a track and its line, as files."""
    return course_files(tmp_path, circuit.track, circuit.line)


def _succeed(*arguments: str | Path) -> str:
    done = run(*arguments)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture
def ended() -> Iterator[list[subprocess.Popen[str]]]:
    """Processes that must not outlive the test."""
    processes: list[subprocess.Popen[str]] = []
    yield processes
    for process in processes:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.mark.check
def test_the_chain_by_files_in_four_terminals(
    tmp_path: Path, ended: list[subprocess.Popen[str]]
) -> None:
    track, line, log = (tmp_path / name for name in ("track.csv", "line.csv", "collect.mcap"))
    weights, artefact, drive_log = (tmp_path / name for name in ("w.bin", "mpc", "drive.mcap"))
    quick = ("--kernel", "rbf", "--restarts", "0")
    assert "peanut" in _succeed("tracks", peanut(tmp_path / "peanut.csv"), "--out", track)
    assert str(line) in _succeed("raceline", track, "--out", line)
    assert "600 samples" in _succeed("collect", "--track", track, "--raceline", line, "--out", log)
    assert "samples" in _succeed("train", log, "--out", weights, "--points", "60", *quick)
    assert _succeed("build", "--out", artefact).strip() == str(artefact)

    plant_at, controller_at = free_endpoint(), free_endpoint()
    files = ("--artefact", artefact, "--track", track, "--raceline", line, "--weights", weights)
    plant = start("plant", "--endpoint", plant_at)
    controller = start("controller", *files, "--endpoint", plant_at, "--listen", controller_at)
    ended += [plant, controller]
    where = ("--endpoint", plant_at, "--endpoint", controller_at)
    # Twice: a plant waits for the next run.
    for _ in range(2):
        said = _succeed("drive", "--track", track, "--laps", "1", *where, "--log", drive_log)
    assert "1 lap(s) done" in said
    assert "passed: 1 lap in " in said
    assert str(drive_log) in said
    controller.send_signal(signal.SIGINT)
    plant.send_signal(signal.SIGTERM)
    assert finish(controller).returncode == 0
    assert finish(plant).returncode == 0

    reader = LogReader(drive_log)
    states, actuations = reader.select(STATE), reader.select(ACTUATION)
    assert not reader.truncated
    assert reader.refused == 0
    assert len(states) > 100
    assert {state.run for state in states} == {2}
    # the last state of a run needs no answer
    assert states[-1].final
    assert [a.state_seq for a in actuations] == [s.seq for s in states[:-1]]
    assert {a.weights_version for a in actuations} == {actuations[0].weights_version} != {""}
    assert len(reader.select(TELEMETRY)) == len(actuations)
    kinds = [event.kind for event in reader.select(EVENT)]
    assert kinds == ["run", "run_started", "run_ended"]
    # what was driven can be learned from
    assert "samples" in _succeed(
        "train", log, drive_log, "--out", weights, "--points", "60", *quick
    )


@dataclass
class Waiting:
    """A plant and a controller that wait for a run."""

    plant: subprocess.Popen[str]
    controller: subprocess.Popen[str]
    bridge: subprocess.Popen[str]
    """Of a controller without Python; else the controller itself."""
    plant_at: str
    where: tuple[str, ...]
    """Endpoints of both, as options."""
    track: tuple[str | Path, ...]
    ended: list[subprocess.Popen[str]]

    def drive(self, log: Path, *options: str) -> subprocess.Popen[str]:
        """A drive of many laps, of which the first is in progress."""
        # Otherwise 'drive' says, besides, that there is no link yet.
        until(lambda: not any(probe(one, None) for one in self.where[1::2]), "both to listen")
        drive = start("drive", *self.track, *LONG, *options, *self.where, "--log", log)
        self.ended.append(drive)
        until(lambda: log.exists() and log.stat().st_size > 20_000, "a run in progress")
        return drive


BOTH = pytest.mark.parametrize(
    "waiting", ["Python", pytest.param("C", marks=pytest.mark.check)], indirect=True
)
"""By the controller in Python, and by that without and its bridge."""


@pytest.fixture
def waiting(
    course: tuple[str | Path, ...], kinematic_artefact: Path, ended: list[subprocess.Popen[str]],
    circuit: Circuit, car: Car, tmp_path: Path, request: pytest.FixtureRequest,
) -> Iterator[Waiting]:  # fmt: skip
    plant_at, controller_at = free_endpoint(), free_endpoint()
    plant = start("plant", "--endpoint", plant_at)
    where = ("--endpoint", plant_at, "--listen", controller_at)
    with ExitStack() as stack:
        if getattr(request, "param", "Python") == "C":
            link = f"udp:127.0.0.1:{free_port()}"
            drives_by = car, circuit.track, circuit.line, None, MpcSettings()
            host = HostProgram.made(tmp_path, kinematic_artefact, *drives_by)
            controller = stack.enter_context(started_host(host, link))
            bridge = start("bridge", link, *course[:2], *where)
        else:
            files = ("--artefact", kinematic_artefact, *course)
            bridge = controller = start("controller", *files, *where)
        ended += [plant, bridge]
        both = ("--endpoint", plant_at, "--endpoint", controller_at)
        yield Waiting(plant, controller, bridge, plant_at, both, course[:2], ended)


@BOTH
def test_drive_refuses_another_track_than_the_controllers(cli: Cli, waiting: Waiting) -> None:
    outcome = cli("drive", "--track", "paddock", *waiting.where)
    refused(outcome, "the controller drives the track '", "this run is on 'paddock-", "--track")


@BOTH
@pytest.mark.check
def test_drive_says_when_the_controller_is_lost(tmp_path: Path, waiting: Waiting) -> None:
    """The run breaks off, so drive fails; the plant is ready for the next controller."""
    log = tmp_path / "drive.mcap"
    drive = waiting.drive(log)
    waiting.controller.kill()
    done = finish(drive)
    assert done.returncode not in (0, None)
    assert "Traceback" not in done.stderr
    assert "controller vanished" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert LogReader(log).select(STATE)
    assert waiting.plant.poll() is None


@pytest.mark.check
@pytest.mark.wall_clock
def test_a_run_whose_director_is_gone_ends_by_itself_or_by_a_command(
    tmp_path: Path, waiting: Waiting
) -> None:
    """Nothing watches or records it any more; until then a new one is refused with the remedy."""

    def words() -> str:
        state = json.loads(run("status", "--json", *waiting.where).stdout)["cars"]["orca"]["plant"]
        return f"{state['phase']}: {state['text']}"

    for attempt in range(3):  # a busy machine may take longer to ask than the run lasts
        waiting.drive(tmp_path / f"{attempt}.mcap", "--mode", "realtime").kill()
        log = tmp_path / f"refused-{attempt}.mcap"
        busy = run("drive", *waiting.track, *waiting.where, "--log", log)
        done = run("stop", "--run", "--endpoint", waiting.plant_at)
        if busy.returncode == 2 and done.returncode == 0:
            break
    assert busy.returncode == 2
    assert "'bayesrace stop --run' ends it" in busy.stderr
    assert (done.returncode, "stops" in done.stdout) == (0, True), done.stderr
    until(lambda: words().startswith("idle"), "the end of the run")
    waiting.drive(tmp_path / "three.mcap", "--mode", "realtime").kill()
    until(lambda: "has been gone for 10 s" in words(), "the end of another")
    assert words().startswith("idle")


def driven_after_a_pause(log: Path) -> bool:
    """Whether the controller has driven by a plan since it was suspended."""
    cycles = LogReader(log).select(TELEMETRY)
    pauses = [b.source_time_ns - a.source_time_ns > 5e9 for a, b in pairwise(cycles)]
    return True in pauses and any(one.fallback == 0 for one in cycles[pauses.index(True) + 1 :])


@pytest.mark.check
@pytest.mark.wall_clock
@BOTH
@pytest.mark.parametrize("mode", ["realtime", "lockstep"])
def test_a_suspended_machine_is_named(tmp_path: Path, waiting: Waiting, mode: str) -> None:
    """In real time the run goes on; in lockstep messages are lost with their links, unless all of
    these find a sign of life first when they wake."""
    log = tmp_path / "drive.mcap"
    drive = waiting.drive(log, "--mode", mode)
    everybody = {drive, waiting.plant, waiting.controller, waiting.bridge}
    for process in everybody:
        process.send_signal(signal.SIGSTOP)
    time.sleep(9.0)  # longer than links live without a sign of life
    for process in everybody:
        process.send_signal(signal.SIGCONT)
    if mode == "lockstep":
        until(lambda: drive.poll() is not None or driven_after_a_pause(log), "an end, or driving")
        if lives := drive.poll() is None:
            drive.send_signal(signal.SIGINT)
        done = finish(drive)
        assert lives or done.returncode == 2
        assert "did not run for" in done.stderr
        assert "one in lockstep has to be started again" in done.stderr
        return
    until(lambda: "suspended" in [one.kind for one in LogReader(log).select(EVENT)], "the event")
    until(lambda: driven_after_a_pause(log), "a plan after that")
    assert drive.poll() is None
    drive.send_signal(signal.SIGINT)
    finish(drive)
    states = LogReader(log).select(STATE)
    assert max(b.time_s - a.time_s for a, b in pairwise(states)) < 2.0


@BOTH
@pytest.mark.check
@pytest.mark.wall_clock
def test_a_run_in_which_the_car_was_not_driven_is_no_success(
    tmp_path: Path, waiting: Waiting
) -> None:
    drive = waiting.drive(tmp_path / "drive.mcap", "--mode", "realtime", "--max-time", "4")
    waiting.controller.send_signal(signal.SIGSTOP)
    try:
        done = finish(drive)
    finally:
        waiting.controller.send_signal(signal.SIGCONT)
    assert done.returncode == 1
    assert "failed: 0 of 10000 laps driven; " in done.stdout
    assert "solutions drove the car for 0." in done.stdout
