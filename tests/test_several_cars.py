"""Four plants and four controllers in one network, through one router, separated by name alone.

Each car has a track of its own, far from the others', so that a message of another car would show
at once: in a position, an epoch, a run number.
"""

import time
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from bayesrace.errors import InputError
from bayesrace.messages import Status
from bayesrace.transport import Director, free_endpoint
from tests.network.cars import (
    Course,
    Program,
    gentle_course,
    start_controller,
    start_plant,
    start_router,
)
from tests.network.observer import Journey, drive_on, observing

pytestmark = [pytest.mark.check, pytest.mark.wall_clock]

CARS = ("red", "green", "blue", "white")
APART_M = 10.0


def status_of(process: str, director: Director) -> Status:
    """Asks again where a process answers too late: four cars keep a machine busy."""
    for _ in range(5):
        with suppress(InputError):
            return director.status(process)
    return director.status(process)


def assert_own(journey: Journey, course: Course, run: int, status: Status) -> None:
    """All that was heard under a car's name belongs to its own plant, run and track."""
    assert {state.run for state in journey.states} == {run}
    assert {state.epoch for state in journey.states} == {status.epoch}
    assert {actuation.run for actuation in journey.actuations} == {run}
    assert {actuation.epoch for actuation in journey.actuations} == {status.epoch}
    centre_x = course.track.x_m.mean()
    assert all(abs(state.x[0] - centre_x) < APART_M / 2 for state in journey.states)
    assert journey.off_track_m() < 0.0


def assert_no_stranger(plant: Status, controller: Status) -> None:
    """A message of another car would have been refused, stale, or a gap in the numbers."""
    for counters in (plant.counters, controller.counters):
        assert counters["refused"] == counters["overflowed"] == 0
    assert controller.counters["states_lost"] == controller.counters["states_stale"] == 0
    assert plant.counters["actuations_lost"] == plant.counters["rejected"] == 0


def test_four_cars_drive_at_once(tmp_path: Path) -> None:
    router_at = free_endpoint()
    courses, observers, programs = {}, {}, list[Program]()
    with ExitStack() as cleanup:
        router = cleanup.enter_context(start_router(tmp_path, router_at))
        for number, name in enumerate(CARS):
            folder = tmp_path / name
            folder.mkdir()
            course = courses[name] = gentle_course(folder, 0.9, (APART_M * number, 0.0))
            ends = free_endpoint(), free_endpoint()
            plant = start_plant(folder, ends[0], connect=[router_at], name=name)
            programs.append(cleanup.enter_context(plant))
            controller = start_controller(folder, course, router_at, ends[1], name=name)
            programs.append(cleanup.enter_context(controller))
        following = cleanup.enter_context(ExitStack())
        for name, course in courses.items():
            log = tmp_path / name / "run.mcap"
            observers[name] = following.enter_context(
                observing([router_at], name, course.track, log)
            )
        runs = {name: 10 + number for number, name in enumerate(CARS)}
        for name, observer in observers.items():
            observer.start(runs[name])
        all_driving_s = time.monotonic()
        for observer in observers.values():
            drive_on(observer)
        together_s = time.monotonic() - all_driving_s
        status = {
            name: (status_of("plant", one.director), status_of("controller", one.director))
            for name, one in observers.items()
        }
        for observer in observers.values():
            observer.stop()
        for program in [*programs, router]:
            program.end()
        following.close()

    assert len({plant.epoch for plant, _ in status.values()}) == len(CARS)
    for name, course in courses.items():
        plant_status, controller_status = status[name]
        assert plant_status.phase == "running"
        assert plant_status.epoch == controller_status.epoch
        journey = Journey(tmp_path / name / "run.mcap", course.track)
        assert_own(journey, course, runs[name], plant_status)
        assert_no_stranger(plant_status, controller_status)
        assert journey.states[-1].time_s > together_s - 1.0
