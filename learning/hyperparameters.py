"""Hyperparameters of one output's GP by maximum marginal likelihood.

All on standardised features and targets, as theta = log [signal variance, length scales (6), noise
variance].

The bounds matter. Of a Matérn kernel's signal variance s^2 and length scale l, data on a bounded
domain determine only s^2 / l^(2 nu) (Zhang, "Inconsistent estimation and asymptotically equal
interpolations in model-based geostatistics", JASA 2004); along that ridge the likelihood is flat
and large values only cost digits in alpha. So a signal is at most five standard deviations of the
data. Data from a simulator have no noise, and a likelihood without a floor then drives it to where
K is singular; the floor is a thousandth of the data's standard deviation. Together they keep the
condition number of 1000 points below 2.5e10, well within float64.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.optimize import minimize

from bayesrace.arrays import Floats
from bayesrace.gp.weights import FEATURES
from learning.likelihood import MarginalLikelihood, PairDistances
from learning.posterior import Covariance
from learning.settings import TOLERANCE

__all__ = ["BOUNDS", "Fit", "maximise", "starts"]

BOUNDS: Final = np.log([(1e-2, 25.0)] + [(1e-1, 1e2)] * len(FEATURES) + [(1e-6, 1.0)])
"""Lower and upper bound of theta, (8, 2)."""

_ARD: Final = np.eye(len(BOUNDS))
_ISOTROPIC: Final = np.zeros((len(BOUNDS), 3))
_ISOTROPIC[0, 0] = _ISOTROPIC[-1, 2] = 1.0
_ISOTROPIC[1:-1, 1] = 1.0
"""theta as a function of what is searched: all of it, or one length scale for all features."""

_FIRST: Final = np.log([10.0] + [3.0] * len(FEATURES) + [1e-3])
_WORST: Final = 1e25
"""Objective where the covariance is singular; L-BFGS then shortens its step."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A local optimum: ``theta`` (8,) and the log marginal likelihood there."""

    kind: str
    theta: Floats
    log_likelihood: float

    @property
    def covariance(self) -> Covariance:
        """The covariance with these hyperparameters."""
        return Covariance.of(self.kind, self.theta)


def starts(restarts: int, seed: int) -> list[Floats]:
    """First guess and ``restarts`` seeded others, in the part of the bounds where optima are."""
    random = np.random.default_rng(seed)
    low = np.log([1.0] + [1.0] * len(FEATURES) + [1e-5])
    high = np.log([30.0] + [10.0] * len(FEATURES) + [1e-2])
    return [_FIRST] + [random.uniform(low, high) for _ in range(restarts)]


def maximise(
    kind: str,
    pairs: PairDistances,
    y: Floats,
    start: Floats,
    iterations: int,
    tolerance: float = TOLERANCE,
    *,
    isotropic: bool = False,
) -> Fit:
    """L-BFGS-B from ``start`` within :data:`BOUNDS`, at most ``iterations`` iterations.

    ``isotropic``: all features share one length scale, at the start the first one's.
    """
    likelihood = MarginalLikelihood(kind, pairs, y)
    spread = _ISOTROPIC if isotropic else _ARD
    searched = spread.argmax(axis=0)
    # Per sample, so that the optimiser's tolerances do not depend on how many there are.
    scale = 1.0 / len(y)

    def objective(point: Floats) -> tuple[float, Floats]:
        value, gradient = likelihood(spread @ point)
        if not math.isfinite(value):
            return _WORST, np.zeros_like(point)
        return -scale * value, -scale * (gradient @ spread)

    result = minimize(
        objective,
        np.clip(start, *BOUNDS.T)[searched],
        jac=True,
        bounds=BOUNDS[searched],
        method="L-BFGS-B",
        options={"maxiter": iterations, "ftol": tolerance, "gtol": 1e-5},
    )
    return Fit(kind, spread @ result.x, float(-result.fun / scale))
