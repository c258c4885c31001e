"""Errors that the standard deviations do not cover widen them, so that a car that has changed since
it was learned is driven with care."""

import numpy as np
import pytest

from bayesrace.arrays import Floats
from bayesrace.controller.assembly import PredictiveController, compiled_controller
from bayesrace.controller.driver import Driver
from bayesrace.controller.native_step import NativeStep
from bayesrace.controller.process_settings import ControllerSettings
from bayesrace.controller.settings import MpcSettings
from bayesrace.errors import InputError
from bayesrace.gp.weights import GpWeights
from bayesrace.integrators import PREDICTION
from bayesrace.learning.validation import predictive_sigma
from bayesrace.operation.closed_loop import ClosedLoop, built_in_car
from bayesrace.vehicles import CarParameters
from tests.conftest import CAUTIOUS, Circuit, Make
from tests.cycle_rig import state
from tests.racing import racing

STEP_S = PREDICTION.step_s


@pytest.fixture
def step(make: Make) -> NativeStep:
    return make(caution=0.95)


def drive(
    step: NativeStep, circuit: Circuit, off: Floats, count: int, prepared: bool = False
) -> tuple[list[float], Floats, Floats]:
    """The widening of each step, and states (n + 1, 7) and inputs (n, 2) of a car that does in each
    step what the controller predicts, plus ``off`` in vx, vy, omega."""
    x, u = circuit.start(), np.zeros(2)
    widening, states, inputs = [], [x], []
    for _ in range(count):
        assert step.step(x, u).usable
        widening.append(step.info.widening)
        u = step.u.copy()
        if prepared:
            step.prepare()
        after = step.predict(x, u, STEP_S)
        after[3:6] += off
        step.observe(x, u, STEP_S, after)
        states.append(after)
        inputs.append(u)
        x = after
    return widening, np.array(states), np.array(inputs)


def test_the_band_widens_by_the_errors_that_exceed_it(
    step: NativeStep, weights: GpWeights, circuit: Circuit
) -> None:
    """Against scikit-learn's standard deviations: the mean over ten steps, its largest held."""
    off = np.array([0.03, 0.01, 1.0])
    widening, states, inputs = drive(step, circuit, off, 40)
    sigma = predictive_sigma(weights, np.column_stack([states[:-1, 3:], inputs]))
    recent = held = np.ones(3)
    expected = [1.0, 1.0]  # what is observed before a step counts from the one after it on
    for ratio in np.minimum(np.abs(off) / sigma, 200)[:-2]:
        recent = recent + (ratio - recent) / 10
        held = np.maximum(recent, held * (1 - 1 / 500))
        expected.append(1 + 1.25 * max(0.0, float(held.max()) - 3))
    assert expected[-1] > 3
    np.testing.assert_allclose(widening, expected, rtol=1e-5)


def test_a_band_that_covers_the_errors_stays_as_it_is(step: NativeStep, circuit: Circuit) -> None:
    widening, _, _ = drive(step, circuit, np.zeros(3), 20)
    assert set(widening) == {1.0}


def test_the_preparation_changes_nothing(make: Make, car: CarParameters, circuit: Circuit) -> None:
    """Also if parameters are set between it and the step."""
    ends = []
    for prepared in (False, True):
        step = make(caution=0.95)
        first, _, _ = drive(step, circuit, np.array([0.03, 0.01, 1.0]), 20, prepared)
        step.set_parameters(car, CAUTIOUS.model_copy(update={"caution": 0.9}))
        again, states, inputs = drive(step, circuit, np.zeros(3), 5, prepared)
        ends.append((first, again, states.tobytes(), inputs.tobytes()))
    assert ends[0] == ends[1]


def test_new_weights_and_a_new_run_begin_with_their_own_band(
    step: NativeStep, weights: GpWeights, circuit: Circuit
) -> None:
    off = np.array([0.1, 0.1, 3.0])
    assert drive(step, circuit, off, 15)[0][-1] > 1.3
    step.set_weights(weights)
    assert drive(step, circuit, off, 1)[0] == [1.0]
    assert drive(step, circuit, off, 15)[0][-1] > 1.3
    step.reset()
    assert drive(step, circuit, off, 1)[0] == [1.0]


