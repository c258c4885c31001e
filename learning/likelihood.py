"""Log marginal likelihood of a GP with ARD kernel and noise, and its gradient, fast.

    log p(y) = -1/2 y' K^-1 y - 1/2 log |K| - n/2 log(2 pi),    K = s^2 k(r) + noise I

(Rasmussen and Williams, eq. 5.8 and 5.9), over the logarithms
theta = [signal variance, length scales, noise variance], which is also how scikit-learn orders the
hyperparameters of ConstantKernel * RBF + WhiteKernel. Unlike scikit-learn this never forms the
n x n x 8 tensor of kernel derivatives: all length scales share dk/d(r^2), which CasADi derives from
the kernel's one definition, so an evaluation costs little more than one factorisation and inverse.
The squared distances per feature are the same for all outputs, kernels and starts: they are made
once (:class:`PairDistances`).
"""

import math
from typing import Any, cast

import casadi as ca
import numpy as np
from scipy.linalg import blas, lapack

from bayesrace.arrays import Floats
from bayesrace.gp.expression import kernel

__all__ = ["MarginalLikelihood", "PairDistances"]


class PairDistances:
    """Squared distances per feature of all pairs of ``z`` (n, p), read by any number of threads."""

    def __init__(self, z: Floats) -> None:
        self.count = len(z)
        rows, columns = np.tril_indices(self.count, -1)
        self.rows, self.columns = rows, columns
        self.flat = columns * self.count + rows
        """Index of a pair below the diagonal in a matrix stored by columns."""
        self.squares = np.ascontiguousarray(((z[rows] - z[columns]) ** 2).T)
        """(p, n (n - 1) / 2)."""


class MarginalLikelihood:
    """log p(y | z, theta) for the pairs of scaled features and scaled targets ``y`` (n,).

    One thread only: it works in its own memory.
    """

    def __init__(self, kind: str, pairs: PairDistances, y: Floats) -> None:
        self._pairs, self._y = pairs, np.ascontiguousarray(y, dtype=np.float64)
        self._r2, self._k, self._slope, self._weight = np.zeros((4, len(pairs.rows)))
        self._matrix = np.zeros((pairs.count, pairs.count), order="F")
        r2 = ca.MX.sym("r2", len(pairs.rows))
        k = kernel(kind, r2)
        function = ca.Function("k", [r2], [k, ca.gradient(ca.sum1(k), r2)])
        # An ordinary call would convert every number to and from CasADi's own matrices, which
        # takes longer than the kernel itself.
        buffer, self._evaluate = cast(Any, function).buffer()
        buffer.set_arg(0, memoryview(cast(Any, self._r2)))
        buffer.set_res(0, memoryview(cast(Any, self._k)))
        buffer.set_res(1, memoryview(cast(Any, self._slope)))
        self._alive = function, buffer

    def __call__(self, theta: Floats) -> tuple[float, Floats]:
        """Value and gradient (p + 2,); -inf and zeros where K is numerically singular."""
        pairs, weight = self._pairs, self._weight
        signal, noise = math.exp(theta[0]), math.exp(theta[-1])
        precision = np.exp(-2 * theta[1:-1])
        np.matmul(precision, pairs.squares, out=self._r2)
        self._evaluate()
        inverse, log_det = self._factorise(signal, noise)
        if inverse is None:
            return -math.inf, np.zeros_like(theta)
        alpha = blas.dsymv(1.0, inverse, self._y, lower=1)
        value = -0.5 * (self._y @ alpha + log_det + pairs.count * math.log(2 * math.pi))
        # d log p / d theta = 1/2 tr((alpha alpha' - K^-1) dK/dtheta); pairs count twice.
        np.multiply(alpha[pairs.rows], alpha[pairs.columns], out=weight)
        weight -= inverse.ravel(order="F")[pairs.flat]
        diagonal = float(alpha @ alpha - np.trace(inverse))
        gradient = np.empty_like(theta)
        gradient[0] = signal * (weight @ self._k + 0.5 * diagonal)
        weight *= self._slope
        gradient[1:-1] = -2 * signal * precision * (pairs.squares @ weight)
        gradient[-1] = 0.5 * noise * diagonal
        return value, gradient

    def _factorise(self, signal: float, noise: float) -> tuple[Floats | None, float]:
        """Lower triangle of K^-1 (upper triangle undefined) and log |K|, in place."""
        matrix = self._matrix
        matrix.reshape(-1, order="F")[self._pairs.flat] = signal * self._k
        np.fill_diagonal(matrix, signal + noise)
        factor, failed = lapack.dpotrf(matrix, lower=1, overwrite_a=1, clean=0)
        if failed:
            return None, 0.0
        log_det = 2 * float(np.log(np.diag(factor)).sum())
        inverse, failed = lapack.dpotri(factor, lower=1, overwrite_c=1)
        return (None, 0.0) if failed else (inverse, log_det)
