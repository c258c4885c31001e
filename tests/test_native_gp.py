"""The compiled model: CasADi's numbers and derivatives for every kernel; weights refused."""

from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from bayesrace.arrays import Floats
from bayesrace.controller.native_step import NativeStep
from bayesrace.controller.settings import MpcSettings
from bayesrace.errors import InputError
from bayesrace.gp.expression import corrected_function
from bayesrace.gp.weights import KERNELS, Weights, zero_weights
from bayesrace.integrators import PERFECT, PREDICTION
from bayesrace.vehicles import Car
from bayesrace.vehicles.models import dynamic, e_kinematic
from tests.conftest import LENGTH_SCALES, fit_weights, smooth_drive
from tests.scikit import scikit_gp

NOMINAL = np.array([0.3, -0.2, 0.5, 1.8, 0.05, 0.8, 0.08, 0.5, 0.5])


def points(car: Car, count: int = 30, seed: int = 5) -> Floats:
    """v = [x; u] of a drive that the weights have not seen."""
    states, inputs = smooth_drive(car, count, seed)
    return np.column_stack([states, inputs])


def oracle(function: ca.Function) -> ca.Function:
    """(v, lambda) -> (x_next, J, H) by CasADi's own differentiation."""
    v, lam = ca.MX.sym("v", 9), ca.MX.sym("lam", 7)
    x_next = function(v[:7], v[7:])
    jacobian = ca.jacobian(x_next, v)
    return ca.Function(
        "oracle", [v, lam], [x_next, jacobian, ca.hessian(ca.dot(lam, x_next), v)[0]]
    )


def check(step: NativeStep, function: ca.Function, vs: Floats, hessian: bool = True) -> None:
    """Value, Jacobian and Hessian to 1e-12 of their own size."""
    expected, random = oracle(function), np.random.default_rng(2)
    for v in vs:
        costate = random.normal(size=7)
        ours = step.evaluate(v, costate)
        theirs = [np.asarray(ca.densify(m)) for m in expected(v, costate)]
        for a, b in list(zip(ours, theirs, strict=True))[: 3 if hessian else 2]:
            b = b.reshape(a.shape)
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * max(1.0, np.abs(b).max()))


def loaded(artefact: Path, car: Car, weights: Weights | None = None) -> NativeStep:
    step = NativeStep(artefact, car, MpcSettings())
    if weights is not None:
        step.set_weights(weights)
    return step


@pytest.mark.parametrize("best_case", [False, True])
def test_the_nominal_stage_equals_casadi(
    kinematic_artefact: Path, dynamic_artefact: Path, car: Car, best_case: bool
) -> None:
    """Also at standstill, where the dynamic model's tyre forces are blended."""
    slow = points(car, 4)
    slow[:, 3] = [0.0, 0.01, 0.06, -0.02]
    vs = np.vstack([points(car), slow])
    if best_case:
        check(loaded(dynamic_artefact, car), PERFECT.discretise(dynamic(car)), vs)
    else:
        check(loaded(kinematic_artefact, car), PREDICTION.discretise(e_kinematic(car)), vs)


def test_three_kernels_of_three_sizes_equal_casadi(kinematic_artefact: Path, car: Car) -> None:
    """Sizes that leave every remainder in the vector lanes, none, and the whole capacity."""
    sizes = [(1, 2, 3), (7, 8, 9), (15, 16, 17), (0, 5, 160), (33, 0, 0), (1024, 1024, 1024)]
    full = fit_weights(car, ("matern15", "rbf", "matern25"), count=1024)
    for counts in sizes:
        vx, vy, omega = (
            replace(o, inputs=o.inputs[:n], alpha=o.alpha[:n])
            for o, n in zip(full.outputs, counts, strict=True)
        )
        weights = replace(full, outputs=(vx, vy, omega))
        step = loaded(kinematic_artefact, car, weights)
        check(step, corrected_function(e_kinematic(car), PREDICTION, weights), points(car, 6))


def test_a_bare_offset_is_a_correction(kinematic_artefact: Path, car: Car) -> None:
    nothing = zero_weights(car.name, PREDICTION.identity("e_kinematic", car))
    vx, vy, omega = nothing.outputs
    weights = replace(nothing, outputs=(vx, vy, replace(omega, y_mean=0.25)))
    step = loaded(kinematic_artefact, car, weights)
    check(step, corrected_function(e_kinematic(car), PREDICTION, weights), points(car, 6))


