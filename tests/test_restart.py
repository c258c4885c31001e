"""Each part of a driving car dies and comes back, and so does the way between them.

Promises guarded: a controller started again takes over the car that its forerunner left; a plant
started again is found by the controller that waits for it, and what was meant for its forerunner
does not act on it; a connection that breaks, or a router that dies, is made again. Meanwhile the
car brakes, and stays on its track. All of it with the controller in Python and the one without.
"""

import logging
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest
from msgspec.structs import replace

from bayesrace.messages import (
    COMMAND,
    STATE,
    Command,
    State,
    car_key,
    encode,
)
from bayesrace.transport import Endpoints, Publisher, free_endpoint, open_session
from bayesrace.transport.relay import Relay
from tests.car_fmu import packed_car
from tests.network.cars import (
    Bridged,
    Course,
    Program,
    gentle_course,
    start_controller,
    start_plant,
    start_router,
)
from tests.network.observer import Journey, Observer, drive_on, observing
from tests.programs import until

pytestmark = pytest.mark.wall_clock

_log = logging.getLogger(__name__)


@pytest.fixture(scope="module", params=["Python", "C"])
def language(request: pytest.FixtureRequest) -> str:
    """Of the controller."""
    return str(request.param)


@pytest.fixture(scope="module")
def course(tmp_path_factory: pytest.TempPathFactory, language: str) -> Course:
    return gentle_course(tmp_path_factory.mktemp("course"), language=language)


@dataclass
class Rig:
    """How to start each part, and the observer."""

    start_plant: Callable[..., Program]
    start_controller: Callable[[], Program]
    start_router: Callable[[], Program]
    proxy: Relay
    observer: Observer
    plant_at: str
    controller_at: str
    log: Path
    course: Course
    _following: ExitStack

    def state(self) -> State:
        """The newest one."""
        until(lambda: self.observer.newest() is not None, "a first state")
        newest = self.observer.newest()
        assert newest is not None
        return newest

    def drive_on(self) -> None:
        """Waits until the car has got a good deal further."""
        drive_on(self.observer)

    def driving(self, *options: str) -> tuple[Program, Program]:
        """A controller and a plant that have begun to drive the car, in the order of their end."""
        plant, controller = self.start_plant(*options), self.start_controller()
        self.observer.start(1)
        self.drive_on()
        return controller, plant

    def finished(self, *programs: Program) -> Journey:
        """What has been recorded, after the end of run and programs, on the track all the way."""
        self.observer.stop()
        for program in programs:
            program.end()
        self._following.close()
        journey = Journey(self.log, self.course.track)
        assert journey.off_track_m() < 0.0
        return journey


@contextmanager
def rigged(
    tmp_path: Path, course: Course, way: Literal["direct", "proxy", "router"] = "direct"
) -> Iterator[Rig]:
    """``way``: between plant and controller; with a router it is all that anybody knows."""
    plant_at, controller_at, router_at = free_endpoint(), free_endpoint(), free_endpoint()
    log = tmp_path / "run.mcap"
    with ExitStack() as programs, Relay(plant_at) as proxy:

        def a_plant(*options: str) -> Program:
            connect = [router_at] if way == "router" else []
            return programs.enter_context(
                start_plant(tmp_path, plant_at, *options, connect=connect)
            )

        def a_controller() -> Program:
            connect = {"direct": plant_at, "proxy": proxy.endpoint, "router": router_at}[way]
            program = start_controller(tmp_path, course, connect, controller_at)
            return programs.enter_context(program)

        def a_router() -> Program:
            return programs.enter_context(start_router(tmp_path, router_at))

        watched = [router_at] if way == "router" else [plant_at, controller_at]
        following = programs.enter_context(ExitStack())
        observer = following.enter_context(observing(watched, "orca", course.track, log))
        yield Rig(
            a_plant,
            a_controller,
            a_router,
            proxy,
            observer,
            plant_at,
            controller_at,
            log,
            course,
            following,
        )


@pytest.fixture
def rig(tmp_path: Path, course: Course) -> Iterator[Rig]:
    with rigged(tmp_path, course) as made:
        yield made


