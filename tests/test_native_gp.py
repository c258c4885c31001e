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
from bayesrace.gp.weights import KERNELS, GpWeights, zero_weights
from bayesrace.integrators import PERFECT, PREDICTION
from bayesrace.vehicles import CarParameters
from bayesrace.vehicles.models import dynamic, e_kinematic
from tests.conftest import LENGTH_SCALES, fit_weights, smooth_drive
from tests.scikit import scikit_gp

NOMINAL = np.array([0.3, -0.2, 0.5, 1.8, 0.05, 0.8, 0.08, 0.5, 0.5])


def points(car: CarParameters, count: int = 30, seed: int = 5) -> Floats:
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


def loaded(artefact: Path, car: CarParameters, weights: GpWeights | None = None) -> NativeStep:
    step = NativeStep(artefact, car, MpcSettings())
    if weights is not None:
        step.set_weights(weights)
    return step


def test_the_nominal_stage_equals_casadi(kinematic_artefact: Path, car: CarParameters) -> None:
    f = PREDICTION.discretise(e_kinematic(car))
    check(loaded(kinematic_artefact, car), f, points(car))


def test_the_nominal_best_case_stage_equals_casadi(
    dynamic_artefact: Path, car: CarParameters
) -> None:
    """Also at standstill, where the tyre forces are blended."""
    slow = points(car, 4)
    slow[:, 3] = [0.0, 0.01, 0.06, -0.02]
    f = PERFECT.discretise(dynamic(car))
    check(loaded(dynamic_artefact, car), f, np.vstack([points(car), slow]))


@pytest.mark.parametrize("kind", KERNELS)
def test_the_corrected_stage_equals_casadi(
    kinematic_artefact: Path, car: CarParameters, kind: str
) -> None:
    """The compiled Hessian leaves the second derivative of Matern 1/2 out by design."""
    weights = fit_weights(car, (kind, kind, kind))
    step = loaded(kinematic_artefact, car, weights)
    function = corrected_function(e_kinematic(car), PREDICTION, weights)
    check(step, function, points(car), hessian=kind != "matern05")


def test_three_kernels_of_three_sizes_equal_casadi(
    kinematic_artefact: Path, car: CarParameters
) -> None:
    """Sizes that leave every remainder in the vector lanes, an output without any point."""
    sizes = [(1, 2, 3), (7, 8, 9), (15, 16, 17), (0, 5, 160), (33, 0, 0)]
    full = fit_weights(car, ("matern15", "rbf", "matern25"))
    for counts in sizes:
        vx, vy, omega = (
            replace(o, inputs=o.inputs[:n], alpha=o.alpha[:n])
            for o, n in zip(full.outputs, counts, strict=True)
        )
        weights = replace(full, outputs=(vx, vy, omega))
        step = loaded(kinematic_artefact, car, weights)
        check(step, corrected_function(e_kinematic(car), PREDICTION, weights), points(car, 6))


def test_a_bare_offset_is_a_correction(kinematic_artefact: Path, car: CarParameters) -> None:
    nothing = zero_weights(car.name, PREDICTION.identity("e_kinematic", car))
    vx, vy, omega = nothing.outputs
    weights = replace(nothing, outputs=(vx, vy, replace(omega, y_mean=0.25)))
    step = loaded(kinematic_artefact, car, weights)
    check(step, corrected_function(e_kinematic(car), PREDICTION, weights), points(car, 6))


def test_zero_weights_are_the_nominal_model_to_the_bit(
    kinematic_artefact: Path, car: CarParameters, weights: GpWeights
) -> None:
    fresh, used = loaded(kinematic_artefact, car), loaded(kinematic_artefact, car, weights)
    costate = np.ones(7)
    assert (fresh.evaluate(NOMINAL, costate)[0] != used.evaluate(NOMINAL, costate)[0]).any()
    used.set_weights(zero_weights(car.name, weights.discretisation))
    for a, b in zip(fresh.evaluate(NOMINAL, costate), used.evaluate(NOMINAL, costate), strict=True):
        assert a.tobytes() == b.tobytes()


def test_full_capacity_fits(kinematic_artefact: Path, car: CarParameters) -> None:
    weights = fit_weights(car, ("rbf", "matern25", "matern15"), count=1024)
    step = loaded(kinematic_artefact, car, weights)
    check(step, corrected_function(e_kinematic(car), PREDICTION, weights), points(car, 4))


