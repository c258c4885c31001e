"""Log marginal likelihood of a GP with ARD kernel and noise, and hyperparameters that maximise it.

    log p(y) = -1/2 y' K^-1 y - 1/2 log |K| - n/2 log(2 pi),    K = s^2 k(r) + noise I

(Rasmussen and Williams, eq. 5.8 and 5.9), on standardised features and targets, over the logarithms
theta = [signal variance, length scales (6), noise variance], which is also how scikit-learn orders
the hyperparameters of ConstantKernel * RBF + WhiteKernel. Unlike scikit-learn
:class:`MarginalLikelihood` never forms the n x n x 8 tensor of kernel derivatives: all length
scales share dk/d(r^2), so an evaluation costs little more than one factorisation and inverse.
Symmetric matrices are packed, the lower triangle column by column, and factorised and inverted in
LAPACK's rectangular full packed format, which is faster than its square one (Gustavson et al.,
"Rectangular full packed format for Cholesky's algorithm", TOMS 2010). The squared distances per
feature are the same for all outputs, kernels and starts: they are made once
(:class:`PairDistances`).

:func:`maximise` searches from a start, by L-BFGS-B. :func:`refine` takes what was found for some of
the samples to the optimum for all: the curvature there is about the same, and with it as metric a
quasi-Newton method needs seven evaluations where L-BFGS-B, which has to learn it, needs twelve.
L-BFGS-B bounds single parameters only, which are not those of the metric, so SLSQP refines.

The bounds matter. Of a Matérn kernel's signal variance s^2 and length scale l, data on a bounded
domain determine only s^2 / l^(2 nu) (Zhang, "Inconsistent estimation and asymptotically equal
interpolations in model-based geostatistics", JASA 2004); along that ridge the likelihood is flat
and large values only cost digits in alpha. So a signal is at most five standard deviations of the
data. Data from a simulator have no noise, and a likelihood without a floor then drives it to where
K is singular; the floor is a thousandth of the data's standard deviation. Together they keep the
condition number of 1000 points below 2.5e10, well within float64.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import blas, lapack
from scipy.optimize import LinearConstraint, minimize

from bayesrace.arrays import Floats
from bayesrace.gp.expression import kernel, kernel_slope
from bayesrace.gp.weights import FEATURES
from bayesrace.learning.posterior import Covariance
from bayesrace.learning.settings import TOLERANCE

__all__ = ["BOUNDS", "Fit", "MarginalLikelihood", "PairDistances", "maximise", "refine", "starts"]

BOUNDS: Final = np.log([(1e-2, 25.0)] + [(1e-1, 1e2)] * len(FEATURES) + [(1e-6, 1.0)])
"""Lower and upper bound of theta, (8, 2)."""

_ISOTROPIC: Final = np.eye(3)[[0] + [1] * len(FEATURES) + [2]]
"""theta (8,) as a function of what is searched where all features share one length scale, (3,)."""

_FIRST: Final = np.log([10.0] + [3.0] * len(FEATURES) + [1e-3])
_WORST: Final = 1e25
"""Objective where the covariance is singular; an optimiser then shortens its step."""

_CURVATURE: Final = 0.05, 50.0
"""Smallest and largest eigenvalue of an inverse Hessian that is believed."""


class PairDistances:
    """Squared distances per feature of all pairs of ``z`` (n, p), read by any number of threads."""

    def __init__(self, z: Floats) -> None:
        self.count = len(z)
        columns, rows = np.triu_indices(self.count)
        self.diagonal = np.flatnonzero(rows == columns)
        """Where a packed matrix has its diagonal, (n,)."""
        self.squares = np.ascontiguousarray(((z[rows] - z[columns]) ** 2).T)
        """(p, n (n + 1) / 2), packed."""


class MarginalLikelihood:
    """log p(y | z, theta) for the pairs of scaled features and scaled targets ``y`` (n,)."""

    def __init__(self, kind: str, pairs: PairDistances, y: Floats) -> None:
        self._kind, self._pairs, self._y = kind, pairs, np.asarray(y, dtype=np.float64)

    def __call__(self, theta: Floats) -> tuple[float, Floats]:
        """Value and gradient (p + 2,); -inf and zeros where K is numerically singular."""
        count, diagonal, squares = self._pairs.count, self._pairs.diagonal, self._pairs.squares
        signal, noise = math.exp(theta[0]), math.exp(theta[-1])
        precision = np.exp(-2 * theta[1:-1])
        r2 = precision @ squares
        k = kernel(self._kind, r2)
        packed = signal * k
        packed[diagonal] += noise
        matrix, _ = lapack.dtpttf(count, packed, uplo="L")
        factor, failed = lapack.dpftrf(count, matrix, uplo="L", overwrite_a=1)
        if failed:
            return -math.inf, np.zeros_like(theta)
        packed, _ = lapack.dtfttp(count, factor, uplo="L")
        log_det = 2 * float(np.log(packed[diagonal]).sum())
        alpha, _ = lapack.dpftrs(count, factor, self._y, uplo="L")
        value = -0.5 * (self._y @ alpha + log_det + count * math.log(2 * math.pi))
        # d log p / d theta = 1/2 tr((alpha alpha' - K^-1) dK/dtheta); pairs count twice.
        inverse, _ = lapack.dpftri(count, factor, uplo="L", overwrite_a=1)
        packed, _ = lapack.dtfttp(count, inverse, uplo="L")
        weight = blas.dspr(count, 1.0, alpha, -packed, lower=1, overwrite_ap=1)
        weight[diagonal] *= 0.5
        gradient = np.empty_like(theta)
        gradient[0] = signal * (weight @ k)
        gradient[-1] = noise * weight[diagonal].sum()
        weight *= kernel_slope(self._kind, r2, k)
        gradient[1:-1] = -2 * signal * precision * (squares @ weight)
        return value, gradient


@dataclass(frozen=True, eq=False)
class Fit:
    """A local optimum: ``theta`` (8,) and the log marginal likelihood there.

    ``inverse_hessian`` (8, 8): of the negative log likelihood per sample, as the optimiser
    estimates it.
    """

    kind: str
    theta: Floats
    log_likelihood: float
    inverse_hessian: Floats

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
    cost = _cost(kind, pairs, y)
    spread = _ISOTROPIC if isotropic else np.eye(len(BOUNDS))
    searched = spread.argmax(axis=0)

    def objective(point: Floats) -> tuple[float, Floats]:
        value, gradient = cost(spread @ point)
        return value, gradient @ spread

    result = minimize(
        objective,
        np.clip(start, *BOUNDS.T)[searched],
        jac=True,
        bounds=BOUNDS[searched],
        method="L-BFGS-B",
        options={"maxiter": iterations, "ftol": tolerance, "gtol": 1e-5},
    )
    inverse_hessian = spread @ result.hess_inv.todense() @ spread.T
    return Fit(kind, spread @ result.x, -len(y) * float(result.fun), inverse_hessian)


def refine(
    pairs: PairDistances, y: Floats, rough: Fit, iterations: int, tolerance: float = TOLERANCE
) -> Fit:
    """SLSQP from a fit to some of the samples within :data:`BOUNDS`, at most ``iterations``."""
    cost = _cost(rough.kind, pairs, y)
    values, vectors = np.linalg.eigh(rough.inverse_hessian)
    metric = vectors * np.sqrt(np.clip(values, *_CURVATURE))

    def theta(point: Floats) -> Floats:
        return np.asarray(np.clip(rough.theta + metric @ point, *BOUNDS.T))

    def objective(point: Floats) -> tuple[float, Floats]:
        value, gradient = cost(theta(point))
        return value, gradient @ metric

    result = minimize(
        objective,
        np.zeros(len(BOUNDS)),
        jac=True,
        constraints=LinearConstraint(metric, *(BOUNDS.T - rough.theta)),
        method="SLSQP",
        options={"maxiter": iterations, "ftol": tolerance},
    )
    likelihood = -len(y) * float(result.fun)
    return Fit(rough.kind, theta(result.x), likelihood, rough.inverse_hessian)


def _cost(kind: str, pairs: PairDistances, y: Floats) -> Callable[[Floats], tuple[float, Floats]]:
    """Negative log likelihood per sample, so that tolerances do not depend on how many there are,
    and its gradient, as functions of theta."""
    likelihood = MarginalLikelihood(kind, pairs, y)

    def cost(theta: Floats) -> tuple[float, Floats]:
        value, gradient = likelihood(theta)
        if not math.isfinite(value):
            return _WORST, np.zeros_like(theta)
        return -value / len(y), -gradient / len(y)

    return cost