def test_a_controller_started_again_takes_over_the_car(tmp_path: Path, language: str) -> None:
    """A larger and faster course, so that the car still rolls a second after it began to brake.

    How long it really took is logged: ``pytest --log-cli-level=INFO``.
    """
    course = gentle_course(tmp_path, speed_mps=2.0, scale=3.0, language=language)
    with rigged(tmp_path, course) as rig:
        _take_over(rig)


def _take_over(rig: Rig) -> None:
    plant, controller = rig.start_plant(), rig.start_controller()
    rig.observer.start(1)
    until(lambda: rig.state().x[3] > 1.5, "speed")
    controller.kill()
    killed_ns, seen = time.monotonic_ns(), rig.state().seq
    successor = rig.start_controller()
    # Answers of the killed one may still arrive; the new one cannot have started in that time.
    until(lambda: rig.state().seq > seen + 10, "states after the end of the controller")
    last = rig.state()
    until(lambda: _answers_since(rig.state(), last.seq + 1), "an answer of the successor")
    for _ in range(3):
        rig.drive_on()
    plant_counters, counters = (
        rig.observer.status(source)["counters"] for source in ("plant", "controller")
    )
    journey = rig.finished(successor, plant)
    acted = next(state for state in journey.states if _answers_since(state, last.seq + 1))
    waited_s = (acted.source_time_ns - killed_ns) * 1e-9
    _log.info("taken over after %.2f s, at %.2f m/s", waited_s, acted.x[3])
    speeds = [one.x[3] for one in journey.between(killed_ns, acted.source_time_ns)]
    assert speeds[-1] < max(speeds)  # by how much depends on how fast the successor starts
    assert plant_counters["planned"] + plant_counters["braked"] > 0
    assert plant_counters["refused"] == plant_counters["rejected"] == 0
    # It takes the car as it finds it.
    assert counters["raised"] == counters["refused"] == counters.get("states_stale", 0) == 0
    assert counters["solution"] > counters["ticks"] / 2


def _answers_since(state: State, seq: int) -> bool:
    """Whether the state reports that an answer to a state after ``seq`` has acted."""
    rows = zip(state.actuation_delays[::3], state.actuation_delays[2::3], strict=True)
    return any(answered > seq and acting_s >= 0 for answered, acting_s in rows)


@pytest.mark.check
@pytest.mark.parametrize(("language", "fmu"), [("Python", False), ("Python", True), ("C", False)],
                         indirect=["language"])  # fmt: skip
def test_a_plant_started_again_is_found(rig: Rig, fmu: bool) -> None:
    options = ("--fmu", str(packed_car())) if fmu else ()
    controller, plant = rig.driving(*options)
    before = rig.state()
    plant.kill()
    until(
        lambda: rig.observer.status("controller").get("phase") == "waiting",
        "a controller that waits",
    )
    plant = rig.start_plant(*options)
    until(
        lambda: rig.observer.status("plant").get("epoch", before.epoch) != before.epoch,
        "the new plant",
    )
    rig.observer.start(1)  # the same number: the epoch alone distinguishes them
    until(lambda: rig.state().epoch != before.epoch, "a state of the new plant")
    rig.drive_on()
    until(lambda: rig.observer.status("controller")["phase"] == "driving", "it to drive again")
    status = rig.observer.status("controller")
    assert status["epoch"] == rig.state().epoch
    assert status["counters"].get("states_stale", 0) == 0
    journey = rig.finished(controller, plant)
    assert {state.run for state in journey.states} == {1}
    assert {state.epoch for state in journey.states} == {before.epoch, status["epoch"]}


@pytest.mark.check
@pytest.mark.parametrize("language", ["C"], indirect=True)
def test_a_program_started_again_takes_over_through_its_bridge(rig: Rig) -> None:
    controller, plant = rig.driving()
    assert isinstance(controller, Bridged)
    controller.restart()
    rig.drive_on()
    until(lambda: rig.observer.status("controller")["phase"] == "driving", "it to drive")
    rig.finished(controller, plant)