def test_the_wider_the_band_the_more_slowly_the_reference_recovers(
    step: NativeStep, car: CarParameters, circuit: Circuit
) -> None:
    """The reference rises again more slowly in the measure that the band is widened by over 4."""
    _, states, inputs = drive(step, circuit, np.array([0.1, 0.1, 3.0]), 30)
    slow = step.info.pace
    assert slow < 0.9
    assert step.info.widening > 8
    step.set_parameters(car, CAUTIOUS.model_copy(update={"constraints": False}))
    assert step.step(states[-1], inputs[-1]).usable
    rise = step.info.pace / slow - 1
    faster = car.tuning.caution.faster_ps * STEP_S
    assert rise == pytest.approx(faster / (step.info.widening / 4), rel=1e-6)


def test_durations_and_numbers_that_are_none_are_refused(step: NativeStep) -> None:
    for duration_s in (0.0, -0.1, 1.5, np.nan):
        with pytest.raises(InputError, match="a time"):
            step.observe(np.zeros(7), np.zeros(2), duration_s, np.zeros(7))
    with pytest.raises(InputError, match="not finite"):
        step.observe(np.zeros(7), np.zeros(2), STEP_S, np.full(7, np.nan))


def test_twice_the_error_in_twice_the_time_counts_twice(make: Make, circuit: Circuit) -> None:
    """In the mean over time: the error of each stage is the same."""
    last = []
    for stages in (1, 2):
        step = make(caution=0.95)
        x, u = circuit.start(), np.zeros(2)
        for _ in range(3):
            assert step.step(x, u).usable
            after = step.predict(x, u, stages * STEP_S)
            after[5] += 10 * stages
            step.observe(x, u, stages * STEP_S, after)
        last.append((step.info.widening - 1) / 1.25 + 2)
    assert last[0] > 2
    assert last[1] == pytest.approx(2 * last[0], rel=1e-6)


def test_one_wrong_measurement_does_not_widen_the_band_for_long(
    step: NativeStep, circuit: Circuit
) -> None:
    """It counts as two hundred standard deviations at most, in a mean over ten steps."""
    x, u = circuit.start(), np.zeros(2)
    for k in range(3):
        assert step.step(x, u).usable
        after = step.predict(x, u, STEP_S)
        if k == 0:
            after[3:6] += 50.0
        step.observe(x, u, STEP_S, after)
    assert 20 < step.info.widening < 25


@pytest.mark.parametrize(
    ("numbers", "vx_mps", "widens"),
    [(range(12), 1.0, True), (range(0, 24, 2), 1.0, False), (range(12), 0.0, False)],
    ids=["in a row", "gaps", "standing"],
)
def test_the_cycle_shows_states_in_a_row_of_a_car_that_moves(
    step: NativeStep,
    car: CarParameters,
    circuit: Circuit,
    numbers: range,
    vx_mps: float,
    widens: bool,
) -> None:
    """Its yaw rate is another each time, which no model predicts, and no monitor would believe."""
    settings = ControllerSettings(stale_s=0.1, sensor_tolerance=0)
    driver = Driver(PredictiveController(step), car, settings)
    for number in numbers:
        x = circuit.start()
        x[3], x[5] = vx_mps, 8.0 * (-1) ** number
        driver.observe(state(number, x=tuple(x)))
        driver.decide(number * STEP_S)
        driver.prepare(STEP_S)
    assert driver.output is not None
    widening = driver.output.numbers["widening"]
    assert widening > 2 if widens else widening == 1.0


@pytest.mark.check
def test_a_car_that_has_lost_grip_since_it_was_learned_stays_on_the_track() -> None:
    """A fifth of the tyre forces of the car that the weights and the line are made for."""
    race = racing("random:8")
    slippery = built_in_car(
        race.car.model_copy(update={"tyres": race.car.true_tyres.with_grip(0.8)})
    )
    samples = []
    for mpc in (MpcSettings(caution=0.0), MpcSettings()):
        controller = compiled_controller(
            race.artefact, race.car, race.track, race.line, race.weights, mpc
        )
        loop = ClosedLoop(race.car, race.track, race.line, controller, slippery)
        samples.append(int((loop.drive(2).off_track_m > 0).sum()))
    assert samples[0] > 10
    assert samples[1] == 0
