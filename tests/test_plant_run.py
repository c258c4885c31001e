"""The plant in real time, with what arrives given: it guards itself against its controller."""

import contextlib
import sys
import time
from collections import deque
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from bayesrace.messages import Actuation, BrakingPlan, Decoder, Numbering, RunRequest, State, Truth
from bayesrace.plant.car import End
from bayesrace.plant.run import Run, RunCounters
from bayesrace.plant.vehicle import GuardCounters, Vehicle, open_vehicle
from bayesrace.transport import Inbox, Item, Kind, Publisher
from bayesrace.transport.hold import HoldWatch
from bayesrace.vehicles import get_car
from tests.car_fmu import packed_car

pytestmark = pytest.mark.wall_clock

EPOCH = 7

NEVER = -1.0
"""Of an input that another one has overtaken: after a stall of the machine two may act at once."""

VEHICLE = cast(Vehicle, None)
"""What simulates the car, in the current test."""


class Controller:
    """Answers each state with what ``answer`` makes of it; inbox and publisher in one."""

    def __init__(self, answer: Any) -> None:
        self._answer = answer
        self._items: deque[Item] = deque()
        self.states: list[State] = []
        self.truth: list[Truth] = []

    @property
    def next_seq(self) -> int:
        return len(self.states)

    def put(self, state: State | Truth, *, lockstep: bool) -> None:
        assert not lockstep
        if isinstance(state, Truth):
            self.truth.append(state)
            return
        assert len(self.truth) == len(self.states), "the truth comes before its measurement"
        self.states.append(state)
        for changes in self._answer(state):
            values = {
                "seq": len(self.states) - 1, "source_time_ns": 0, "epoch": state.epoch,
                "run": state.run, "state_seq": state.seq, "decided_at_s": state.time_s,
                "u": (1.0, 0.0), "weights_version": "", "status": 0,
            }  # fmt: skip
            if changes.pop("stop", False):
                self.ask_again(Item(Kind.REQUEST, "stop", None, 0))
            if (plan := changes.pop("plan", None)) is not None:
                self._items.append(Item(Kind.MESSAGE, "braking", plan, time.monotonic_ns()))
            actuation = Actuation(**(values | changes))
            self._items.append(Item(Kind.MESSAGE, "actuation", actuation, time.monotonic_ns()))

    @property
    def queued(self) -> int:
        return len(self._items)

    def get(self) -> Item | None:
        return self._items.popleft() if self._items else None

    def ask_again(self, request: Item) -> None:
        """As a client that sends the next request as soon as the last one is answered."""
        self._items.append(request)

    def react(self, request: Item) -> End | None:
        """As a plant that is asked to stop, and to say something again and again."""
        if request.name == "stop":
            return End("stopped", "stopped on request")
        self.ask_again(request)
        return None

    @contextlib.contextmanager
    def stamped(self) -> Iterator[None]:
        yield


