"""A bad solution never reaches the actuators: each level by a real cause, in order, counted."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bayesrace.vehicles.parameters import get_car
from controller.fallback import Fallback, FallbackSettings, Level
from controller.interface import StepOutput

CAR = get_car("orca")
PLAN = np.column_stack([np.linspace(0.1, 0.9, 8), np.linspace(1.0, 4.5, 8)])


def good() -> StepOutput:
    return StepOutput(u=PLAN[0].copy(), plan_u=PLAN.copy())


def bad() -> StepOutput:
    return StepOutput(u=np.array([0.5, 0.0]), status=3, plan_u=-PLAN)


def test_the_order_of_the_levels() -> None:
    fallback = Fallback(CAR, FallbackSettings(shifted_cycles=2))
    assert fallback.decide(good(), 2.0) == (0.1, 1.0, Level.SOLUTION)
    for row in (1, 2):
        assert fallback.decide(bad(), 2.0) == (*PLAN[row], Level.SHIFTED_PLAN)
    for row in range(3, 8):
        assert fallback.decide(bad(), 2.0) == (CAR.d_min, PLAN[row, 1], Level.BRAKE)
    assert fallback.decide(None, 2.0) == (CAR.d_min, 0.0, Level.STOP)
    assert fallback.decide(None, 0.05) == (CAR.d_min / 2, 0.0, Level.STOP)
    assert fallback.decide(None, 0.0)[:2] == (0.0, 0.0)
    assert fallback.decide(good(), 0.0)[2] == Level.SOLUTION
    assert fallback.counts == [2, 2, 5, 3]


@pytest.mark.parametrize(
    "u",
    [
        [np.nan, 0.0],
        [0.0, np.inf],
        [CAR.d_max + 0.1, 0.0],
        [0.0, -CAR.delta_rate_max_radps - 0.1],
    ],
)
def test_a_good_status_does_not_excuse_an_impossible_input(u: list[float]) -> None:
    fallback = Fallback(CAR)
    fallback.decide(good(), 1.0)
    assert fallback.decide(StepOutput(u=np.array(u)), 1.0)[2] == Level.SHIFTED_PLAN


def test_rounding_beyond_a_limit_is_clipped() -> None:
    output = StepOutput(u=np.array([CAR.d_max + 1e-9, 0.0]))
    assert Fallback(CAR).decide(output, 1.0) == (CAR.d_max, 0.0, Level.SOLUTION)


def test_a_new_run_does_not_drive_the_old_plan() -> None:
    fallback = Fallback(CAR)
    fallback.decide(good(), 1.0)
    fallback.reset()
    assert fallback.decide(bad(), 1.0)[2] == Level.STOP


def test_the_kept_plan_is_a_copy() -> None:
    fallback = Fallback(CAR)
    output = good()
    fallback.decide(output, 1.0)
    output.plan_u[:] = 7.0
    assert fallback.decide(bad(), 1.0)[:2] == tuple(PLAN[1])


_any = st.floats(allow_nan=True, allow_infinity=True)


@given(
    st.lists(
        st.tuples(st.integers(0, 2), st.tuples(_any, _any), st.lists(_any, min_size=6, max_size=6)),
        max_size=20,
    ),
    _any,
)
def test_whatever_the_solver_says_the_input_is_finite_and_within_limits(
    cycles: list[tuple[int, tuple[float, float], list[float]]], vx: float
) -> None:
    fallback = Fallback(CAR)
    for status, u, plan in cycles:
        output = StepOutput(u=np.array(u), status=status, plan_u=np.array(plan).reshape(3, 2))
        d, rate, _ = fallback.decide(output, vx)
        assert CAR.d_min <= d <= CAR.d_max
        assert abs(rate) <= CAR.delta_rate_max_radps
    assert sum(fallback.counts) == len(cycles)
