"""A real car behind the plant: its instruments' clocks, commands at once, and how its runs end."""

import queue
import re
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from bayesrace.errors import InputError
from bayesrace.messages import Actuation, BrakingPlan, Decoder, Numbering, RunRequest, State, Truth
from bayesrace.plant.car import End
from bayesrace.plant.hardware import Hardware, Report
from bayesrace.plant.run import Run, RunCounters
from bayesrace.transport import Inbox, Item, Kind, Publisher
from bayesrace.transport.hold import HoldWatch
from bayesrace.vehicles import get_car
from tests.driven import blank

pytestmark = pytest.mark.wall_clock

CLOCK_S = 5000.0
"""By which the cameras' clock is behind."""
DELAY_S = 0.01
EXACT = (0.1, 0.0, 0.0)


class Rolling(Hardware):
    """A car whose pose comes at 100 Hz, and that rolls until a command brakes it."""

    def __init__(self, pose: tuple[float, ...] = EXACT) -> None:
        super().__init__(get_car("orca"), delays_s={"pose": DELAY_S}, silent_s=0.15)
        self.sent: list[tuple[float, float, float, float]] = []
        self.pose, self.vx_mps, self.seen = list(pose), 0.0, True

    def receive(self) -> Report | None:
        time.sleep(0.01)
        self.pose[0] += 0.01 * self.vx_mps
        if not self.seen:
            return None
        values = {name: (one, 1e-3) for name, one in zip(("x", "y", "psi"), self.pose, strict=True)}
        return Report("pose", values, time.monotonic() - DELAY_S - CLOCK_S)

    def send(self, d: float, delta_rad: float, rate_radps: float) -> None:
        self.sent.append((time.monotonic(), d, delta_rad, rate_radps))
        self.vx_mps = 0.5 if d > 0 else max(self.vx_mps - 0.1, 0.0)


@pytest.fixture
def car() -> Iterator[Rolling]:
    with Rolling() as hardware:
        time.sleep(0.2)
        yield hardware


class Controller:
    """Inbox and publisher in one: each state is answered some milliseconds later."""

    def __init__(self, answer: Callable[[State], list[Any]]) -> None:
        self._answer, self._queue = answer, queue.Queue[Item]()
        self.states: list[State] = []
        self.answered_s: list[float] = []

    @property
    def next_seq(self) -> int:
        return len(self.states)

    def put(self, state: State | Truth, *, lockstep: bool) -> None:
        assert isinstance(state, State), "there is no truth of a real car"
        assert not lockstep
        self.states.append(state)
        for message in self._answer(state):
            name = "actuation" if isinstance(message, Actuation) else "braking"
            self._queue.put(Item(Kind.MESSAGE, name, message, time.monotonic_ns()))

    @property
    def queued(self) -> int:
        return self._queue.qsize()

    def get(self, timeout_s: float = 0.0) -> Item | None:
        try:
            return self._queue.get(timeout_s > 0, timeout_s)
        except queue.Empty:
            return None

    def stamped(self) -> AbstractContextManager[None]:
        return nullcontext()


def full(state: State) -> list[Any]:
    """Drive on, to the left; and a plan that brakes to the right."""
    drive = blank(
        Actuation, epoch=state.epoch, run=state.run, state_seq=state.seq,
        decided_at_s=state.time_s, u=(1.0, 1.0),
    )  # fmt: skip
    plan = blank(
        BrakingPlan, epoch=state.epoch, run=state.run, begins_s=state.time_s, step_s=0.02,
        d=(-0.1,) * 20, delta=tuple(-0.01 * i for i in range(20)),
    )  # fmt: skip
    return [drive, plan]


def run_of(
    car: Rolling,
    answer: Callable[[State], list[Any]],
    beat: Callable[[], End | None] = lambda: None,
    hold: Any = SimpleNamespace(missing=False),  # noqa: B008 - never written to
) -> tuple[Controller, End]:
    controller = Controller(answer)
    wanted = blank(
        RunRequest, run=1, lockstep=False, x0=(0.0,) * 7, line_left_m=1.0, line_right_m=1.0,
        max_time_s=0.3, actuation_timeout_s=0.1,
    )  # fmt: skip
    run = Run(
        request=wanted, simulator=car, inbox=cast(Inbox, controller),
        states=cast(Publisher[State], controller), truths=cast(Publisher[Truth], controller),
        decoder=Decoder(Actuation), counters=RunCounters(), numbering=Numbering(),
        react=lambda _: None, beat=beat, pause=lambda _: None, suspended=lambda _: None,
        hold=cast(HoldWatch, hold), epoch=7,
    )  # fmt: skip
    return controller, run.execute()


