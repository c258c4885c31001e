"""Bayesian optimisation: the minimum of a costly function over the unit cube in few evaluations.

A Gaussian process (scikit-learn, Matern 5/2 with one length scale) learns the function from its
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
from pydantic import BaseModel, ConfigDict, Field
from scipy.linalg import cho_solve
from scipy.optimize import minimize as bounded_minimum
from scipy.spatial.distance import cdist
from scipy.special import erfcx
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel
from threadpoolctl import threadpool_limits

from bayesrace.arrays import Floats
from bayesrace.errors import InputError

__all__ = ["Search", "SearchSettings", "Surrogate", "search"]

_REFIT: Final = 5
"""Evaluations from one choice of the hyperparameters to the next."""
_CANDIDATES: Final = 1000
_STARTS: Final = 3
_NEAR: Final = 0.1, 0.02
"""Standard deviations of the candidates around the best point."""


class SearchSettings(BaseModel):
    """How long and from where :func:`search` looks; a search is a function of these alone."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    evaluations: int = Field(110, ge=1, le=2000, description="most evaluations, random ones too")
    initial: int = Field(10, ge=1, description="random evaluations before the first surrogate")
    patience: int | None = Field(
        None, ge=1, description="evaluations without a gain after which it ends; None: never"
    )
    gain: float = Field(1e-3, gt=0, description="decrease that counts, over the best value")
    seed: int = Field(0, ge=0, description="of the random points and of the candidates")


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
    x, y = np.empty((0, dimension)), np.empty(0)
    features = np.eye(dimension) if features is None else features
    kernel = None
    while len(y) < settings.evaluations and not _spent(y, settings):
        if len(y) < settings.initial:
            point = rng.random(dimension)
        else:
            with threadpool_limits(1, "blas"):
                refit = kernel is None or len(y) % _REFIT == 0
                surrogate = Surrogate(x, _finite(y), features, kernel, refit)
                kernel, point = surrogate.kernel, _most_promising(surrogate, x, y, rng)
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


class Surrogate:
    """A Gaussian process through (x, y), and the logarithm of its expected improvement."""

    def __init__(
        self, x: Floats, y: Floats, features: Floats, kernel: Any = None, refit: bool = True
    ) -> None:
        """``features``: see :func:`search`. ``kernel``: of an earlier surrogate, to start from; it
        stays as it is unless ``refit``."""
        scaled = (y - y.mean()) / (y.std() or 1.0)
        if kernel is None:
            smooth = Matern(1.0, (0.05, 50.0), nu=2.5)
            kernel = ConstantKernel(1.0, (1e-2, 1e2)) * smooth + WhiteKernel(1e-4, (1e-6, 1e-2))
        process = GaussianProcessRegressor(
            kernel, alpha=0.0, optimizer="fmin_l_bfgs_b" if refit else None
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # a parameter on its bound
            process.fit(x @ features, scaled)
        self.kernel = process.kernel_
        self._process, self._features = process, features
        self._variance = float(self.kernel.k1.k1.constant_value)
        self._scale = float(self.kernel.k1.k2.length_scale)
        self._best = float(scaled.min())

    def log_improvement(self, x: Floats) -> Floats:
        """ln of the expected improvement at ``x`` (m, dimension), over the deviation of y; (m,)."""
        at = cdist(x @ self._features, self._process.X_train_)
        sigma, z, _q, h, _inverse = self._improvement(at)
        return np.asarray(np.log(sigma * h) - z**2 / 2 - math.log(2 * math.pi) / 2)

    def gradient(self, x: Floats) -> Floats:
        """Of :meth:`log_improvement` at one point ``x`` (dimension,)."""
        apart = x @ self._features - self._process.X_train_
        distance = np.linalg.norm(apart, axis=1)
        sigma, _z, q, h, inverse = self._improvement(distance[None])
        r = math.sqrt(5) / self._scale * distance
        slope = -5 / 3 * self._variance * np.exp(-r) * (1 + r) / self._scale**2
        weights = (inverse[0] / sigma[0] + q[0] * self._process.alpha_) * slope
        return np.asarray(-self._features @ (weights @ apart) / (sigma[0] * h[0]))

    def _improvement(self, distance: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """For distances (m, n) from the data: sigma and z of the prediction, q = Phi(z) / phi(z)
        and h = 1 + z q, each (m,), and K^-1 k, (m, n); the improvement is sigma phi(z) h."""
        r = math.sqrt(5) / self._scale * distance
        k = self._variance * np.exp(-r) * (1 + r + r**2 / 3)
        inverse = cho_solve((self._process.L_, True), k.T, check_finite=False).T
        sigma = np.sqrt(np.maximum(self._variance - np.sum(k * inverse, axis=1), 1e-12))
        z = (self._best - k @ self._process.alpha_) / sigma
        q = math.sqrt(math.pi / 2) * erfcx(-z / math.sqrt(2))
        return sigma, z, q, np.maximum(1 + z * q, 1e-300), inverse


def _most_promising(surrogate: Surrogate, x: Floats, y: Floats, rng: np.random.Generator) -> Floats:
    """Where the expected improvement is largest, from the best of many random candidates."""
    dimension, best = x.shape[1], x[int(np.argmin(y))]
    spread = [best + rng.normal(0.0, sd, (_CANDIDATES, dimension)) for sd in _NEAR]
    some = rng.random((_CANDIDATES, dimension))
    mixed = np.where(rng.random(some.shape) < 0.25, some, best)
    candidates = np.clip(np.vstack([rng.random(some.shape), mixed, *spread]), 0.0, 1.0)
    values = surrogate.log_improvement(candidates)
    found = []
    for start in candidates[np.argsort(-values)[:_STARTS]]:

        def downhill(point: Floats) -> tuple[float, Floats]:
            return -float(surrogate.log_improvement(point[None])[0]), -surrogate.gradient(point)

        result = bounded_minimum(
            downhill, start, jac=True, bounds=[(0.0, 1.0)] * dimension, method="L-BFGS-B"
        )
        found.append((float(result.fun), result.x))
    return np.asarray(min(found, key=lambda one: one[0])[1])