@pytest.mark.parametrize("kind", KERNELS)
def test_the_compiled_mean_equals_scikit_learn(
    kinematic_artefact: Path, car: CarParameters, weights: GpWeights, kind: str
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
def test_derivatives_equal_finite_differences(
    kinematic_artefact: Path, car: CarParameters, kind: str
) -> None:
    step = loaded(kinematic_artefact, car, fit_weights(car, (kind, kind, kind)))
    costate, h = np.array([0.5, -1, 0.3, 1, 2, -0.4, 0.1]), 1e-5
    for v in points(car, 4):
        _, jacobian, hessian = step.evaluate(v, costate)
        for j in range(9):
            shift = h * np.eye(9)[j]
            (above, j_above, _), (below, j_below, _) = (
                step.evaluate(v + side * shift, costate) for side in (1, -1)
            )
            slope = (above - below) / (2 * h)
            np.testing.assert_allclose(jacobian[:, j], slope, rtol=1e-6, atol=1e-6)
            if kind != "matern05":
                bend = costate @ (j_above - j_below) / (2 * h)
                np.testing.assert_allclose(hessian[:, j], bend, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("kind", KERNELS)
def test_at_a_training_point_and_far_away_everything_is_finite(
    kinematic_artefact: Path, car: CarParameters, kind: str
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


def refused(step: NativeStep, weights: GpWeights, words: str) -> None:
    before = answers(step)
    with pytest.raises(InputError, match=words):
        step.set_weights(weights)
    assert answers(step) == before


def test_weights_for_another_discretisation_are_refused(
    native: NativeStep, weights: GpWeights, car: CarParameters
) -> None:
    euler = PREDICTION.model_copy(update={"scheme": "euler"})
    other = replace(weights, discretisation=euler.identity("e_kinematic", car))
    refused(native, other, "were learned for")
    heavier = car.model_copy(update={"mass_kg": 0.05})
    other = replace(weights, discretisation=PREDICTION.identity("e_kinematic", heavier))
    refused(native, other, "were learned for")


def test_more_points_than_the_capacity_are_refused(native: NativeStep, weights: GpWeights) -> None:
    vx, vy, omega = weights.outputs
    big = replace(vy, inputs=np.zeros((1025, 6)), alpha=np.zeros(1025))
    refused(native, replace(weights, outputs=(vx, big, omega)), "1025 points")


@pytest.mark.parametrize(
    "spoil",
    [
        "alpha nan",
        "alpha inf",
        "inputs nan",
        "length zero",
        "length negative",
        "length nan",
        "kernel low",
        "kernel high",
        "n negative",
        "n large",
        "offset nan",
        "scale inf",
        "no alpha",
        "no inputs",
        "no lengths",
    ],
)
def test_the_c_interface_refuses_spoiled_weights_and_keeps_the_old(
    native: NativeStep, spoil: str
) -> None:
    """What the file format already refuses, once more at the boundary that C callers use."""
    n = 12
    lengths, inputs, alpha = np.ones(6), np.ones((n, 6)), np.ones(n)
    ffi = native.artefact.ffi
    outputs = ffi.new("br_mpc_gp[3]")
    for gp in outputs:
        gp.n, gp.scale = n, 1.0
        gp.length_scales, gp.inputs, gp.alpha = (
            ffi.from_buffer("double[]", array) for array in (lengths, inputs, alpha)
        )
    bad = outputs[2]
    spare = np.array([0.0, -1.0, np.nan])
    if spoil.startswith("alpha"):
        alpha[n - 1] = np.nan if spoil.endswith("nan") else np.inf
    elif spoil == "inputs nan":
        inputs[n - 1, 5] = np.nan
    elif spoil.startswith("length"):
        lengths[5] = spare[("zero", "negative", "nan").index(spoil.split()[1])]
    elif spoil.startswith("kernel"):
        bad.kernel = -1 if spoil.endswith("low") else 4
    elif spoil.startswith("n "):
        bad.n = -1 if spoil.endswith("negative") else 1025
    elif spoil == "offset nan":
        bad.offset = np.nan
    elif spoil == "scale inf":
        bad.scale = np.inf
    else:
        field = {"alpha": "alpha", "inputs": "inputs", "lengths": "length_scales"}
        setattr(bad, field[spoil.split()[1]], ffi.NULL)
    before = answers(native)
    error_weights = 5
    assert native._library.br_mpc_set_weights(native.handle, outputs) == error_weights
    assert answers(native) == before