def test_zero_weights_are_the_nominal_model_to_the_bit(
    kinematic_artefact: Path, car: Car, weights: Weights
) -> None:
    fresh, used = loaded(kinematic_artefact, car), loaded(kinematic_artefact, car, weights)
    costate = np.ones(7)
    assert (fresh.evaluate(NOMINAL, costate)[0] != used.evaluate(NOMINAL, costate)[0]).any()
    used.set_weights(zero_weights(car.name, weights.discretisation))
    for a, b in zip(fresh.evaluate(NOMINAL, costate), used.evaluate(NOMINAL, costate), strict=True):
        assert a.tobytes() == b.tobytes()


@pytest.mark.parametrize("kind", KERNELS)
def test_the_compiled_mean_equals_scikit_learn(
    kinematic_artefact: Path, car: Car, weights: Weights, kind: str
) -> None:
    source = weights.outputs[2]
    theta = np.log([1.5, *LENGTH_SCALES, 0.05])
    y = np.sin(source.inputs[:, 0]) + source.inputs[:, 3] * source.inputs[:, 4]
    gp = scikit_gp(kind, theta, source.inputs, y)
    learned = replace(
        source, kernel=kind, signal_variance=1.5, alpha=gp.alpha_, y_mean=0.1, y_scale=0.7
    )
    step = loaded(kinematic_artefact, car, replace(weights, outputs=(learned, learned, learned)))
    plain = loaded(kinematic_artefact, car)
    for v in points(car, 20):
        expected = 0.1 + 0.7 * float(gp.predict(v[None, 3:])[0])
        mean = (step.evaluate(v, np.zeros(7))[0] - plain.evaluate(v, np.zeros(7))[0])[3:6]
        np.testing.assert_allclose(mean, expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("kind", KERNELS)
def test_at_a_training_point_and_far_away_everything_is_finite(
    kinematic_artefact: Path, car: Car, kind: str
) -> None:
    weights = fit_weights(car, (kind, kind, kind), count=40)
    step = loaded(kinematic_artefact, car, weights)
    on_point = np.r_[0.0, 0, 0, weights.outputs[0].inputs[3]]
    for v in (on_point, np.r_[0.0, 0, 0, 50, 40, 900, 1, 1, 5], np.r_[np.zeros(3), [1e8] * 6]):
        mean, jacobian, _ = step.evaluate(v, np.ones(7))
        assert np.isfinite(mean).all()
        assert np.isfinite(jacobian).all()


# --- refused weights ---------------------------------------------------------------------------


def answers(step: NativeStep) -> bytes:
    return b"".join(part.tobytes() for part in step.evaluate(NOMINAL, np.ones(7)))


def refused(step: NativeStep, weights: Weights, words: str) -> None:
    before = answers(step)
    with pytest.raises(InputError, match=words):
        step.set_weights(weights)
    assert answers(step) == before


def test_weights_for_another_discretisation_are_refused(
    native: NativeStep, weights: Weights, car: Car
) -> None:
    euler = PREDICTION.model_copy(update={"scheme": "euler"})
    other = replace(weights, discretisation=euler.identity("e_kinematic", car))
    refused(native, other, "were learned for")
    heavier = car.model_copy(update={"mass_kg": 0.05})
    other = replace(weights, discretisation=PREDICTION.identity("e_kinematic", heavier))
    refused(native, other, "were learned for")


def test_more_points_than_the_capacity_are_refused(native: NativeStep, weights: Weights) -> None:
    vx, vy, omega = weights.outputs
    big = replace(vy, inputs=np.zeros((1025, 6)), alpha=np.zeros(1025))
    refused(native, replace(weights, outputs=(vx, big, omega)), "1025 points")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("alpha", value) for value in (np.nan, np.inf, None)),
        *(("inputs", value) for value in (np.nan, None)),
        *(("length_scales", value) for value in (0.0, -1.0, np.nan, None)),
        *(("kernel", value) for value in (-1, 4)),
        *(("n", value) for value in (-1, 1025)),
        ("offset", np.nan),
        ("scale", np.inf),
    ],
)
def test_the_c_interface_refuses_spoiled_weights_and_keeps_the_old(
    native: NativeStep, field: str, value: float | None
) -> None:
    """What the file format already refuses, once more at the boundary that C callers use. None: the
    array is missing."""
    n, ffi = 12, native.artefact.ffi
    arrays = {"length_scales": np.ones(6), "inputs": np.ones((n, 6)), "alpha": np.ones(n)}
    outputs = ffi.new("br_mpc_gp[3]")
    for gp in outputs:
        gp.n, gp.scale = n, 1.0
        for name, array in arrays.items():
            setattr(gp, name, ffi.from_buffer("double[]", array))
    if value is None:
        setattr(outputs[2], field, ffi.NULL)
    elif field in arrays:
        arrays[field].flat[-1] = value
    else:
        setattr(outputs[2], field, value)
    before = answers(native)
    error_weights = 5
    assert native._library.br_mpc_set_weights(native.handle, outputs) == error_weights
    assert answers(native) == before
