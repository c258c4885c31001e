"""Log marginal likelihood of a GP with ARD kernel and noise, and its gradient, fast.

    log p(y) = -1/2 y' K^-1 y - 1/2 log |K| - n/2 log(2 pi),    K = s^2 k(r) + noise I

(Rasmussen and Williams, eq. 5.8 and 5.9), over the logarithms
theta = [signal variance, length scales, noise variance], which is also how scikit-learn orders the
hyperparameters of ConstantKernel * RBF + WhiteKernel. Unlike scikit-learn this never forms the
n x n x 8 tensor of kernel derivatives: all length scales share dk/d(r^2), so an evaluation costs
little more than one factorisation and inverse. Symmetric matrices are packed, the lower triangle
column by column, and factorised and inverted in LAPACK's rectangular full packed format, which is
faster than its square one (Gustavson et al., "Rectangular full packed format for Cholesky's
algorithm", TOMS 2010). The squared distances per feature are the same for all outputs, kernels and
starts: they are made once (:class:`PairDistances`).
"""

import math

import numpy as np
from scipy.linalg import blas, lapack

from bayesrace.arrays import Floats
from bayesrace.gp.expression import kernel, kernel_slope

__all__ = ["MarginalLikelihood", "PairDistances"]


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
