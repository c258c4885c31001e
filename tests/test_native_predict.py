"""Prediction over any duration: the controller's own model, whole stages and part of one."""

from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bayesrace.arrays import Floats
from bayesrace.codegen.problems.driving import advance_function, linearise_function
from bayesrace.controller.native_step import NativeStep
from bayesrace.errors import InputError
from bayesrace.gp.expression import mean_function
from bayesrace.gp.weights import Weights
from bayesrace.integrators import PERFECT, PREDICTION, Discretisation
from bayesrace.vehicles import Car
from bayesrace.vehicles.models import MODELS, Model, dynamic, e_kinematic
from tests.conftest import SETTINGS, Make, Problem, smooth_drive

TS = 0.02
NONE = np.zeros(7)


@pytest.fixture
def nominal(kinematic_artefact: Path, car: Car) -> NativeStep:
    """Without correction, and without a path, which predictions do not need."""
    return NativeStep(kinematic_artefact, car, SETTINGS)


@pytest.fixture
def corrected(make: Make) -> NativeStep:
    return make()


def drives(car: Car, count: int = 40) -> list[tuple[Floats, Floats]]:
    """States and inputs away from the steering angle's limit."""
    states, inputs = smooth_drive(car, count, 5)
    pairs = zip(states, inputs, strict=True)
    return [(x, u) for x, u in pairs if abs(x[6]) < car.delta_max_rad - 0.11]


def integrated(model: Model, x: Floats, u: Floats, duration_s: float) -> Floats:
    """Independent of our integrators."""
    symbol = ca.SX.sym("x", 7)
    ode = ca.Function("ode", [symbol], [model.ode(symbol, ca.DM(u))])
    solution = solve_ivp(
        lambda _, s: np.asarray(ode(s)).ravel(), (0, duration_s), x, rtol=1e-11, atol=1e-12
    )
    return np.asarray(solution.y[:, -1])


@pytest.mark.parametrize("duration_s", [0.0005, 0.002, 0.0137, 0.02, 0.035, 0.1])
def test_without_weights_it_integrates_the_model(
    nominal: NativeStep, car: Car, duration_s: float
) -> None:
    for x, u in drives(car)[::5]:
        if abs(x[6] + duration_s * u[1]) > car.delta_max_rad:
            continue
        expected = integrated(e_kinematic(car), x, u, duration_s)
        error = np.abs(nominal.predict(x, u, duration_s) - expected)
        assert error[3:].max() < 1e-6
        # the pose follows from velocities taken as linear over the step: their curvature h^3 / 12
        assert error[:3].max() < 1e-9 + 60 * min(duration_s, TS) ** 2 * duration_s


def test_part_of_a_stage_has_the_schemes_order(nominal: NativeStep, car: Car) -> None:
    """One step of RK4 with the pose by Simpson's rule: the error falls at least as h^3."""
    model, ratios = e_kinematic(car), []
    for x, u in drives(car)[::5]:
        errors = [
            np.abs(nominal.predict(x, u, h) - integrated(model, x, u, h)).max()
            for h in (0.016, 0.008)
        ]
        ratios.append(errors[0] / errors[1])
    assert np.median(ratios) > 7


def test_the_best_case_predicts_the_car(dynamic_artefact: Path, car: Car) -> None:
    step = NativeStep(dynamic_artefact, car, SETTINGS)
    model = dynamic(car)
    for x, u in drives(car)[::5]:
        if x[3] < 0.5:
            continue  # stiff: four sub-steps a period are not accurate there
        for duration_s in (0.003, 0.011, 0.02, 0.047):
            if abs(x[6] + duration_s * u[1]) > car.delta_max_rad:
                continue
            expected = integrated(model, x, u, duration_s)
            predicted = step.predict(x, u, duration_s)
            np.testing.assert_allclose(predicted, expected, rtol=0, atol=2e-3)


def test_whole_stages_are_the_controllers_own_map(corrected: NativeStep, car: Car) -> None:
    for x, u in drives(car):
        expected = x
        for stages in (1, 2, 3):
            if abs(expected[6] + TS * u[1]) > car.delta_max_rad:
                break
            expected = corrected.evaluate(np.r_[expected, u], NONE)[0]
            assert corrected.predict(x, u, stages * TS).tobytes() == expected.tobytes()


