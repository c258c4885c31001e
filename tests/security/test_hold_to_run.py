"""``drive --hold-to-run`` by real processes over secured links: whoever is lost, or whatever is
attacked, a car whose director is missing stands, and stays so."""

import math
import signal
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import pytest

from bayesrace.configuration import read_configuration
from bayesrace.errors import InputError
from bayesrace.log import LogReader
from bayesrace.messages import EVENT, State
from bayesrace.operation.run_plan import RunPlan, run_request
from bayesrace.recorder import Recorder
from bayesrace.transport import Director, free_endpoint, open_session
from bayesrace.transport.relay import Relay
from tests.network.cars import Course, Program
from tests.network.observer import STANDING_MPS, Journey
from tests.programs import run, until
from tests.security.authority import CAR, Bundles, bundles, written
from tests.security.rig import BOTH, attacking, course, secured

__all__ = ["bundles", "course"]

pytestmark = [pytest.mark.check, pytest.mark.wall_clock]

NOTICED_S: Final = 0.5
BRAKING_MPS2: Final = 1.0
"""Less than any braking of this car at the speeds of this course; the slow end is in LATE_S."""
LATE_S: Final = 0.5
"""A machine with other work does not look at a state, or carry a command out, at once."""


@dataclass
class Rig:
    """A car that is driven by ``drive`` with the dead man's switch, over links of its own."""

    config: Path
    endpoints: tuple[str, str]
    plant: Program
    controller: Program
    drive: Program
    plant_link: Relay
    controller_link: Relay
    director: Director
    """Another one, which looks on."""
    course: Course
    log: Path
    recording: ExitStack

    def status(self, source: str) -> dict[str, Any]:
        status = self.director.status(source)
        return {"phase": status.phase, "text": status.text, **status.counters}

    def drive_on(self, seconds: float = 2.0) -> None:
        """The car drives for so long."""
        until(lambda: self.status("controller")["phase"] == "driving", "driving")
        time.sleep(seconds)
        # a busy machine falls back for a cycle now and then
        until(lambda: self.status("controller")["phase"] == "driving", "driving on", 5.0)
        assert self.status("plant")["phase"] == "running", self.drive.said()

    def check_stands(self, since_ns: int) -> list[State]:
        """Within bounds of time and distance, on the track, for good; the states since then."""
        self.recording.close()
        journey = Journey(self.log, self.course.track)
        states = journey.between(since_ns, time.monotonic_ns())
        before = journey.between(0, since_ns)[-1]
        assert before.x[3] > 0.4
        last = max(i for i, one in enumerate(states) if abs(one.x[3]) > STANDING_MPS)
        took_s = (states[last].source_time_ns - since_ns) * 1e-9
        way_m = sum(math.dist(a.x[:2], b.x[:2]) for a, b in pairwise(states))
        top_mps = max(one.x[3] for one in states)
        assert took_s < NOTICED_S + LATE_S + top_mps / BRAKING_MPS2
        assert way_m < top_mps * (NOTICED_S + LATE_S) + top_mps**2 / (2 * BRAKING_MPS2)
        assert journey.off_track_m() <= 0
        return states

    def ends(self, run: int = 1) -> list[str]:
        """Reasons of the ends of that run in the log so far."""
        events = LogReader(self.log).select(EVENT)
        return [
            str(one.data["reason"]) for one in events if (one.kind, one.run) == ("run_ended", run)
        ]


