"""Caution: the posterior variance, the tube that it makes of a plan, and what the car does then."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from pydantic import ValidationError
from rich.console import Console

from bayesrace.arrays import Floats
from bayesrace.codegen.problems.tracking import tracking
from bayesrace.controller.assembly import compiled_controller
from bayesrace.controller.native_step import NativeStep, Status
from bayesrace.controller.pure_pursuit import PurePursuitSettings
from bayesrace.controller.settings import MpcSettings
from bayesrace.gp.weights import KERNELS, Weights, read_weights
from bayesrace.integrators import PREDICTION
from bayesrace.learning.validation import predictive_sigma
from bayesrace.operation.closed_loop import ClosedLoop, built_in_car
from bayesrace.operation.preparation import prepare
from bayesrace.operation.settings import RaceSettings
from bayesrace.operation.terminal.terminal import stages_on
from bayesrace.vehicles import Car, default_car
from bayesrace.vehicles.models import dynamic, e_kinematic
from bayesrace.vehicles.tuning import CautionTuning
from tests.conftest import CAUTIOUS, Circuit, Make, discrete, fit_weights, smooth_drive


def of_points(weights: Weights, count: int) -> Weights:
    """The first points of each output."""
    vx, vy, omega = (
        replace(one, inputs=one.inputs[:count], alpha=one.alpha[:count]) for one in weights.outputs
    )
    return replace(weights, outputs=(vx, vy, omega))


@pytest.fixture
def unsure(weights: Weights) -> Weights:
    """Of a few points, far from which the posterior knows little."""
    return of_points(weights, 12)


def noisy(weights: Weights, factor: float) -> Weights:
    """The same mean, with so many times the variance of the noise."""
    outputs = (replace(one, noise_variance=factor * one.noise_variance) for one in weights.outputs)
    vx, vy, omega = outputs
    return replace(weights, outputs=(vx, vy, omega))


def driven(
    step: NativeStep, car: Car, x: Floats, u: Floats, count: int
) -> tuple[Floats, Floats, list[float]]:
    """State and input after so many steps from these, and the pace of each step."""
    plant, paces = discrete(dynamic(car)), []
    for _ in range(count):
        assert step.step(x, u).usable
        u = step.u.copy()
        paces.append(step.info.pace)
        x = plant(x, u)
    return x, u, paces


@pytest.mark.parametrize("kind", KERNELS)
@pytest.mark.parametrize("count", [1, 6, 160])
def test_the_compiled_variance_is_the_posterior_s(
    make: Make, car: Car, kind: str, count: int
) -> None:
    some = of_points(fit_weights(car, (kind, kind, kind)), count)
    step = make(some)
    states, inputs = smooth_drive(car, 30, seed=5)
    states[0, 3:] *= 5  # far from all data
    ours = np.array([step.variance(v)[0] for v in np.column_stack([states, inputs])])
    theirs = predictive_sigma(some, np.column_stack([states[:, 3:], inputs])) ** 2
    prior = np.array([sum(output.amplitudes[2:]) for output in some.outputs])
    np.testing.assert_allclose(ours / prior, theirs / prior, rtol=0, atol=1e-9)


def test_of_more_points_than_there_is_room_for_some_count(make: Make, car: Car) -> None:
    """The variance is larger than that of all points, and still smaller than the prior's."""
    weights = fit_weights(car, ("rbf", "matern25", "matern15"), count=1024)
    step = make(weights)
    states, inputs = smooth_drive(car, 30, seed=5)
    ours = np.array([step.variance(v)[0] for v in np.column_stack([states, inputs])])
    exact = predictive_sigma(weights, np.column_stack([states[:, 3:], inputs])) ** 2
    prior = np.array([sum(output.amplitudes[2:]) for output in weights.outputs])
    assert (ours >= exact * (1 - 1e-6)).all()
    assert np.median(ours / prior) < 0.05


def output_effect(car: Car, v: Floats, mean: Floats) -> Floats:
    """What the residual does to the states, (7, 3), by CasADi."""
    f = PREDICTION.corrected(e_kinematic(car))
    e = ca.MX.sym("e", 3)
    effect = ca.Function("effect", [e], [ca.jacobian(f(v[:7], v[7:], e), e)])
    return np.asarray(ca.densify(effect(mean)))