@pytest.mark.parametrize(
    ("name", "discretisation"),
    [
        ("e_kinematic", PREDICTION),
        ("dynamic", PERFECT),
        ("dynamic", PREDICTION),
        ("e_kinematic", Discretisation(scheme="heun", substeps=3)),
    ],
)
def test_over_a_whole_stage_the_part_is_the_stage(
    car: Car, name: str, discretisation: Discretisation
) -> None:
    """To the last bits: operations are the same, but may be in another order."""
    model = MODELS[name](car)
    part, stage = advance_function(model, discretisation), linearise_function(model, discretisation)
    random = np.random.default_rng(1)
    for x, u in drives(car)[::4]:
        e = 0.1 * random.normal(size=3)
        a, b = part(x, u, e, discretisation.step_s), stage(x, u, e, NONE)[0]
        np.testing.assert_allclose(np.asarray(a), np.asarray(b), rtol=1e-13, atol=1e-15)


def test_part_of_a_stage_takes_its_share_of_the_residual(
    corrected: NativeStep, car: Car, weights: Weights
) -> None:
    """Against the CasADi expressions of the model and of the posterior mean."""
    over, mean = PREDICTION.over(e_kinematic(car)), mean_function(weights)
    for x, u in drives(car)[::3]:
        e = np.asarray(mean(np.r_[x[3:], u])).ravel()
        for theta in (1e-6, 0.1, 0.5, 0.99):
            expected = np.asarray(over(x, u, theta * e, theta * TS)).ravel()
            predicted = corrected.predict(x, u, theta * TS)
            np.testing.assert_allclose(predicted, expected, rtol=0, atol=1e-12)


def test_angle_and_inputs_stop_at_their_limits(corrected: NativeStep, car: Car) -> None:
    x = np.array([0.0, 0, 0, 1.5, 0, 0, car.delta_max_rad - 0.01])
    for duration_s in (0.005, TS, 0.07):
        after = corrected.predict(x, np.array([0.5, 4.0]), duration_s)
        assert after[6] == pytest.approx(car.delta_max_rad, abs=1e-12)
        assert after[6] <= car.delta_max_rad
    # the rate that leads there is what acts
    limited = corrected.predict(x, np.array([0.5, 0.5]), TS)
    assert corrected.predict(x, np.array([0.5, 4.0]), TS) == pytest.approx(limited, abs=1e-12)
    x[6] = 0.0
    beyond = corrected.predict(x, np.array([7.0, -50.0]), 0.03)
    at = corrected.predict(x, np.array([car.d_max, -car.delta_rate_max_radps]), 0.03)
    assert beyond.tobytes() == at.tobytes()


def test_impossible_durations_and_what_is_not_finite_are_refused(
    corrected: NativeStep, weights: Weights, car: Car
) -> None:
    x, u = drives(car)[0]
    assert corrected.predict(x, u, 0.0).tobytes() == x.tobytes()
    for duration_s in (-1e-9, 1.001, np.nan, np.inf):
        with pytest.raises(InputError, match="time is negative"):
            corrected.predict(x, u, duration_s)
    for i in range(9):
        bad = np.r_[x, u]
        bad[i] = np.nan
        with pytest.raises(InputError, match="not finite"):
            corrected.predict(bad[:7], bad[7:], TS)
    vx, vy, omega = weights.outputs
    huge = replace(vy, alpha=np.full(vy.count, 1e306), signal_variance=1e3)
    corrected.set_weights(replace(weights, outputs=(vx, huge, omega)))
    for duration_s in (0.01, TS, 0.05):
        with pytest.raises(InputError, match="not finite"):
            corrected.predict(x, u, duration_s)


def test_predicting_leaves_the_controller_as_it_is(
    corrected: NativeStep, nominal: NativeStep, recorded: list[Problem], weights: Weights
) -> None:
    nominal.set_weights(weights)
    for p in recorded[:30]:
        corrected.predict(p.x0, np.array([0.4, 1.0]), 0.037)
        assert corrected.solve(p.x0, p.d_previous, p.reference) is nominal.solve(
            p.x0, p.d_previous, p.reference
        )
        assert corrected.u.tobytes() == nominal.u.tobytes()
