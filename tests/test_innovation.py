"""Errors beyond the model's band widen it, so that a car that has changed is driven with care."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.gp.weights import GpWeights, read_weights
from bayesrace.integrators import PREDICTION
from bayesrace.vehicles import CarParameters
from controller.assembly import compiled_controller
from controller.native_step import NativeStep
from controller.settings import MpcSettings
from learning.validation import predictive_sigma
from operation.closed_loop import ClosedLoop, built_in_car
from operation.preparation import prepare
from operation.settings import RaceSettings
from operation.terminal.progress import stages_on
from tests.conftest import SETTINGS, Circuit

CAUTIOUS = SETTINGS.model_copy(update={"caution": 0.95})
STEP_S = PREDICTION.step_s


@pytest.fixture
def step(
    kinematic_artefact: Path, car: CarParameters, weights: GpWeights, circuit: Circuit
) -> NativeStep:
    step = NativeStep(kinematic_artefact, car, CAUTIOUS)
    step.set_weights(weights)
    step.set_path(circuit.table)
    return step


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
    off = np.array([0.01, 0.004, 0.3])
    widening, states, inputs = drive(step, circuit, off, 40)
    sigma = predictive_sigma(weights, np.column_stack([states[:-1, 3:], inputs]))
    recent = held = np.full(3, 1 / 1.25)
    expected = [1.0, 1.0]  # what is observed before a step counts from the one after it on
    for ratio in np.minimum(np.abs(off) / sigma, 1e3)[:-2]:
        recent = recent + (ratio - recent) / 10
        held = np.maximum(recent, held * (1 - 1 / 500))
        expected.append(max(1.0, float(1.25 * held.max())))
    assert expected[-1] > 3
    np.testing.assert_allclose(widening, expected, rtol=1e-5)


def test_a_band_that_covers_the_errors_stays_as_it_is(step: NativeStep, circuit: Circuit) -> None:
    widening, _, _ = drive(step, circuit, np.zeros(3), 20)
    assert set(widening) == {1.0}


def test_the_preparation_changes_nothing(
    kinematic_artefact: Path, car: CarParameters, weights: GpWeights, circuit: Circuit
) -> None:
    """Also if parameters are set between it and the step."""
    ends = []
    for prepared in (False, True):
        step = NativeStep(kinematic_artefact, car, CAUTIOUS)
        step.set_weights(weights)
        step.set_path(circuit.table)
        first, _, _ = drive(step, circuit, np.array([0.01, 0.004, 0.3]), 20, prepared)
        step.set_parameters(car, CAUTIOUS.model_copy(update={"caution": 0.9}))
        again, states, inputs = drive(step, circuit, np.zeros(3), 5, prepared)
        ends.append((first, again, states.tobytes(), inputs.tobytes()))
    assert ends[0] == ends[1]


def test_new_weights_and_a_new_run_begin_with_their_own_band(
    step: NativeStep, weights: GpWeights, circuit: Circuit
) -> None:
    off = np.array([0.0, 0.0, 0.3])
    for begin in (lambda: step.set_weights(weights), lambda: step._library.br_mpc_reset(step._mpc)):
        assert drive(step, circuit, off, 15)[0][-1] > 1.3
        begin()
        assert drive(step, circuit, off, 1)[0] == [1.0]


def test_what_slows_another_car_down_in_one_bend_is_remembered_in_the_next(
    step: NativeStep, car: CarParameters, circuit: Circuit
) -> None:
    """The reference rises again more slowly in the measure that the band is widened by over 4."""
    _, states, inputs = drive(step, circuit, np.array([0.1, 0.1, 3.0]), 30)
    slow, widening = step.info.pace, step.info.widening
    assert slow < 0.9
    assert widening > 8
    step.set_parameters(car, CAUTIOUS.model_copy(update={"constraints": False}))
    assert step.step(states[-1], inputs[-1]).usable
    rise = step.info.pace / slow - 1
    faster = car.tuning.caution.faster_ps * STEP_S
    assert rise == pytest.approx(faster / (step.info.widening / 4), rel=1e-6)


@pytest.mark.parametrize("duration_s", [0.0, -0.1, 1.5, np.nan])
def test_a_duration_that_is_none_is_refused(step: NativeStep, duration_s: float) -> None:
    with pytest.raises(InputError, match="a time"):
        step.observe(np.zeros(7), np.zeros(2), duration_s, np.zeros(7))


def test_numbers_that_are_none_are_refused(step: NativeStep) -> None:
    with pytest.raises(InputError, match="not finite"):
        step.observe(np.zeros(7), np.zeros(2), STEP_S, np.full(7, np.nan))


def test_errors_of_a_missed_period_count_as_those_of_one(
    kinematic_artefact: Path, car: CarParameters, weights: GpWeights, circuit: Circuit
) -> None:
    """Twice the error in twice the time, and twice the weight in the mean."""
    last = []
    for stages in (1, 2):
        step = NativeStep(kinematic_artefact, car, CAUTIOUS)
        step.set_weights(replace(weights))
        step.set_path(circuit.table)
        x, u = circuit.start(), np.zeros(2)
        for _ in range(3):
            assert step.step(x, u).usable
            after = step.predict(x, u, stages * STEP_S)
            after[5] += 0.3 * stages
            step.observe(x, u, stages * STEP_S, after)
        last.append(step.info.widening - 1)
    assert last[0] > 0.01
    assert last[1] == pytest.approx(2 * last[0], rel=1e-6)


@pytest.mark.check
def test_a_car_that_has_lost_grip_since_it_was_learned_stays_on_the_track() -> None:
    """A fifth of the tyre forces of the car that the weights and the line are made for."""
    settings = RaceSettings(track="random:8")
    with stages_on(Console(quiet=True)) as stages:
        files = prepare(settings, (settings.track,), stages)
    weights, on, line = read_weights(files.weights), files.first.track, files.first.line
    slippery = settings.model_copy(update={"true_grip": 0.8}).true_car
    samples = []
    for mpc in (MpcSettings(caution=0.0), MpcSettings()):
        controller = compiled_controller(files.artefacts[0], settings.car, on, line, weights, mpc)
        loop = ClosedLoop(settings.car, on, line, controller, built_in_car(slippery))
        samples.append(int((loop.drive(2).off_track_m > 0).sum()))
    assert samples[0] > 10
    assert samples[1] == 0
