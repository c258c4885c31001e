"""A bad solution never reaches the actuators: each level by a real cause, in order, counted.

The fallback is C (controller/native/br_fallback.c), driven here by the control cycle's binding.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bayesrace.controller.driver import Level
from bayesrace.controller.interface import StepOutput
from bayesrace.controller.settings import FallbackSettings
from bayesrace.vehicles import default_car
from tests.cycle_rig import ScriptedLaw, scripted_driver, state

CAR = default_car()
PLAN = np.column_stack([np.linspace(0.1, 0.9, 8), np.linspace(1.0, 4.5, 8)])
STEP_S = 0.02
BUDGET_S = 1e-9


class Fallback:
    """What a cycle sends for the output of a step."""

    def __init__(self, artefact: Path, chosen: FallbackSettings) -> None:
        self._law = ScriptedLaw()
        self._driver = scripted_driver(artefact, self._law, fallback=chosen)
        self._seq = 0
        self._run = 1

    @property
    def levels(self) -> list[int]:
        """Cycles by level."""
        return self._driver.levels

    def new_run(self) -> None:
        """The next state is of another run."""
        self._driver.lost(silent=False)
        self._run += 1

    def decide(
        self, output: StepOutput | None, vx_mps: float, time_s: float, late_s: float = 0.0
    ) -> tuple[float, float, Level]:
        """d, delta_rate, level. No output: the step is broken. Late by a bit more, the time that
        the step takes."""
        self._law.answer = None if output is None else lambda _: output
        x = (0.0, 0.0, 0.0, vx_mps, 0.0, 0.0, 0.0)
        self._seq += 1
        received = state(self._seq, run=self._run, time_s=time_s, x=x, lockstep=True)
        assert self._driver.observe(received)
        budget_s = BUDGET_S if late_s else 0.0
        decision = self._driver.decide(time_s, budget_s, late_s)
        return decision.d, decision.delta_rate, decision.level


@pytest.fixture(name="fallback")
def fallbacks(kinematic_artefact: Path) -> Callable[..., Fallback]:
    """Makes one with the settings given."""
    return lambda **chosen: Fallback(kinematic_artefact, FallbackSettings(**chosen))


Make = Callable[..., Fallback]


def good() -> StepOutput:
    return StepOutput(u=PLAN[0].copy(), plan_u=PLAN.copy(), plan_step_s=STEP_S)


def bad() -> StepOutput:
    return StepOutput(u=np.array([0.5, 0.0]), status=3, plan_u=-PLAN)


def test_the_order_of_the_levels(fallback: Make) -> None:
    made = fallback(shifted_s=2 * STEP_S)
    assert made.decide(good(), 2.0, 0.0) == (0.1, 1.0, Level.SOLUTION)
    for row in (1, 2):
        assert made.decide(bad(), 2.0, row * STEP_S) == (*PLAN[row], Level.SHIFTED_PLAN)
    for row in range(3, 8):
        expected = (CAR.d_min, PLAN[row, 1], Level.BRAKE)
        assert made.decide(bad(), 2.0, row * STEP_S) == expected
    assert made.decide(None, 2.0, 8 * STEP_S) == (CAR.d_min, 0.0, Level.BRAKE)
    assert made.decide(None, 0.05, 9 * STEP_S) == (CAR.d_min / 2, 0.0, Level.STOP)
    assert made.decide(None, 0.0, 10 * STEP_S)[:2] == (0.0, 0.0)
    assert made.levels == [1, 2, 6, 2]


def test_the_plan_goes_by_time_not_by_cycles(fallback: Make) -> None:
    """At 500 Hz a row lasts ten cycles; where cycles were skipped, rows are too."""
    made = fallback()
    made.decide(good(), 2.0, 1.0)
    for cycle in range(1, 10):
        assert made.decide(bad(), 2.0, 1.0 + 0.002 * cycle)[:2] == tuple(PLAN[0])
    assert made.decide(bad(), 2.0, 1.0 + 0.02)[:2] == tuple(PLAN[1])
    assert made.decide(bad(), 2.0, 1.0 + 0.08)[:2] == tuple(PLAN[4])


def test_a_late_solution_is_driven_where_it_has_got_to(fallback: Make) -> None:
    made = fallback()
    assert made.decide(good(), 2.0, 0.0, late_s=0.015)[2] == Level.SOLUTION
    assert made.decide(good(), 2.0, 0.1, late_s=0.045) == (*PLAN[2], Level.SHIFTED_PLAN)
    assert made.decide(good(), 2.0, 0.2, late_s=0.15)[2] == Level.BRAKE


@pytest.mark.parametrize(
    ("shifted_s", "good_at", "vx_mps", "expected"),
    [
        # after level 1 at once, after level 2 with the third in a row
        (STEP_S, "+-+---++-++++", [2.0] * 13, [0, 1, 0, 1, 2, 2, 2, 2, 2, 2, 2, 0, 0]),
        # standing, with the first: where only every other one is good, three would never come
        (0.1, "-+-+", [0.0] * 4, [3, 0, 1, 0]),
        # a car that has come to stand does so too
        (0.0, "-++", [0.2, 0.15, 0.05], [2, 2, 0]),
    ],
    ids=["moving", "standing", "come to stand"],
)
def test_how_many_good_solutions_end_a_fallback(
    fallback: Make, shifted_s: float, good_at: str, vx_mps: list[float], expected: list[int]
) -> None:
    made = fallback(shifted_s=shifted_s, recover_cycles=3)
    levels = [
        made.decide(good() if sign == "+" else bad(), vx, k * STEP_S)[2]
        for k, (sign, vx) in enumerate(zip(good_at, vx_mps, strict=True))
    ]
    assert levels == expected


def test_a_good_status_does_not_excuse_an_impossible_input(fallback: Make) -> None:
    beyond, rate = CAR.d_max + 0.1, -CAR.delta_rate_max_radps - 0.1
    for u in ([np.nan, 0.0], [0.0, np.inf], [beyond, 0.0], [0.0, rate]):
        made = fallback()
        made.decide(good(), 1.0, 0.0)
        assert made.decide(StepOutput(u=np.array(u)), 1.0, STEP_S)[2] == Level.SHIFTED_PLAN


def test_rounding_beyond_a_limit_is_clipped(fallback: Make) -> None:
    output = StepOutput(u=np.array([CAR.d_max + 1e-9, 0.0]))
    assert fallback().decide(output, 1.0, 0.0) == (CAR.d_max, 0.0, Level.SOLUTION)


def test_a_new_run_does_not_drive_the_old_plan(fallback: Make) -> None:
    made = fallback()
    made.decide(good(), 1.0, 0.0)
    made.new_run()
    assert made.decide(bad(), 1.0, STEP_S) == (CAR.d_min, 0.0, Level.BRAKE)


def test_the_kept_plan_is_a_copy(fallback: Make) -> None:
    made = fallback()
    output = good()
    made.decide(output, 1.0, 0.0)
    output.plan_u[:] = 7.0
    assert made.decide(bad(), 1.0, STEP_S)[:2] == tuple(PLAN[1])


_any = st.floats(allow_nan=True, allow_infinity=True)


@settings(deadline=None)
@given(
    cycles=st.lists(
        st.tuples(
            st.integers(0, 2),
            st.tuples(_any, _any),
            st.lists(_any, min_size=6, max_size=6),
            st.floats(0.0, 0.2),
        ),
        max_size=20,
    ),
    vx=_any,
)
def test_whatever_the_solver_says_the_input_is_finite_and_within_limits(
    kinematic_artefact: Path,
    cycles: list[tuple[int, tuple[float, float], list[float], float]],
    vx: float,
) -> None:
    made = Fallback(kinematic_artefact, FallbackSettings())
    time_s = 0.0
    for status, u, plan, later_s in cycles:
        time_s += later_s
        output = StepOutput(u=np.array(u), status=status, plan_u=np.array(plan).reshape(3, 2))
        d, rate, _ = made.decide(output, vx, time_s, late_s=later_s)
        assert CAR.d_min <= d <= CAR.d_max
        assert abs(rate) <= CAR.delta_rate_max_radps
    assert sum(made.levels) == len(cycles)
