"""Bayesian optimisation: the minimum of a costly function over the unit cube in few evaluations.

A Gaussian process of scikit-learn (Matern 5/2 with one length scale) learns the function from its
values so far; of many random points, the one with the largest expected improvement on the best of
them is next (Jones, Schonlau and Welch 1998). Its logarithm is compared, as the improvement itself
is zero to the last bit over most of the cube (Ament et al. 2023).
"""

import math
import warnings
from collections.abc import Callable
from typing import Final, NamedTuple

import numpy as np
from scipy.special import erfcx
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel
from threadpoolctl import threadpool_limits

from bayesrace.arrays import Floats
from bayesrace.errors import InputError

__all__ = ["INITIAL", "Search", "log_improvement", "search"]

INITIAL: Final = 10
"""Random evaluations before the first Gaussian process."""
_CANDIDATES: Final = 3000
_NEAR: Final = 0.1, 0.02
"""Standard deviations of the candidates around the best point."""


class Search(NamedTuple):
    """What was evaluated, in order."""

    x: Floats
    """Shape (n, dimension), in the unit cube."""
    y: Floats
    """Shape (n,); infinite where the function has no value."""

    @property
    def point(self) -> Floats:
        """Where the lowest value is, shape (dimension,)."""
        return np.asarray(self.x[int(np.argmin(self.y))])


def search(
    function: Callable[[Floats], float],
    features: Floats,
    evaluations: int,
    seed: int,
    progress: Callable[[float, str], None] = lambda share, text: None,
) -> Search:
    """Evaluates ``function`` where most improvement is expected, after :data:`INITIAL` random
    points.

    The process measures distances between points times ``features`` (dimension, m), and learns the
    worst value where the function returns infinity: it has none there. Raises InputError if no
    random point has a value.
    """
    rng, dimension = np.random.default_rng(seed), len(features)
    x, y = np.empty((0, dimension)), np.empty(0)
    smooth = Matern(1.0, (0.05, 50.0), nu=2.5)
    kernel = ConstantKernel(1.0, (1e-2, 1e2)) * smooth + WhiteKernel(1e-4, (1e-6, 1e-2))
    for number in range(evaluations):
        point = rng.random(dimension)
        if number >= INITIAL:
            valid = np.isfinite(y)
            if not valid.any():
                raise InputError(
                    f"none of the first {number} evaluations has a value: choose another seed or "
                    "a narrower range"
                )
            process = GaussianProcessRegressor(kernel, alpha=0.0, normalize_y=True)
            candidates = _candidates(x[int(np.argmin(y))], rng)
            with threadpool_limits(1, "blas"), warnings.catch_warnings():
                warnings.simplefilter("ignore", ConvergenceWarning)  # a parameter on its bound
                process.fit(x @ features, np.where(valid, y, y[valid].max()))
                gain = log_improvement(process, candidates @ features, y.min())
            kernel, point = process.kernel_, candidates[int(np.argmax(gain))]
        x, y = np.vstack([x, point]), np.append(y, function(point))
        progress(len(y) / evaluations, f"{len(y)}: {y.min():.4g}")
    return Search(x, y)


def _candidates(best: Floats, rng: np.random.Generator) -> Floats:
    """Points anywhere, those that share most coordinates with the best one, and those near it."""
    shape = _CANDIDATES, len(best)
    mixed = np.where(rng.random(shape) < 0.25, rng.random(shape), best)
    near = [best + rng.normal(0.0, sd, shape) for sd in _NEAR]
    return np.asarray(np.clip(np.vstack([rng.random(shape), mixed, *near]), 0.0, 1.0))


def log_improvement(process: GaussianProcessRegressor, x: Floats, best: float) -> Floats:
    """ln of the expected improvement on ``best`` at the features ``x`` (m, n), noise included,
    shape (m,)."""
    mean, sigma = process.predict(x, return_std=True)
    z = (best - mean) / sigma
    # sigma (phi(z) + z Phi(z)), by Phi / phi, which does not vanish far below the best.
    h = 1 + z * math.sqrt(math.pi / 2) * erfcx(-z / math.sqrt(2))
    density = -(z**2) / 2 - math.log(2 * math.pi) / 2
    return np.asarray(np.log(sigma * np.maximum(h, 1e-300)) + density)