@pytest.fixture(params=["built-in car", pytest.param("FMU", marks=pytest.mark.check)], autouse=True)
def _simulated_by(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> Iterator[None]:
    """Every promise holds whatever simulates the car."""
    fmu = packed_car() if request.param == "FMU" else None
    with open_vehicle(get_car("orca"), fmu) as vehicle:
        monkeypatch.setattr(sys.modules[__name__], "VEHICLE", vehicle)
        yield


def execute(
    answer: Any, delay_s: float = 0.0, flooded: bool = False
) -> tuple[list[State], RunCounters, GuardCounters]:
    """A run of .3 s in which a state is answered by actuations with these changes."""
    controller = Controller(answer)
    counters, guarded, _ = run_with(controller, SimpleNamespace(missing=False), delay_s, flooded)
    return controller.states, counters, guarded


def run_with(
    controller: Controller, hold: SimpleNamespace, delay_s: float = 0.0, flooded: bool = False
) -> tuple[RunCounters, GuardCounters, End]:
    counters, simulator = RunCounters(), VEHICLE
    suspensions: list[float] = []
    if flooded:
        controller.ask_again(Item(Kind.REQUEST, "status", None, 0))
    simulator.guard.counters = GuardCounters()
    start = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
    request = RunRequest(
        seq=0,
        source_time_ns=0,
        run=1,
        lockstep=False,
        x0=start,
        line_x_m=0.0,
        line_y_m=0.0,
        line_heading_rad=0.0,
        line_left_m=1.0,
        line_right_m=1.0,
        laps=0,
        max_time_s=0.3,
        actuation_timeout_s=0.1,
        held=True,
        exact=False,
        pause_s=0.0,
    )
    run = Run(
        request=request, simulator=simulator, inbox=cast(Inbox, controller),
        states=cast(Publisher[State], controller),
        truths=cast(Publisher[Truth], controller), decoder=Decoder(Actuation), counters=counters,
        numbering=Numbering(), react=controller.react, beat=lambda: None, epoch=EPOCH,
        pause=lambda _: None, suspended=suspensions.append, delay_s=delay_s,
        hold=cast(HoldWatch, hold),
    )  # fmt: skip
    end = run.execute()
    assert len(suspensions) == counters.suspended
    return counters, simulator.guard.counters, end


def test_an_answered_car_drives_and_the_delays_are_reported() -> None:
    states, counters, guarded = execute(lambda _: [{}])
    assert counters.stale == 0
    assert guarded.braked < 8
    assert states[-1].final
    assert states[-1].x[3] > 1.0
    rows = np.array([row for state in states for row in state.actuation_delays]).reshape(-1, 3)
    assert rows[:, 0].tolist() == list(range(len(rows)))
    assert (rows[:, 1] >= 0).all()
    acted = rows[rows[:, 2] != NEVER]
    assert (acted[:, 2] > acted[:, 1] - 1e-3).all()  # it acts from the next substep on


def test_requests_without_end_do_not_hold_up_the_car() -> None:
    states, counters, guarded = execute(lambda _: [{}], flooded=True)
    assert (states[-1].final, counters.stale) == (True, 0)
    assert guarded.braked < 8


def test_an_injected_delay_comes_on_both_ways() -> None:
    states, _, _ = execute(lambda _: [{}], delay_s=0.03)
    rows = np.array([row for state in states for row in state.actuation_delays]).reshape(-1, 3)
    acted = rows[rows[:, 2] != NEVER]
    assert len(acted) > 3
    assert (rows[:, 1] >= 0.06).all()
    assert (acted[:, 2] >= 0.06).all()


@pytest.mark.parametrize(
    "changes",
    [
        {"epoch": EPOCH + 1},  # an answer to the plant before a restart, its numbers plausible
        {"run": 2},
        {"state_seq": 10**6},
        {"decided_at_s": 1e6},  # it would never grow old, and overtake all that follow
    ],
)
def test_what_is_not_for_this_run_does_not_act(changes: dict[str, Any]) -> None:
    _, counters, guarded = execute(lambda _: [changes])
    assert counters.stale > 5
    assert guarded.braked > 12
    # and what is, does, whatever came before it
    _, counters, guarded = execute(lambda _: [changes, {}])
    assert counters.stale > 5
    assert guarded.braked < 8


def test_an_overtaken_answer_is_reported_and_does_not_act() -> None:
    def late_copy(state: State) -> list[dict[str, Any]]:
        old = {"u": (-0.1, 0.0), "decided_at_s": max(state.time_s - 0.02, 0.0)}
        return [{}, old] if state.seq else [{}]

    states, counters, _ = execute(late_copy)
    rows = np.array([row for state in states for row in state.actuation_delays]).reshape(-1, 3)
    assert (rows[:, 2] == NEVER).sum() >= counters.stale > 5
    assert states[-1].x[3] > 1.0


@pytest.mark.parametrize(("run", "is_planned"), [(1, True), (2, False)])
def test_a_plan_is_carried_out_when_answers_are_overdue(run: int, is_planned: bool) -> None:
    """With its steering, until answers take over again; none of another run.

    Six substeps are overdue, and more on a machine that stalls: the end says that it ends.
    """

    def answer(state: State) -> list[dict[str, Any]]:
        if 3 <= state.seq < 10:
            return []
        plan = BrakingPlan(
            seq=0, source_time_ns=0, epoch=EPOCH, run=run, begins_s=state.time_s, step_s=0.02,
            d=(-0.1,) * 20, delta=tuple(0.01 * i for i in range(20)),
        )  # fmt: skip
        return [{"plan": plan}]

    states, _, guarded = execute(answer)
    assert guarded.planned > 2 if is_planned else guarded.planned == 0
    if is_planned:
        assert max(state.x[6] for state in states[:11]) > 0.045  # the plan's own: 0.01 a period
        assert states[9].u_applied[0] < 0
    assert states[-1].u_applied[0] > 0.9


def test_without_fresh_answers_the_plant_brakes() -> None:
    states, _, guarded = execute(lambda state: [{}] if state.seq < 3 else [])
    assert guarded.braked > 4
    assert states[-1].x[3] < max(state.x[3] for state in states)


def test_plant_time_stands_still_while_the_process_does_not_run() -> None:
    """Bug guarded: after a suspension the plant drove through all periods missed, uncontrolled."""

    def answer(state: State) -> list[dict[str, Any]]:
        if state.seq == 5:
            time.sleep(1.3)
        return [{}]

    states, counters, guarded = execute(answer)
    assert counters.suspended == 1
    assert counters.overruns < 3
    assert guarded.braked < 8
    assert states[-1].time_s == pytest.approx(0.3)
    assert states[-1].x[3] > 1.0


@pytest.mark.parametrize("planned", [True, False], ids=["plan", "no plan"])
def test_nothing_drives_a_car_whose_director_is_missing(planned: bool) -> None:
    """Whatever its controller sends, and though the director is there again: the run ends when the
    car stands, by the plan from before, and not regularly, though its time is up meanwhile."""
    hold, taken = SimpleNamespace(missing=False), []

    def answer(state: State) -> list[dict[str, Any]]:
        hold.missing = 5 <= state.seq < 8
        plan = BrakingPlan(
            seq=0, source_time_ns=0, epoch=EPOCH, run=1, begins_s=state.time_s, step_s=0.02,
            d=(1.0 if state.seq >= 8 else -0.1,) * 20, delta=(0.0,) * 20,
        )  # fmt: skip
        taken.append(state.u_applied[0])
        return [{"plan": plan}] if planned else [{}]

    controller = Controller(answer)
    counters, guarded, end = run_with(controller, hold)
    assert (end.reason, counters.holds_lost) == ("hold_lost", 1)
    assert "director" in end.text
    assert (guarded.planned > 10) == planned
    assert guarded.braked > 10
    assert max(taken[3:6]) > 0.9
    assert max(taken[8:]) <= 0.0
    assert controller.states[-1].final
    assert abs(controller.states[-1].x[3]) < 0.02


def test_a_run_that_is_stopped_says_so_in_a_final_state() -> None:
    """Without it the controller would miss a director that has done its part; the one who stops the
    run is there, though late."""
    hold = SimpleNamespace(missing=False)

    def answer(state: State) -> list[dict[str, Any]]:
        hold.missing = state.seq == 5
        return [{"stop": hold.missing}]

    controller = Controller(answer)
    counters, _, end = run_with(controller, hold)
    assert (end.reason, counters.holds_lost) == ("stopped", 0)
    assert [one.final for one in controller.states[-2:]] == [False, True]