@contextmanager
def held(folder: Path, course: Course, bundles: Bundles, *options: str) -> Iterator[Rig]:
    """A run of many laps that ``drive`` has begun; without options the configuration holds it."""
    plant_at, controller_at = free_endpoint("tls"), free_endpoint("tls")
    config = written(folder, bundles, plant_at, controller_at)
    required = config.read_text() + ("" if options else "[drive]\nhold_to_run = true\n")
    config.write_text(required)
    with ExitStack() as stack:
        with_config = ("--config", config)
        plant = stack.enter_context(Program(folder / "plant.txt", "plant", *with_config))
        driver = course.controller(folder / "controller.txt", *with_config)
        controller = stack.enter_context(driver)
        to_plant, to_controller = (
            stack.enter_context(Relay(one)) for one in (plant_at, controller_at)
        )
        by_links = folder / "links.toml"
        by_links.write_text(
            required.replace(plant_at, to_plant.endpoint).replace(
                controller_at, to_controller.endpoint
            )
        )
        endpoints = read_configuration(config).endpoints("director")
        recording = stack.enter_context(ExitStack())
        session = recording.enter_context(open_session(endpoints, "director"))
        director = Director(session, CAR)
        director.wait_for(("plant", "controller"), 60.0)
        log = folder / "run.mcap"
        recording.enter_context(Recorder(session, CAR, log))
        line: tuple[str | Path, ...] = (
            "drive", "--mode", "realtime", "--track", course.track_file, "--laps", "999",
            "--max-time", "600", "--log", folder / "drive.mcap", "--config", by_links, *options,
        )  # fmt: skip
        drive = stack.enter_context(Program(folder / "drive.txt", *line))
        rig = Rig(
            config, (plant_at, controller_at), plant, controller, drive, to_plant, to_controller,
            director, course, log, recording,
        )  # fmt: skip
        rig.drive_on()
        yield rig


@BOTH
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_a_car_whose_director_is_killed_or_hangs_stands(
    tmp_path: Path, course: Course, bundles: Bundles, how: signal.Signals
) -> None:
    """It does not drive on by itself when the director goes on; the next run does, at once."""
    with held(tmp_path, course, bundles, "--hold-to-run") as rig:
        rig.drive.process.send_signal(how)
        until(lambda: rig.ends() == ["hold_lost"], "the end of the run", 10.0)
        assert (rig.status("plant")["holds_lost"], rig.status("controller")["holds_lost"]) == (1, 1)
        if how is signal.SIGSTOP:
            rig.drive.process.send_signal(signal.SIGCONT)
            assert rig.drive.process.wait(30.0) == 2
            assert "the director that holds the run was missing" in rig.drive.said()
        time.sleep(1.0)
        plan = RunPlan(2, "test", 1, 2.0, lockstep=False)
        rig.director.start(run_request(course.track, plan))
        until(lambda: rig.status("controller")["phase"] == "driving", "driving", 10.0)
        assert rig.director.wait_for_end(2, 30.0).data["reason"] == "max_time"
        rig.recording.close()
        assert {one.run for one in Journey(rig.log, course.track).states[-20:]} == {2}


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_it_stands_within_bounds_of_time_and_distance(
    tmp_path: Path, course: Course, bundles: Bundles, how: signal.Signals
) -> None:
    with held(tmp_path, course, bundles) as rig:
        rig.drive.process.send_signal(how)
        since_ns = time.monotonic_ns()
        until(lambda: rig.ends() == ["hold_lost"], "the end of the run", 10.0)
        rig.check_stands(since_ns)


def test_the_plant_stops_the_car_alone(tmp_path: Path, course: Course, bundles: Bundles) -> None:
    """Its link to the director is cut, the controller's is not, and goes on driving; what the link
    has held up comes in the end, and changes nothing."""
    with held(tmp_path, course, bundles) as rig:
        rig.plant_link.hold("back")
        since_ns = time.monotonic_ns()
        until(lambda: rig.status("plant")["holds_lost"] == 1, "the loss", 5.0)
        assert rig.status("controller")["holds_lost"] == 0
        rig.plant_link.release()
        until(lambda: rig.ends() == ["hold_lost"], "the end of the run", 10.0)
        rig.check_stands(since_ns)


def test_the_plant_stops_the_car_when_the_controller_is_gone_as_well(
    tmp_path: Path, course: Course, bundles: Bundles
) -> None:
    with held(tmp_path, course, bundles) as rig:
        rig.drive.process.kill()
        rig.controller.process.kill()
        since_ns = time.monotonic_ns()
        until(lambda: rig.ends() == ["hold_lost"], "the end of the run", 10.0)
        rig.check_stands(since_ns)


