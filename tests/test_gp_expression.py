"""The posterior mean's expression: scikit-learn's numbers, right and finite derivatives."""

import casadi as ca
import numpy as np
import pytest
from sklearn.gaussian_process import GaussianProcessRegressor

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.gp.expression import evaluate_mean, kernel, kernel_matrix, mean_function
from bayesrace.gp.weights import KERNELS, GpOutput, Weights, zero_weights
from tests.scikit import correlation, scikit_gp

LENGTHS = np.array([1.0, 0.7, 3.0, 0.4, 1.5, 5.0])
CENTRE = np.array([2.0, 0.0, 1.0, 0.0, 0.4, 0.0])
Y_MEAN, Y_SCALE = 0.3, 0.5


def fitted(kind: str, count: int = 40, seed: int = 0) -> tuple[GaussianProcessRegressor, GpOutput]:
    """scikit-learn's GP on random data, and the same as our weights."""
    random = np.random.default_rng(seed)
    z = CENTRE + random.normal(size=(count, 6))
    y = np.sin(z[:, 0]) + z[:, 3] * z[:, 4] + 0.1 * random.normal(size=count)
    gp = scikit_gp(kind, np.log([2.0, *LENGTHS, 0.05]), z, y)
    return gp, GpOutput(
        kernel=kind,
        signal_variance=2.0,
        noise_variance=0.05,
        y_mean=Y_MEAN,
        y_scale=Y_SCALE,
        length_scales=LENGTHS,
        inputs=z,
        alpha=gp.alpha_,
    )


def weights_of(kinds: tuple[str, ...], count: int = 40) -> Weights:
    vx, vy, omega = (fitted(kind, count + i, i)[1] for i, kind in enumerate(kinds))
    return Weights(version="v", car="orca", discretisation="d", outputs=(vx, vy, omega))


def points(count: int = 20, seed: int = 9) -> Floats:
    return CENTRE + np.random.default_rng(seed).normal(size=(count, 6))


@pytest.mark.parametrize("kind", KERNELS)
def test_mean_equals_scikit_learn(kind: str) -> None:
    gp, output = fitted(kind)
    outputs = (output, output, output)
    weights = Weights(version="v", car="orca", discretisation="d", outputs=outputs)
    z = np.vstack((points(), output.inputs))
    expected = Y_MEAN + Y_SCALE * gp.predict(z)
    assert np.abs(evaluate_mean(weights, z) - expected[:, None]).max() < 1e-10


@pytest.mark.parametrize("kind", KERNELS)
def test_kernel_matrix_equals_scikit_learn(kind: str) -> None:
    base = correlation(kind, LENGTHS)
    a, b = points(7), points(5, seed=3)
    assert np.abs(kernel_matrix(kind, a, b, LENGTHS) - base(a, b)).max() < 1e-12
    assert kernel_matrix(kind, a[:0], b, LENGTHS).shape == (0, 5)


@pytest.mark.parametrize("kind", KERNELS)
def test_jacobian_equals_finite_differences(kind: str) -> None:
    mean = mean_function(weights_of((kind, kind, kind)))
    jacobian = mean.factory("jacobian", ["z"], ["jac:mean:z"])
    step = 1e-5
    for z in points(5):
        for j in range(6):
            shift = step * np.eye(6)[j]
            numeric = (np.array(mean(z + shift)) - np.array(mean(z - shift))) / (2 * step)
            assert np.abs(np.array(jacobian(z))[:, j] - numeric[:, 0]).max() < 1e-7


@pytest.mark.parametrize("kind", KERNELS)
def test_derivatives_are_finite_on_a_training_point(kind: str) -> None:
    """sqrt(r^2) has an infinite slope at 0; the Matérn derivatives must not inherit it."""
    weights = weights_of((kind, kind, kind))
    mean = mean_function(weights)
    jacobian = mean.factory("jacobian", ["z"], ["jac:mean:z"])
    z = weights.outputs[0].inputs[3]
    at_point = np.array(jacobian(z))
    assert np.isfinite(at_point).all()
    if kind != "matern05":  # whose mean has a kink there
        nearby = np.array(jacobian(z + 1e-6))
        assert np.abs(at_point - nearby).max() < 1e-4
        hessian = mean.factory(
            "hessian", ["z", "lam:mean"], ["hess:gamma:z:z"], {"gamma": ["mean"]}
        )
        at_point, nearby = (np.array(hessian(p, [1, 1, 1])) for p in (z, z + 1e-5))
        assert np.isfinite(at_point).all()
        if kind != "matern15":  # whose second derivative has a kink there
            assert np.abs(at_point - nearby).max() < 1e-2


def test_slope_of_the_kernels_at_zero_distance() -> None:
    """dk/d(r^2) at 0: -1/2 for RBF, -3/2 for nu = 1.5, -5/6 for nu = 2.5."""
    r2 = ca.SX.sym("r2")
    for kind, expected in (("rbf", -0.5), ("matern15", -1.5), ("matern25", -5 / 6)):
        slope = ca.Function("slope", [r2], [ca.gradient(kernel(kind, r2), r2)])
        assert float(slope(1e-14)) == pytest.approx(expected, rel=1e-5)


def test_zero_weights_give_zero() -> None:
    assert not evaluate_mean(zero_weights("orca", "d"), points()).any()


def test_bad_arguments_are_refused() -> None:
    weights = zero_weights("orca", "d")
    with pytest.raises(InputError):
        evaluate_mean(weights, np.zeros((3, 5)))
    with pytest.raises(InputError, match="cubic"):
        kernel("cubic", np.zeros(3))
    assert evaluate_mean(weights, np.zeros((0, 6))).shape == (0, 3)
