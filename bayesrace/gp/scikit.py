"""Weights as scikit-learn's Gaussian processes, and back.

A :class:`sklearn.gaussian_process.GaussianProcessRegressor` with the kernel

    ConstantKernel(signal) * (RBF or Matern(nu = 0.5, 1.5, 2.5)) + WhiteKernel(noise)

has the same posterior mean and variance as an output of :class:`bayesrace.gp.weights.Weights`.
"""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import (
    RBF,
    ConstantKernel,
    Matern,
    Product,
    Sum,
    WhiteKernel,
)
from threadpoolctl import threadpool_limits

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.gp.weights import FEATURES, OUTPUTS, GpOutput, Weights
from bayesrace.integrators import PREDICTION, Discretisation
from bayesrace.vehicles.parameters import Car

__all__ = ["NU", "output_of", "regressors_of", "weights_of"]

NU: Final = {"matern05": 0.5, "matern15": 1.5, "matern25": 2.5}
"""Smoothness of the Matérn kernels by our names."""
_KINDS: Final = {nu: kind for kind, nu in NU.items()} | {np.inf: "rbf"}
_CHECKED: Final = 200
"""Training points that go with the weights, for a controller to check them by."""


def weights_of(
    regressors: Sequence[GaussianProcessRegressor],
    car: Car,
    discretisation: Discretisation = PREDICTION,
    version: str = "scikit-learn",
) -> Weights:
    """Weights of fitted regressors for vx, vy, omega: :meth:`Weights.from_sklearn`."""
    if len(regressors) != len(OUTPUTS):
        raise InputError(
            f"{len(regressors)} regressors: give {len(OUTPUTS)}, for {', '.join(OUTPUTS)}"
        )
    vx, vy, omega = (
        output_of(one, f"the regressor of {name}", len(FEATURES))
        for one, name in zip(regressors, OUTPUTS, strict=True)
    )
    every = np.asarray(regressors[0].X_train_, dtype=np.float64)
    rows = np.unique(np.linspace(0, len(every) - 1, _CHECKED).astype(int))
    known = [_targets(one, every)[rows] for one in regressors]
    return Weights(
        version=version,
        car=car.name,
        discretisation=discretisation.identity("e_kinematic", car),
        program="scikit-learn",
        sample_features=every[rows],
        sample_residuals=np.column_stack(known),
        outputs=(vx, vy, omega),
    )


def _targets(regressor: GaussianProcessRegressor, z: Floats) -> Floats:
    """What it was fitted to, if that was at these features; else what it predicts there."""
    if not np.array_equal(regressor.X_train_, z):
        return np.asarray(regressor.predict(z))
    scaled = np.ravel(regressor.y_train_)
    return np.asarray(scaled * regressor._y_train_std + regressor._y_train_mean)


def output_of(regressor: GaussianProcessRegressor, name: str, width: int) -> GpOutput:
    """One output; InputError names what has no counterpart. ``width``: its features."""
    if not isinstance(regressor, GaussianProcessRegressor) or not hasattr(regressor, "alpha_"):
        raise InputError(f"{name} is no fitted GaussianProcessRegressor: call its fit first")
    inputs, alpha = np.asarray(regressor.X_train_), np.asarray(regressor.alpha_)
    if inputs.shape[1:] != (width,) or alpha.size != len(inputs):
        raise InputError(
            f"{name} was fitted to X {inputs.shape} and y with {alpha.size} numbers; expected "
            f"(n, {width}) and (n,)"
        )
    if np.ndim(regressor.alpha):
        raise InputError(f"{name} has a noise for each sample (alpha): give it one number")
    kind, signal, lengths, noise = _parts(regressor.kernel_, name)
    return GpOutput(
        kernel=kind,
        signal_variance=signal,
        noise_variance=noise + float(regressor.alpha),
        y_mean=float(np.ravel(regressor._y_train_mean)[0]),
        y_scale=float(np.ravel(regressor._y_train_std)[0]),
        length_scales=np.broadcast_to(lengths, width),
        inputs=inputs,
        alpha=alpha.ravel(),
    )


def _parts(kernel: Any, name: str) -> tuple[str, float, Floats, float]:
    """Kind, signal variance, length scales and noise variance of a kernel."""
    noise, found = 0.0, list[tuple[float, Any]]()
    for factor, parts in _terms(kernel, name):
        if parts and all(isinstance(one, WhiteKernel) for one in parts):
            noise += factor * float(np.prod([one.noise_level for one in parts]))
        elif len(parts) == 1:
            found.append((factor, parts[0]))
        else:
            what = "a product of kernels" if parts else "a constant that is added"
            raise InputError(f"{name} has {what} in {kernel}: {_WANTED}")
    if len(found) != 1:
        what = "a sum of kernels" if found else "white noise alone"
        raise InputError(f"{name} has {what}, {kernel}: {_WANTED}")
    signal, base = found[0]
    nu = base.nu if isinstance(base, Matern) else np.inf
    if nu not in _KINDS:
        raise InputError(f"{name} has a Matern kernel with nu = {nu:g}: give 0.5, 1.5 or 2.5")
    return _KINDS[nu], signal, np.asarray(base.length_scale, dtype=np.float64), noise


_WANTED: Final = "give ConstantKernel * (RBF or Matern) + WhiteKernel"


def _terms(kernel: Any, name: str) -> list[tuple[float, list[Any]]]:
    """A kernel as a sum of products: the constant factor and the other factors of each."""
    if isinstance(kernel, Sum):
        return _terms(kernel.k1, name) + _terms(kernel.k2, name)
    if isinstance(kernel, Product):
        left, right = _terms(kernel.k1, name), _terms(kernel.k2, name)
        return [(a * b, one + other) for a, one in left for b, other in right]
    if isinstance(kernel, ConstantKernel):
        return [(float(kernel.constant_value), [])]
    if isinstance(kernel, RBF | WhiteKernel):  # a Matern is an RBF, too
        return [(1.0, [kernel])]
    raise InputError(f"{name} has a {type(kernel).__name__} kernel, {kernel}: {_WANTED}")


def regressors_of(weights: Weights) -> tuple[GaussianProcessRegressor, ...]:
    """A fitted regressor for each output; see :meth:`Weights.to_sklearn`."""
    return tuple(_regressor(one, name) for one, name in zip(weights.outputs, OUTPUTS, strict=True))


def _regressor(output: GpOutput, name: str) -> GaussianProcessRegressor:
    if not output.count:
        raise InputError(f"the output {name} has no training point: there is no process to give")
    lengths = output.length_scales.copy()
    base = RBF(lengths) if output.kernel == "rbf" else Matern(lengths, nu=NU[output.kernel])
    covariance = ConstantKernel(output.signal_variance) * base
    kernel = covariance + WhiteKernel(output.noise_variance)
    targets = kernel(output.inputs) @ output.alpha
    made = GaussianProcessRegressor(kernel, alpha=0.0, optimizer=None)
    with threadpool_limits(1, "blas"):  # threads would wait for each other
        made.fit(output.inputs, targets)
    # Found again by a factorisation, alpha would differ by its rounding.
    made.alpha_ = output.alpha.copy()
    made._y_train_mean, made._y_train_std = output.y_mean, output.y_scale
    return made