def tube_of(step: NativeStep, car: Car, weights: Weights, plan: Floats) -> Floats:
    """The tube of a plan v = [x; u] (N, 9) by NumPy, along the normals of the last reference.

    What the residual's mean may err by counts, and noise, which averages out, does not."""
    problem = tracking(e_kinematic(car), PREDICTION)
    q = np.diag([1 / one.deviation**2 for one in problem.states])
    r = np.diag([1 / one.effort**2 for one in problem.inputs])
    jacobians = [step.evaluate(v, np.zeros(7))[1] for v in plan]
    nominal = PREDICTION.discretise(e_kinematic(car))
    at = np.arange(7) * (len(plan) - 1) // 6  # the others are interpolated
    noise = np.array([one.y_scale**2 * one.noise_variance for one in weights.outputs])
    known = np.sqrt(predictive_sigma(weights, plan[at, 3:]) ** 2 - noise)
    stages = np.arange(len(plan))
    sigma = np.column_stack([np.interp(stages, at, column) for column in known.T])
    gains = []
    s = q
    for jacobian in reversed(jacobians):
        a, b = jacobian[:, :7], jacobian[:, 7:]
        gain = np.linalg.solve(r + b.T @ s @ b, b.T @ s @ a)
        s = q + a.T @ s @ (a - b @ gain)
        gains.append(gain)
    deviation, widths = np.zeros((7, 3)), []
    rows = step.read_reference()
    for v, jacobian, gain, each, row in zip(plan, jacobians, gains[::-1], sigma, rows, strict=True):
        a, b = jacobian[:, :7], jacobian[:, 7:]
        mean = (step.evaluate(v, np.zeros(7))[0] - np.asarray(nominal(v[:7], v[7:])).ravel())[3:6]
        deviation = (a - b @ gain) @ deviation + output_effect(car, v, mean) @ np.diag(each)
        widths.append(np.linalg.norm(row[2:4] @ deviation[:2]))
    return CAUTIOUS.caution_sigmas * np.array(widths)


def test_the_tube_adds_correlated_errors_up_along_the_plan(
    make: Make, car: Car, unsure: Weights, circuit: Circuit
) -> None:
    """Against NumPy: regulator, propagation, and the share of each stage's normal."""
    step = make(unsure, caution=0.95)
    x, u, _ = driven(step, car, circuit.start(), np.zeros(2), 25)
    plan_x, plan_u = (part.copy() for part in step.read_plan())
    reference = step.read_reference()
    assert step.solve(x, u, reference, elapsed_s=0.0).usable
    expected = tube_of(step, car, unsure, np.column_stack([plan_x[:-1], plan_u]))
    assert expected[-1] > 0.01
    np.testing.assert_allclose(step.read_tube(), expected, rtol=1e-6)
    assert step.info.tube_m == pytest.approx(expected.max())


def test_the_car_slows_down_where_it_knows_little_and_speeds_up_again(
    make: Make, car: Car, weights: Weights, circuit: Circuit
) -> None:
    step = make(of_points(weights, 2), caution=0.9999999)
    x, u, paces = driven(step, car, circuit.start(), np.zeros(2), 60)
    step.set_weights(weights)
    step.set_parameters(car, CAUTIOUS.model_copy(update={"caution": 0.6}))
    assert step.unknown_s == 0
    least, paces = min(paces), paces[-1:]
    paces += driven(step, car, x, u, 120)[2]
    tuning = car.tuning.caution
    changes = np.diff(paces) / np.array(paces[:-1]) / PREDICTION.step_s
    assert least == tuning.least
    assert paces[-1] == 1.0
    assert changes.min() >= -tuning.slower_ps * (1 + 1e-9)
    assert changes.max() <= tuning.faster_ps * (1 + 1e-9)


def test_the_reference_does_not_leap_when_nothing_is_uncertain_any_more(
    make: Make, car: Car, weights: Weights, circuit: Circuit
) -> None:
    """As after a rollback to no weights."""
    step = make(noisy(weights, 100), caution=0.95)
    x, u, paces = driven(step, car, circuit.start(), np.zeros(2), 40)
    assert step.step(np.full(7, np.nan), u) is Status.BAD_STATE
    assert step.info.pace == paces[-1]  # also that of a step that plans nothing
    step.load_weights(b"")
    assert step.step(x, u).usable
    assert paces[-1] < 0.9
    faster = 1 + car.tuning.caution.faster_ps * PREDICTION.step_s
    assert step.info.pace == pytest.approx(faster * paces[-1])


