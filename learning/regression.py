"""One output's GP on scaled samples: scaling, scikit-learn's regressor, held-out errors."""

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern, WhiteKernel

from bayesrace.errors import InputError
from bayesrace.gp.expression import kernel_matrix
from learning.crossvalidation import held_out
from learning.scores import PredictionErrors

__all__ = ["Scaling", "held_out_errors", "judged", "regressor", "scaling_of"]

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]

_NU: Final = {"matern05": 0.5, "matern15": 1.5, "matern25": 2.5}


@dataclass(frozen=True)
class Scaling:
    """Features and one output in units of their standard deviation about their mean."""

    z_mean: Floats
    z_scale: Floats
    y_mean: float
    y_scale: float

    def features(self, z: Floats) -> Floats:
        """Scaled features (n, 6)."""
        scaled: Floats = (z - self.z_mean) / self.z_scale
        return scaled

    def targets(self, y: Floats) -> Floats:
        """Scaled targets (n,)."""
        scaled: Floats = (y - self.y_mean) / self.y_scale
        return scaled


def scaling_of(z: Floats, y: Floats) -> Scaling:
    """The scaling of features (n, 6) and one output's residual (n,)."""
    return Scaling(z.mean(axis=0), z.std(axis=0), float(y.mean()), float(y.std()))


def _sklearn_kernel(kind: str, theta: Floats) -> Any:
    signal, lengths, noise = math.exp(theta[0]), np.exp(theta[1:-1]), math.exp(theta[-1])
    base = RBF(lengths) if kind == "rbf" else Matern(lengths, nu=_NU[kind])
    return ConstantKernel(signal) * base + WhiteKernel(noise)


def regressor(kind: str, theta: Floats, z: Floats, y: Floats) -> GaussianProcessRegressor:
    """scikit-learn's GP, hyperparameters fixed, fitted to scaled ``z`` (n, 6) and ``y`` (n,)."""
    gp = GaussianProcessRegressor(_sklearn_kernel(kind, theta), alpha=0.0, optimizer=None)
    try:
        return gp.fit(z, y)
    except np.linalg.LinAlgError as error:
        raise InputError("GP training: covariance is singular; are samples repeated?") from error


def held_out_errors(gp: GaussianProcessRegressor, y: Floats, folds: Rows) -> PredictionErrors:
    """Errors of a fitted regressor on its own samples, each predicted without its fold."""
    inverse = cho_solve((gp.L_, True), np.eye(len(y)))
    return held_out(0.5 * (inverse + inverse.T), y, folds)


def judged(
    kind: str, theta: Floats, z: Floats, y: Floats, rows: Rows, tests: Rows, folds: Rows
) -> PredictionErrors:
    """Errors at ``tests`` of a GP on ``rows``, both indices into all samples ``z``, ``y``.

    Each fold's tests are predicted from the rows of all other ``folds`` (n,). Unlike
    :func:`held_out_errors` this judges a choice of samples by all samples.
    """
    signal, lengths, noise = math.exp(theta[0]), np.exp(theta[1:-1]), math.exp(theta[-1])
    error, sigma = np.empty(len(tests)), np.empty(len(tests))
    for fold in np.unique(folds[tests]):
        inside = folds[tests] == fold
        known, asked = rows[folds[rows] != fold], tests[inside]
        if len(known) == 0:
            error[inside], sigma[inside] = y[asked], math.sqrt(signal + noise)
            continue
        covariance = signal * kernel_matrix(kind, z[known], z[known], lengths)
        covariance[np.diag_indices_from(covariance)] += noise
        cross = signal * kernel_matrix(kind, z[known], z[asked], lengths)
        try:
            factor, _ = cho_factor(covariance, lower=True, overwrite_a=True, check_finite=False)
        except np.linalg.LinAlgError as failure:
            raise InputError("GP training: covariance is singular; are samples repeated?") from (
                failure
            )
        explained = solve_triangular(factor, cross, lower=True, check_finite=False)
        whitened = solve_triangular(factor, y[known], lower=True, check_finite=False)
        error[inside] = y[asked] - whitened @ explained
        variance = signal + noise - np.einsum("ij,ij->j", explained, explained)
        sigma[inside] = np.sqrt(np.maximum(variance, noise))
    return PredictionErrors(error, sigma)
