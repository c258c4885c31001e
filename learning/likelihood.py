"""Log marginal likelihood of a GP with ARD kernel and noise, and its gradient, fast.

    log p(y) = -1/2 y' K^-1 y - 1/2 log |K| - n/2 log(2 pi),    K = s^2 k(r) + noise I

(Rasmussen and Williams, eq. 5.8 and 5.9), over the logarithms
theta = [signal variance, length scales, noise variance], which is also how scikit-learn orders the
hyperparameters of ConstantKernel * RBF + WhiteKernel. Unlike scikit-learn this never forms the
n x n x 8 tensor of kernel derivatives: all length scales share dk/d(r^2), which CasADi derives from
the kernel's one definition, so an evaluation costs little more than one Cholesky factorisation.
"""

import math

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, lapack

from bayesrace.gp.expression import bind, kernel

__all__ = ["MarginalLikelihood"]

Floats = NDArray[np.float64]


class MarginalLikelihood:
    """log p(y | z, theta) for scaled features ``z`` (n, p) and scaled targets ``y`` (n,)."""

    def __init__(self, kind: str, z: Floats, y: Floats) -> None:
        self._y = np.ascontiguousarray(y, dtype=np.float64)
        self._lower = np.tril_indices(len(y), -1)
        rows, columns = self._lower
        # Squared distances per feature, pairs below the diagonal only: (p, n (n - 1) / 2).
        self._squares = np.ascontiguousarray(((z[rows] - z[columns]) ** 2).T)
        pairs = self._squares.shape[1]
        self._r2, self._k, self._slope = (np.zeros(pairs) for _ in range(3))
        r2 = ca.MX.sym("r2", pairs)
        k = kernel(kind, r2)
        slope = ca.gradient(ca.sum1(k), r2)
        function = ca.Function("kernel_and_slope", [r2], [k, slope])
        self._evaluate = bind(function, [self._r2], [self._k, self._slope])

    def __call__(self, theta: Floats) -> tuple[float, Floats]:
        """Value and gradient (p + 2,); -inf and zeros where K is numerically singular."""
        signal, noise = math.exp(theta[0]), math.exp(theta[-1])
        precision = np.exp(-2 * theta[1:-1])
        np.matmul(precision, self._squares, out=self._r2)
        self._evaluate()
        inverse, log_det = self._factorise(signal, noise)
        if inverse is None:
            return -math.inf, np.zeros_like(theta)
        alpha = blas.dsymv(1.0, inverse, self._y, lower=1)
        n = len(alpha)
        value = -0.5 * (self._y @ alpha + log_det + n * math.log(2 * math.pi))
        # d log p / d theta = 1/2 tr((alpha alpha' - K^-1) dK/dtheta); pairs count twice.
        rows, columns = self._lower
        weight = alpha[rows] * alpha[columns] - inverse[self._lower]
        diagonal = float(alpha @ alpha - np.trace(inverse))
        gradient = np.empty_like(theta)
        gradient[0] = signal * (weight @ self._k + 0.5 * diagonal)
        gradient[1:-1] = -2 * signal * precision * (self._squares @ (weight * self._slope))
        gradient[-1] = 0.5 * noise * diagonal
        return value, gradient

    def _factorise(self, signal: float, noise: float) -> tuple[Floats | None, float]:
        """Lower triangle of K^-1 (upper triangle undefined) and log |K|."""
        n = len(self._y)
        matrix = np.zeros((n, n), order="F")
        matrix[self._lower] = signal * self._k
        np.fill_diagonal(matrix, signal + noise)
        factor, failed = lapack.dpotrf(matrix, lower=1, overwrite_a=1, clean=0)
        if failed:
            return None, 0.0
        log_det = 2 * float(np.log(np.diag(factor)).sum())
        inverse, failed = lapack.dpotri(factor, lower=1, overwrite_c=1)
        return (None, 0.0) if failed else (inverse, log_det)