def test_the_plan_is_not_pushed_by_its_tube(
    make: Make, car: Car, unsure: Weights, circuit: Circuit
) -> None:
    """Uncertainty slows the reference down; for the same reference the plan is the same."""
    step = make(unsure, caution=0.95)
    x, u, _ = driven(step, car, circuit.start(), np.zeros(2), 25)
    line, plans, tubes = step.read_reference(), [], []
    for caution in (0.6, 0.999):
        step.set_parameters(car, CAUTIOUS.model_copy(update={"caution": caution}))
        for _ in range(20):
            assert step.solve(x, u, line, elapsed_s=0.0).usable
        plans.append(step.read_plan()[1].copy())
        tubes.append(step.info.tube_m)
    assert tubes[1] > 10 * tubes[0] > 0
    np.testing.assert_allclose(plans[1], plans[0], atol=1e-3)


def test_the_reference_slows_down_no_faster_than_the_car_can_brake(
    make: Make, car: Car, weights: Weights, circuit: Circuit
) -> None:
    """On half the grip, which the mismatch explains in part only. The rest of what the pace does is
    the line's speed as far as the weights know it, which is hardly less than the line's here."""
    step, oracle = make(weights, caution=0.95), make(weights)
    slippery = car.model_copy(update={"tyres": car.true_tyres.with_grip(0.5)})
    plant, x, u = discrete(dynamic(slippery)), circuit.start(), np.zeros(2)
    paces, able = [1.0], []
    for _ in range(80):
        assert step.step(x, u).usable
        u, v = step.u.copy(), step.read_plan()[0][0, 3]
        braking = np.array([0, 0, 0, v, 0, 0, 0]), np.array([car.d_min, 0])
        able.append(1 - oracle.predict(*braking, PREDICTION.step_s)[3] / v)
        paces.append(step.info.pace)
        x = plant(x, u)
    falls = 1 - np.divide(paces[1:], paces[:-1])
    assert (falls < np.array(able) + 2e-3).all()
    assert (np.abs(falls - able)[falls > 0.02] < 2e-3).any()
    assert min(paces) < 0.8


def test_a_track_that_is_no_constraint_does_not_slow_the_car_down(
    make: Make, car: Car, weights: Weights, circuit: Circuit
) -> None:
    step = make(noisy(weights, 100), caution=0.95, constraints=False)
    _, _, paces = driven(step, car, circuit.start(), np.zeros(2), 40)
    assert min(paces) == 1.0
    assert step.info.tube_m == 0.0


def test_without_caution_uncertainty_changes_nothing(
    make: Make, car: Car, unsure: Weights, circuit: Circuit
) -> None:
    """To the bit: the paper's controller, which takes the mean for the truth."""
    steps = [make(one) for one in (unsure, noisy(unsure, 25))]
    x, u = circuit.start(), np.zeros(2)
    for _ in range(10):
        for step in steps:
            assert step.step(x, u).usable
        assert steps[0].u.tobytes() == steps[1].u.tobytes()
        assert (steps[0].info.tube_m, steps[0].info.pace) == (0.0, 1.0)
        u = steps[0].u.copy()
        x = discrete(dynamic(car))(x, u)


@pytest.mark.parametrize("value", [-0.1, 0.3, 1.0])
def test_a_probability_is_asked_for(value: float) -> None:
    with pytest.raises(ValidationError, match="caution"):
        MpcSettings(caution=value)


@pytest.mark.parametrize("change", [{"least": 1.1}, {"share": 1.1}, {"least": 0.0}])
def test_shares_in_the_tuning_are_shares(car: Car, change: dict[str, float]) -> None:
    stated = car.tuning.caution.model_dump() | change
    with pytest.raises(ValidationError, match=next(iter(change))):
        CautionTuning.model_validate(stated)


@pytest.mark.check
def test_practice_keeps_first_laps_on_slippery_tyres_on_the_track() -> None:
    """The tyres give 18 % less than the racing line asks for: the plan leaves what was driven.

    The samples' mirror images alone would keep this car on this track, and so would a training
    drive that had found its limit.
    """
    one_sided = default_car().model_copy(update={"mirrored_samples": False})
    calm = PurePursuitSettings(speed_scale=0.6)
    deepest = []
    for laps in (0, 3):
        settings = RaceSettings(
            track="harbour", true_grip=0.82, car=one_sided, pursuit=calm, practice_laps=laps
        )
        with stages_on(Console(quiet=True)) as stages:
            files = prepare(settings, (settings.track,), stages)
        on, line, car = files.first.track, files.first.line, settings.car
        weights = read_weights(files.weights)
        controller = compiled_controller(files.artefacts[0], car, on, line, weights)
        loop = ClosedLoop(car, on, line, controller, built_in_car(settings.true_car))
        deepest.append(float(loop.drive(2).off_track_m.max()))
    assert deepest[0] > 0.02
    assert deepest[1] <= 0