@BOTH
def test_the_controller_stops_the_car_alone(
    tmp_path: Path, course: Course, bundles: Bundles
) -> None:
    """Its link to the director is cut, the plant's is not. It stays so until ``go``."""
    with held(tmp_path, course, bundles) as rig:
        rig.controller_link.hold("back")
        since_ns = time.monotonic_ns()
        until(lambda: rig.status("controller")["phase"] == "stopped", "stopped", 5.0)
        rig.controller_link.release()
        time.sleep(2.0)
        status = rig.status("controller")
        assert (status["phase"], status["holds_lost"]) == ("stopped", 1)
        assert "hold-to-run" in status["text"]
        plant = rig.status("plant")
        assert (plant["phase"], plant["holds_lost"]) == ("running", 0)
        until_ns = time.monotonic_ns()
        assert run("go", "--config", rig.config).returncode == 0
        rig.drive_on(1.0)
        rig.drive.process.send_signal(signal.SIGINT)
        assert rig.drive.process.wait(30.0) != 0
        rig.recording.close()
        journey = Journey(rig.log, course.track)
        assert abs(journey.between(since_ns, until_ns)[-1].x[3]) < STANDING_MPS
        assert journey.off_track_m() <= 0


@contextmanager
def half_open(endpoints: tuple[str, str]) -> Iterator[None]:
    """For the block, connections arrive at both that never greet, 30 a second each."""
    with ExitStack() as stack:
        for one in endpoints:
            words = "127.0.0.1", one.rpartition(":")[2], 30, "silence", "127.0.0.1"
            stack.enter_context(attacking("half_open", "opening", *words))
        yield


def test_no_new_link_is_needed(tmp_path: Path, course: Course, bundles: Bundles) -> None:
    """While half-open connections keep everybody else out, the car drives on as long as its
    director is there, and no longer."""
    with held(tmp_path, course, bundles) as rig, half_open(rig.endpoints):
        rig.drive_on(3.0)
        assert run("stop", "--config", rig.config).returncode == 2, "the attack has no effect"
        rig.drive_on(0.0)
        rig.drive.process.kill()
        since_ns = time.monotonic_ns()
        until(lambda: rig.ends() == ["hold_lost"], "the end of the run", 10.0)
        rig.check_stands(since_ns)


def test_a_plant_may_demand_the_switch(tmp_path: Path, course: Course, bundles: Bundles) -> None:
    with held(tmp_path, course, bundles) as rig:
        rig.drive.process.send_signal(signal.SIGINT)
        rig.drive.process.wait(30.0)
        time.sleep(NOTICED_S + LATE_S)
        for source in ("plant", "controller"):  # a director that ends its run is not lost
            assert rig.status(source)["holds_lost"] == 0
        plan = RunPlan(2, "test", 1, 2.0, lockstep=False)
        with pytest.raises(InputError, match="--hold-to-run"):
            rig.director.start(run_request(course.track, plan))
        lockstep = run("drive", "--track", course.track_file, "--config", rig.config,
                       "--log", tmp_path / "other.mcap")  # fmt: skip
        assert lockstep.returncode == 2
        assert "--mode realtime" in lockstep.stderr
        assert len(lockstep.stderr.strip().splitlines()) == 1


def test_a_router_forwards_it_and_a_loop_that_ends_holds_nothing(
    tmp_path: Path, course: Course, bundles: Bundles
) -> None:
    """Though the director's process lives, and its links stand; when it goes on, it is too late."""
    with secured(tmp_path, course, bundles, router=True) as rig:
        plan = RunPlan(1, "test", 0, 600.0, lockstep=False, held=True)
        rig.director.start(run_request(course.track, plan))
        with pytest.raises(InputError, match="did not end"):
            rig.director.wait_for_end(1, 3.0)
        time.sleep(0.7)
        end = rig.director.wait_for_end(1, 30.0)  # holds it again, in vain
        assert end.data["reason"] == "hold_lost"
        assert float(str(end.data["time_s"])) > 3.0
        assert rig.count("controller", "holds_lost") == {"holds_lost": 1}