def test_it_is_seen_in_plant_time_and_driven_at_once(car: Rolling) -> None:
    controller, end = run_of(car, full)
    states = controller.states
    assert all(state.estimated for state in states)
    readings = [(state.time_s - one.time_s) for state in states for one in state.readings]
    assert len(readings) > 20
    assert min(readings) >= 0
    assert DELAY_S - 0.002 < np.median(readings) < DELAY_S + 0.02
    # By most states: on a busy machine a period is late now and then.
    moved = np.median([state.u_applied for state in states[4:13]], axis=0)
    assert moved[0] == pytest.approx(1.0, abs=0.1)
    assert moved[1] == pytest.approx(1.0, abs=0.2)
    driven = [delta for _, d, delta, _ in car.sent if d > 0]
    assert driven[10] == pytest.approx(0.02 * 10 / 2, abs=0.05)
    # The run is over when the car stands, by the plan that was sent ahead.
    assert end.reason == "max_time"
    assert car.vx_mps == 0
    assert car.sent[-1][2] < max(driven)
    assert [state.final for state in states] == [False] * (len(states) - 1) + [True]


def test_a_run_that_is_given_up_ends_when_the_car_stands(car: Rolling) -> None:
    given_up: list[float] = []

    def beat() -> End | None:
        given_up.append(car.vx_mps)
        return End("abandoned", "no director") if len(given_up) > 8 else None

    _, end = run_of(car, full, beat)
    assert end.reason == "abandoned"
    assert given_up[8] > 0
    assert car.vx_mps == 0


def test_a_stop_after_its_director_is_lost_does_not_end_the_run_of_a_rolling_car(
    car: Rolling,
) -> None:
    hold, rolled_mps = SimpleNamespace(missing=False), list[float]()

    def beat() -> End | None:
        rolled_mps.append(car.vx_mps)
        hold.missing = len(rolled_mps) > 8
        return End("stopped", "on request") if len(rolled_mps) == 10 else None

    _, end = run_of(car, full, beat, hold)
    assert end.reason == "stopped"
    assert rolled_mps[9] > 0
    assert car.vx_mps == 0


def test_a_command_is_sent_when_it_comes(car: Rolling) -> None:
    came: list[float] = []

    def answer(state: State) -> list[Any]:
        came.append(time.monotonic())
        return full(state)[:1]

    run_of(car, answer)
    first = next(at for at, d, _, _ in car.sent if d > 0)
    assert first - came[0] < 0.015


def test_a_car_that_is_not_seen_is_stopped_and_the_run_says_so(car: Rolling) -> None:
    def answer(state: State) -> list[Any]:
        car.seen = state.seq < 5
        return full(state)

    _, end = run_of(car, answer)
    assert end.reason == "plant_fault"
    assert "no pose of the car for 0.15 s" in end.text
    assert car.sent[-1][1] < 0


@pytest.mark.parametrize(
    ("pose", "word"),
    [((-0.1, 0, 0), "past the start line"), ((0.1, 0, 3), "turned"), ((0.1, 2, 0), "to its left")],
)
def test_a_car_that_stands_elsewhere_is_not_driven(pose: tuple[float, ...], word: str) -> None:
    with Rolling(pose) as car:
        time.sleep(0.2)
        with pytest.raises(InputError, match=word):
            run_of(car, full)
    with Rolling() as unseen:
        unseen.seen = False
        with pytest.raises(InputError, match="no pose"):
            run_of(unseen, full)


def test_what_is_no_measurement_is_counted(car: Rolling) -> None:
    for values in ({"x": (float("nan"), 1.0)}, {"speed": (1.0, 1.0)}, {"x": (1.0, 0.0)}, {}):
        car._reports.append((Report("odd", values), time.monotonic_ns()))
    text = car.report()
    assert "4 unusable reports" in text
    assert "odd" not in text
    assert re.search(r"\bpose [1-9]\d+ Hz", text)  # 100, and fewer on a loaded machine


def test_a_clock_that_is_set_anew_is_followed(car: Rolling) -> None:
    run_of(car, full)
    one = car._instruments["pose"]
    now_ns = time.monotonic_ns()
    assert one.measured_ns(7.0, now_ns) == now_ns - round(DELAY_S * 1e9)
