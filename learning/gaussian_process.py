"""One output's Gaussian process: its posterior, and hyperparameters of maximum likelihood.

**Posterior.** With K the covariance of the training samples, noise included, and k that with a new
point (Rasmussen and Williams, "Gaussian Processes for Machine Learning", eq. 2.25 and 2.26)

    alpha = K^-1 y,    mean = k' alpha,    variance = s^2 + noise - k' K^-1 k.

Without a fold B of the training samples, K^-1 becomes that of the others, padded with zeros. With
K = L L', r = L^-1 k, and the columns of Q an orthonormal basis of those of L^-1 in B, that is

    r~ = r - Q Q' r,    mean = r~' L^-1 y,    variance = s^2 + noise - r~' r~,

so that one factorisation does for all folds.

**Likelihood.**

    log p(y) = -1/2 y' K^-1 y - 1/2 log |K| - n/2 log(2 pi),    K = s^2 k(r) + noise I

(Rasmussen and Williams, eq. 5.8 and 5.9), on standardised features and targets, over the logarithms
theta = [signal variance, length scales (6), noise variance], which is also how scikit-learn orders
the hyperparameters of ConstantKernel * RBF + WhiteKernel. Unlike scikit-learn
:func:`likelihood` never forms the n x n x 8 tensor of kernel derivatives: all length
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
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import blas, cholesky, lapack, solve_triangular
from scipy.optimize import LinearConstraint, minimize

from bayesrace.arrays import Floats, Rows
from bayesrace.errors import InputError
from bayesrace.gp.expression import kernel, kernel_matrix, kernel_slope
from bayesrace.gp.weights import FEATURES
from bayesrace.learning.settings import TOLERANCE

__all__ = ["BOUNDS", "Covariance", "Fit", "PairDistances", "Posterior", "likelihood", "maximise"]
__all__ += ["refine", "starts"]

BOUNDS: Final = np.log([(1e-2, 25.0)] + [(1e-1, 1e2)] * len(FEATURES) + [(1e-6, 1.0)])
"""Lower and upper bound of theta, (8, 2)."""

_ISOTROPIC: Final = np.eye(3)[[0] + [1] * len(FEATURES) + [2]]
"""theta (8,) as a function of what is searched where all features share one length scale, (3,)."""

_FIRST: Final = np.log([10.0] + [3.0] * len(FEATURES) + [1e-3])
_WORST: Final = 1e25
"""Objective where the covariance is singular; an optimiser then shortens its step."""

_CURVATURE: Final = 0.05, 50.0
"""Smallest and largest eigenvalue of an inverse Hessian that is believed."""

_AT_ONCE: Final = 4096
"""Points predicted together: their covariances with all training samples are in memory."""


@dataclass(frozen=True, eq=False)
class Covariance:
    """s^2 k(r) plus noise: kind of kernel, both variances, length scales (6,)."""

    kind: str
    signal: float
    lengths: Floats
    noise: float

    @classmethod
    def of(cls, kind: str, theta: Floats) -> "Covariance":
        """From theta = log [signal variance, length scales (6), noise variance]."""
        signal, *lengths, noise = np.exp(theta)
        return cls(kind, float(signal), np.array(lengths), float(noise))

    def between(self, a: Floats, b: Floats) -> Floats:
        """Covariances (n, m) of the noise-free outputs at features ``a`` (n, 6), ``b`` (m, 6)."""
        return self.signal * kernel_matrix(self.kind, a, b, self.lengths)


class Posterior:
    """The GP after seeing targets ``y`` (n,) at features ``z`` (n, 6); n may be 0.

    ``known``: variances (n,) that the targets have besides the covariance's noise. InputError if
    the covariance of the samples is singular.
    """

    def __init__(
        self, covariance: Covariance, z: Floats, y: Floats, known: Floats | float = 0.0
    ) -> None:
        self._covariance, self._z = covariance, z
        matrix = covariance.between(z, z)
        matrix[np.diag_indices_from(matrix)] += covariance.noise + known
        try:
            self._factor = cholesky(matrix, lower=True, overwrite_a=True)
        except np.linalg.LinAlgError as error:
            fault = "GP: the covariance of the samples is singular"
            raise InputError(f"{fault}; train without repeated samples") from error
        self._white = self._solved(y)
        self.alpha: Floats = solve_triangular(self._factor, self._white, trans=1, lower=True)
        """K^-1 y, (n,)."""

    def _solved(self, right: Floats) -> Floats:
        """L^-1 times a vector or a matrix."""
        solved: Floats = solve_triangular(self._factor, right, lower=True, check_finite=False)
        return solved

    def _sigma(self, root: Floats) -> Floats:
        """Standard deviations, noise included, for the columns of L^-1 k."""
        noise, prior = self._covariance.noise, self._covariance.signal + self._covariance.noise
        explained = np.einsum("ij,ij->j", root, root)
        return np.asarray(np.sqrt(np.maximum(prior - explained, noise)))

    def predict(self, z: Floats) -> tuple[Floats, Floats]:
        """Mean and standard deviation, noise included, each (m,), at features ``z`` (m, 6)."""
        mean, sigma = np.empty(len(z)), np.empty(len(z))
        for begin in range(0, len(z), _AT_ONCE):
            part = slice(begin, begin + _AT_ONCE)
            cross = self._covariance.between(self._z, z[part])
            mean[part] = self.alpha @ cross
            sigma[part] = self._sigma(self._solved(cross))
        return mean, sigma

    def predict_without(self, folds: Rows, z: Floats, own: Rows) -> tuple[Floats, Floats]:
        """As :meth:`predict`, each point without the training samples of its own fold.

        ``folds`` (n,) numbers those of the training samples, ``own`` (m,) those of the points.
        """
        inverse = np.tril(lapack.dtrtri(self._factor, lower=1)[0])
        mean, sigma = np.empty(len(z)), np.empty(len(z))
        for fold in np.unique(own):
            part = own == fold
            basis, _ = np.linalg.qr(inverse[:, folds == fold])
            root = self._solved(self._covariance.between(z[part], self._z).T)
            root -= basis @ (basis.T @ root)
            mean[part], sigma[part] = self._white @ root, self._sigma(root)
        return mean, sigma


class PairDistances:
    """Squared distances per feature of all pairs of ``z`` (n, p), read by any number of threads."""

    def __init__(self, z: Floats) -> None:
        self.count = len(z)
        columns, rows = np.triu_indices(self.count)
        self.diagonal = np.flatnonzero(rows == columns)
        """Where a packed matrix has its diagonal, (n,)."""
        self.squares = np.ascontiguousarray(((z[rows] - z[columns]) ** 2).T)
        """(p, n (n + 1) / 2), packed."""


def likelihood(
    kind: str, pairs: PairDistances, y: Floats, theta: Floats, known: Floats | float = 0.0
) -> tuple[float, Floats]:
    """log p(y | z, theta) for pairs of scaled features and scaled targets ``y`` (n,), and its
    gradient (p + 2,); -inf and zeros where K is numerically singular. ``known``: variances (n,)
    besides the noise in theta."""
    count, diagonal, squares = pairs.count, pairs.diagonal, pairs.squares
    signal, noise = math.exp(theta[0]), math.exp(theta[-1])
    precision = np.exp(-2 * theta[1:-1])
    r2 = precision @ squares
    k = kernel(kind, r2)
    packed = signal * k
    packed[diagonal] += noise + known
    matrix, _ = lapack.dtpttf(count, packed, uplo="L")
    factor, failed = lapack.dpftrf(count, matrix, uplo="L", overwrite_a=1)
    if failed:
        return -math.inf, np.zeros_like(theta)
    packed, _ = lapack.dtfttp(count, factor, uplo="L")
    log_det = 2 * float(np.log(packed[diagonal]).sum())
    alpha, _ = lapack.dpftrs(count, factor, y, uplo="L")
    value = -0.5 * (y @ alpha + log_det + count * math.log(2 * math.pi))
    # d log p / d theta = 1/2 tr((alpha alpha' - K^-1) dK/dtheta); pairs count twice.
    inverse, _ = lapack.dpftri(count, factor, uplo="L", overwrite_a=1)
    packed, _ = lapack.dtfttp(count, inverse, uplo="L")
    weight = blas.dspr(count, 1.0, alpha, -packed, lower=1, overwrite_ap=1)
    weight[diagonal] *= 0.5
    gradient = np.empty_like(theta)
    gradient[0] = signal * (weight @ k)
    gradient[-1] = noise * weight[diagonal].sum()
    weight *= kernel_slope(kind, r2, k)
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
    known: Floats | float = 0.0,
) -> Fit:
    """L-BFGS-B from ``start`` within :data:`BOUNDS`, at most ``iterations`` iterations.

    ``known``: as of :func:`likelihood`. ``isotropic``: all features share one length scale, at the
    start the first one's.
    """
    spread = _ISOTROPIC if isotropic else np.eye(len(BOUNDS))
    searched = spread.argmax(axis=0)

    def objective(point: Floats) -> tuple[float, Floats]:
        value, gradient = _cost(kind, pairs, y, spread @ point, known)
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
    pairs: PairDistances,
    y: Floats,
    rough: Fit,
    iterations: int,
    tolerance: float = TOLERANCE,
    known: Floats | float = 0.0,
) -> Fit:
    """SLSQP from a fit to some of the samples within :data:`BOUNDS`, at most ``iterations``."""
    values, vectors = np.linalg.eigh(rough.inverse_hessian)
    metric = vectors * np.sqrt(np.clip(values, *_CURVATURE))

    def theta(point: Floats) -> Floats:
        return np.asarray(np.clip(rough.theta + metric @ point, *BOUNDS.T))

    def objective(point: Floats) -> tuple[float, Floats]:
        value, gradient = _cost(rough.kind, pairs, y, theta(point), known)
        return value, gradient @ metric

    result = minimize(
        objective,
        np.zeros(len(BOUNDS)),
        jac=True,
        constraints=LinearConstraint(metric, *(BOUNDS.T - rough.theta)),
        method="SLSQP",
        options={"maxiter": iterations, "ftol": tolerance},
    )
    best = -len(y) * float(result.fun)
    return Fit(rough.kind, theta(result.x), best, rough.inverse_hessian)


def _cost(
    kind: str, pairs: PairDistances, y: Floats, theta: Floats, known: Floats | float
) -> tuple[float, Floats]:
    """Negative log likelihood per sample, so that tolerances do not depend on how many there are,
    and its gradient."""
    value, gradient = likelihood(kind, pairs, y, theta, known)
    if not math.isfinite(value):
        return _WORST, np.zeros_like(theta)
    return -value / len(y), -gradient / len(y)
