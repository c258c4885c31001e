"""The plant: a car that stays within its limits whatever input it gets, and stays at standstill."""

import math
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bayesrace.codegen.compiler import Compiler, compiled
from bayesrace.errors import InputError
from bayesrace.integrators import Discretisation
from bayesrace.plant.car import LineCounter
from bayesrace.plant.simulator import Simulator
from bayesrace.vehicles import get_car
from bayesrace.vehicles.models import dynamic

CAR = get_car("orca")
SIMULATOR = Simulator(dynamic(CAR))
COMPILED = Simulator(dynamic(CAR), compiled=compiled)
ANY_FLOAT = st.floats(allow_nan=True, allow_infinity=True)
START = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)

driving_states = st.tuples(
    st.floats(-5, 5),
    st.floats(-5, 5),
    st.floats(-6, 6),
    st.floats(0.0, 4.0),
    st.floats(-0.5, 0.5),
    st.floats(-6, 6),
    st.floats(-CAR.delta_max_rad, CAR.delta_max_rad),
)


@settings(deadline=None)
@given(driving_states, st.lists(st.tuples(ANY_FLOAT, ANY_FLOAT) | st.none(), max_size=8))
def test_limits_hold_for_any_input(
    x0: tuple[float, ...], inputs: list[tuple[float, float] | None]
) -> None:
    SIMULATOR.reset(x0)
    before = asdict(SIMULATOR.guard.counters)
    for u in inputs:
        SIMULATOR.step(u)
        d, rate = SIMULATOR.u_applied
        assert CAR.d_min <= d <= CAR.d_max
        assert abs(rate) <= CAR.delta_rate_max_radps
        assert abs(SIMULATOR.x[6]) <= CAR.delta_max_rad
        assert np.isfinite(SIMULATOR.x).all()
    after = asdict(SIMULATOR.guard.counters)
    bad = [u for u in inputs if u is not None and not (math.isfinite(u[0]) and math.isfinite(u[1]))]
    assert after["rejected"] - before["rejected"] == len(bad)
    assert after["braked"] - before["braked"] == len(bad) + inputs.count(None)