def test_foreign_states_are_counted_and_the_car_drives_on(rig: Rig) -> None:
    """Numbers ahead, another plant's: each once silenced the controller."""
    controller, plant = rig.driving()
    with open_session(Endpoints(connect=(rig.controller_at,)), "plant") as session:
        publisher = Publisher(session, STATE, "orca")

        def foreign() -> int:
            state = rig.state()
            oddities: tuple[dict[str, Any], ...] = (
                {"seq": state.seq + 1000}, {"seq": 2**63 - 1}, {"epoch": state.epoch + 1},
                {"run": 7}, {"seq": state.seq + 1000, "final": True},
            )  # fmt: skip
            for odd in oddities:
                publisher.put(replace(state, **odd), lockstep=False)
            return int(rig.observer.status("controller")["counters"]["states_foreign"])

        until(lambda: foreign() > 20, "a controller that hears the forger")
        rig.drive_on()
        until(lambda: rig.observer.status("controller")["phase"] == "driving", "it to drive")
        status = rig.observer.status("controller")
    assert status["epoch"] == rig.state().epoch
    assert status["counters"]["states_lost"] < 20
    rig.finished(controller, plant)


@pytest.mark.check
def test_connections_that_stay_silent_do_not_hold_up_the_states(rig: Rig) -> None:
    """A port scan: it cost some 45 cycles without a state."""
    controller, plant = rig.driving()
    before = rig.observer.status("controller")["counters"]
    host, port = rig.controller_at.removeprefix("tcp/").split(":")
    with ExitStack() as stack:
        for _ in range(400):
            stack.enter_context(socket.create_connection((host, int(port)), timeout=5.0))
        rig.drive_on()
        after = rig.observer.status("controller")["counters"]
    assert after["brake"] + after["stop"] - before["brake"] - before["stop"] < 20
    rig.finished(controller, plant)


@pytest.mark.check
def test_requests_without_end_do_not_hold_up_the_loop(rig: Rig) -> None:
    controller, plant = rig.driving()
    with open_session(Endpoints(connect=(rig.controller_at,))) as session:
        request = encode(Command(seq=0, source_time_ns=0, command="go", text="again"))
        key, end_s = car_key(COMMAND.key, "orca"), time.monotonic() + 3.0
        answers = []
        while time.monotonic() < end_s:
            answers.append(session.get(key, payload=request, timeout=5.0))
            time.sleep(0.002)
        accepted = sum(1 for one in answers for reply in one if reply.ok is not None)
    rig.drive_on()
    counters = rig.observer.status("controller")["counters"]
    assert 10 <= accepted <= 100
    assert counters["requests_rejected"] > 200
    rig.finished(controller, plant)


@pytest.mark.check
def test_a_broken_connection_is_made_again(tmp_path: Path, course: Course) -> None:
    with rigged(tmp_path, course, "proxy") as rig:
        controller, plant = rig.driving()
        rig.proxy.cut()
        broken_ns = time.monotonic_ns()
        time.sleep(1.0)
        joined_ns = time.monotonic_ns()
        rig.proxy.join()
        rig.drive_on()
        until(lambda: rig.observer.status("controller")["phase"] == "driving", "it to drive again")
        counters = rig.observer.status("plant")["counters"]
        journey = rig.finished(controller, plant)
    assert counters["planned"] + counters["braked"] > 0
    assert counters["refused"] == counters["rejected"] == 0
    meanwhile = journey.between(broken_ns, joined_ns)
    assert meanwhile[-1].x[3] < 0.5 * meanwhile[0].x[3]
    assert "driving" in journey.phases(joined_ns, journey.states[-1].source_time_ns)


@pytest.mark.check
def test_a_router_started_again_is_found_by_both(tmp_path: Path, course: Course) -> None:
    with rigged(tmp_path, course, "router") as rig:
        router = rig.start_router()
        controller, plant = rig.driving()
        router.kill()
        broken_ns = time.monotonic_ns()
        time.sleep(1.0)
        router = rig.start_router()
        seen = rig.state().seq
        until(lambda: rig.state().seq > seen, "a state through the new router")
        rig.drive_on()
        until(lambda: rig.observer.status("controller")["phase"] == "driving", "it to drive again")
        journey = rig.finished(controller, plant, router)
    after = [state for state in journey.states if state.source_time_ns > broken_ns]
    assert {state.epoch for state in after} == {journey.states[0].epoch}
