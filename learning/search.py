"""Bayesian optimisation: the minimum of a costly function over the unit cube in few evaluations.

A Gaussian process of scikit-learn (Matern 5/2 with one length scale) learns the function from its
values so far; the next point has the largest expected improvement on the best of them (Jones,
Schonlau and Welch 1998). Its logarithm is maximised, as the improvement itself is zero to the last
bit over most of the cube (Ament et al. 2023).
"""

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.optimize import minimize
from scipy.special import erfcx
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel
from threadpoolctl import threadpool_limits

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.learning.settings import SearchSettings

__all__ = ["Search", "log_improvement", "search"]

_REFIT: Final = 5
"""Evaluations from one choice of the hyperparameters to the next."""
_CANDIDATES: Final = 1000
_STARTS: Final = 3
_NEAR: Final = 0.1, 0.02
"""Standard deviations of the candidates around the best point."""
_STEP: Final = 1e-5
"""Of the differences that are taken for derivatives."""


@dataclass(frozen=True, eq=False)
class Search:
    """What was evaluated, in order."""

    x: Floats
    """Shape (n, dimension), in the unit cube."""
    y: Floats
    """Shape (n,); infinite where the function has no value."""

    @property
    def best(self) -> Floats:
        """Lowest value so far, shape (n,)."""
        return np.minimum.accumulate(self.y)

    @property
    def point(self) -> Floats:
        """Where the lowest value is, shape (dimension,)."""
        return np.asarray(self.x[int(np.argmin(self.y))])


def search(
    function: Callable[[Floats], float],
    dimension: int,
    settings: SearchSettings,
    features: Floats | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> Search:
    """Evaluates ``function`` where the surrogate expects most, after random points.

    ``function`` returns infinity where it has no value; the surrogate learns the worst value there.
    ``features`` (dimension, m): the surrogate measures distances between points times this matrix;
    the identity without. With ``initial`` = ``evaluations`` this is random search. Raises
    InputError if no random point has a value.
    """
    rng = np.random.default_rng(settings.seed)
    x, y, kernel = np.empty((0, dimension)), np.empty(0), None
    features = np.eye(dimension) if features is None else features
    while len(y) < settings.evaluations and not _spent(y, settings):
        point = rng.random(dimension)
        if len(y) >= settings.initial:
            with threadpool_limits(1, "blas"):
                refit = kernel is None or len(y) % _REFIT == 0
                surrogate = _surrogate(x @ features, _finite(y), kernel, refit)
                kernel, point = surrogate.kernel_, _most_promising(surrogate, features, x, y, rng)
        x, y = np.vstack([x, point]), np.append(y, function(point))
        if progress is not None:
            progress(len(y) / settings.evaluations, f"{len(y)}: {y.min():.4g}")
    return Search(x, y)


def _spent(y: Floats, settings: SearchSettings) -> bool:
    """Whether the last evaluations gained too little to go on."""
    if settings.patience is None or len(y) < settings.initial + settings.patience:
        return False
    before = float(y[: -settings.patience].min())
    return float(y.min()) > before - settings.gain * abs(before)


def _finite(y: Floats) -> Floats:
    """The values with the worst one in place of those that are missing."""
    valid = np.isfinite(y)
    if not valid.any():
        raise InputError(
            f"none of the first {len(y)} evaluations has a value: choose another seed, more "
            "initial evaluations, or a narrower range"
        )
    return np.where(valid, y, y[valid].max())


def _surrogate(x: Floats, y: Floats, kernel: Any, refit: bool) -> GaussianProcessRegressor:
    """A Gaussian process through (x, y), with y standardised.

    ``kernel``: of an earlier one, to start from; it stays as it is unless ``refit``.
    """
    if kernel is None:
        smooth = Matern(1.0, (0.05, 50.0), nu=2.5)
        kernel = ConstantKernel(1.0, (1e-2, 1e2)) * smooth + WhiteKernel(1e-4, (1e-6, 1e-2))
    how = "fmin_l_bfgs_b" if refit else None
    process = GaussianProcessRegressor(kernel, alpha=0.0, optimizer=how)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # a parameter on its bound
        return process.fit(x, (y - y.mean()) / (y.std() or 1.0))


def log_improvement(surrogate: GaussianProcessRegressor, x: Floats) -> Floats:
    """ln of the expected improvement of the noise-free function at ``x`` (m, n), shape (m,)."""
    mean, sigma = surrogate.predict(x, return_std=True)
    sigma = np.sqrt(np.maximum(sigma**2 - surrogate.kernel_.k2.noise_level, 1e-12))
    z = (surrogate.y_train_.min() - mean) / sigma
    # sigma (phi(z) + z Phi(z)), by Phi / phi, which does not vanish far below the best.
    h = 1 + z * math.sqrt(math.pi / 2) * erfcx(-z / math.sqrt(2))
    density = -(z**2) / 2 - math.log(2 * math.pi) / 2
    return np.asarray(np.log(sigma * np.maximum(h, 1e-300)) + density)


def _most_promising(
    surrogate: GaussianProcessRegressor,
    features: Floats,
    x: Floats,
    y: Floats,
    rng: np.random.Generator,
) -> Floats:
    """Where the expected improvement is largest, from the best of many random candidates."""
    dimension, best = x.shape[1], x[int(np.argmin(y))]
    spread = [best + rng.normal(0.0, sd, (_CANDIDATES, dimension)) for sd in _NEAR]
    some = rng.random((_CANDIDATES, dimension))
    mixed = np.where(rng.random(some.shape) < 0.25, some, best)
    candidates = np.clip(np.vstack([rng.random(some.shape), mixed, *spread]), 0.0, 1.0)
    differences = np.vstack([np.zeros(dimension), _STEP * np.eye(dimension)])

    def downhill(point: Floats) -> tuple[float, Floats]:
        values = -log_improvement(surrogate, (point + differences) @ features)
        return float(values[0]), (values[1:] - values[0]) / _STEP

    values = log_improvement(surrogate, candidates @ features)
    found = [
        minimize(downhill, start, jac=True, bounds=[(0.0, 1.0)] * dimension, method="L-BFGS-B")
        for start in candidates[np.argsort(-values)[:_STARTS]]
    ]
    return np.asarray(min(found, key=lambda one: float(one.fun)).x)