@settings(deadline=None)
@given(driving_states, st.lists(st.tuples(st.floats(-2, 2), st.floats(-9, 9)), max_size=5))
def test_a_mirrored_car_drives_the_mirrored_way(
    x0: tuple[float, ...], inputs: list[tuple[float, float]]
) -> None:
    """The dynamics know neither left nor right: y, psi, vy, omega, delta change sign."""
    mirror = np.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0, -1.0])
    SIMULATOR.reset(x0)
    for u in inputs:
        SIMULATOR.step(u)
    expected = mirror * SIMULATOR.x
    SIMULATOR.reset(tuple(mirror * np.array(x0)))
    for d, rate in inputs:
        SIMULATOR.step((d, -rate))
    np.testing.assert_allclose(SIMULATOR.x, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("u", [None, (0.0, 0.0), (CAR.d_min, 0.0), (math.nan, 0.0)])
def test_a_standing_car_is_never_braked_backwards(u: tuple[float, float] | None) -> None:
    """The guard brakes to standstill; even a full brake command cannot push past rolling resistance
    (d_min Cm1 = -.029 N against Cr0 = .052 N) by more than a creep."""
    SIMULATOR.reset((0.0,) * 7)
    for _ in range(100):
        SIMULATOR.step(u)
    if u is None or u[0] == 0.0 or math.isnan(u[0]):
        np.testing.assert_array_equal(SIMULATOR.x, np.zeros(7))
    else:
        assert -0.02 < SIMULATOR.x[3] <= 0.0


def test_without_commands_a_rolling_car_brakes_to_a_stand_and_stays() -> None:
    SIMULATOR.reset((0.0, 0.0, 0.0, 3.0, 0.0, 0.0, 0.1))
    speeds = []
    for _ in range(300):
        SIMULATOR.step(None)
        speeds.append(float(SIMULATOR.x[3]))
    assert SIMULATOR.x[6] == 0.1, "steering is held"
    assert max(np.diff(speeds)) <= 1e-9
    assert abs(speeds[-1]) < 1e-3
    assert min(speeds) > -1e-3


def test_the_steering_angle_is_exactly_the_sum_of_what_was_applied() -> None:
    """delta_next = delta + Ts * rate: with equality, so that a plan can rely on it."""
    SIMULATOR.reset(START)
    delta = 0.0
    for rate in (1.0, 5.0, 7.0, 5.0, 5.0, -3.0, -9.0):
        SIMULATOR.step((0.1, rate))
        applied = SIMULATOR.u_applied[1]
        delta = min(max(delta + 0.02 * applied, -CAR.delta_max_rad), CAR.delta_max_rad)
        assert SIMULATOR.x[6] == delta
    SIMULATOR.reset((*START[:6], CAR.delta_max_rad - 0.01))
    SIMULATOR.step((0.1, 5.0))
    assert SIMULATOR.u_applied[1] == pytest.approx(0.5)
    assert SIMULATOR.x[6] == pytest.approx(CAR.delta_max_rad, abs=1e-15)


def test_a_command_that_changes_within_the_period_acts_from_there() -> None:
    """Against two simulators of half the period each."""
    half = Simulator(dynamic(CAR), Discretisation(scheme="rk4", step_s=0.01, substeps=10))
    half.reset(START)
    half.step((0.5, 2.0))
    half.step(None)
    SIMULATOR.reset(START)
    SIMULATOR.step_switched([(10, (0.5, 2.0)), (10, None)])
    np.testing.assert_allclose(SIMULATOR.x, half.x, rtol=0, atol=1e-12)
    assert SIMULATOR.u_applied == pytest.approx(((0.5 + CAR.d_min) / 2, 1.0))
    SIMULATOR.reset(START)
    SIMULATOR.step((0.5, 2.0))
    once = SIMULATOR.x.copy()
    SIMULATOR.reset(START)
    SIMULATOR.step_switched([(7, (0.5, 2.0)), (13, (0.5, 2.0))])
    np.testing.assert_allclose(SIMULATOR.x, once, rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match="20 substeps"):
        SIMULATOR.step_switched([(7, (0.5, 2.0))])


def test_the_plants_substeps_are_small_enough() -> None:
    """Halving them changes a hard second of driving by less than a micrometre."""
    fine = Simulator(dynamic(CAR), Discretisation(scheme="rk4", step_s=0.02, substeps=40))
    for simulator in (SIMULATOR, fine):
        simulator.reset((0.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0))
        for k in range(50):
            simulator.step((0.6, 4.0 if k % 20 < 5 else -4.0 if k % 20 < 10 else 0.0))
    np.testing.assert_allclose(SIMULATOR.x, fine.x, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("x0", "fault"),
    [
        ((0.0,) * 6, "7 finite numbers"),
        ((math.nan,) + (0.0,) * 6, "7 finite numbers"),
        ((0.0,) * 6 + (0.5,), "steers within ±0.35 rad"),
    ],
)
def test_an_impossible_start_is_refused(x0: tuple[float, ...], fault: str) -> None:
    with pytest.raises(InputError, match=fault):
        SIMULATOR.reset(x0)


def test_laps_count_forwards_and_backwards_crossings_within_the_track() -> None:
    line = LineCounter(1.0, 2.0, math.pi / 2, 0.2, 0.3)
    line.restart(1.0, 2.0)  # on the line: past it
    assert line.move(1.0, 2.5) == 0
    line.restart(1.0, 1.9)
    assert line.move(1.1, 2.05) == 1
    assert line.move(1.1, 1.95) == 0  # backwards: taken away again
    assert line.move(1.1, 1.90) == 0
    assert line.move(1.1, 2.0) == 1  # exactly on the line
    assert line.move(1.1, 2.4) == 1
    line.restart(1.0, 1.9)
    assert line.move(0.7, 2.1) == 1  # crosses .15 m to the left: within
    line.restart(0.7, 1.9)
    assert line.move(0.7, 2.1) == 0  # .3 m to the left: beyond its reach
    line.restart(1.25, 1.9)
    assert line.move(1.25, 2.1) == 1  # .25 m to the right: within


@settings(deadline=None)
@given(driving_states, st.lists(st.tuples(st.floats(-2, 2), st.floats(-9, 9)), max_size=5))
def test_compiled_equations_have_the_bits_of_interpreted_ones(
    x0: tuple[float, ...], inputs: list[tuple[float, float]]
) -> None:
    for simulator in (SIMULATOR, COMPILED):
        simulator.reset(x0)
        for u in inputs:
            simulator.step(u)
        simulator.step_switched([(7, (0.5, 1.0)), (13, None)])
    assert COMPILED.x.tobytes() == SIMULATOR.x.tobytes()


def test_without_a_compiler_the_equations_are_interpreted(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    def none() -> Compiler:
        raise InputError("no C compiler found")

    monkeypatch.setenv("BAYESRACE_CACHE", str(tmp_path))
    monkeypatch.setattr("bayesrace.codegen.compiler.find_compiler", none)
    simulator = Simulator(dynamic(CAR), compiled=compiled)
    assert "no C compiler found" in caplog.text
    SIMULATOR.reset(START)
    simulator.reset(START)
    SIMULATOR.step((0.5, 1.0))
    simulator.step((0.5, 1.0))
    assert simulator.x.tobytes() == SIMULATOR.x.tobytes()
