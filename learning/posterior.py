"""The posterior of one output's GP with given hyperparameters.

With K the covariance of the training samples, noise included, and k that with a new point
(Rasmussen and Williams, "Gaussian Processes for Machine Learning", eq. 2.25 and 2.26)

    alpha = K^-1 y,    mean = k' alpha,    variance = s^2 + noise - k' K^-1 k.

Without a fold B of the training samples, K^-1 becomes that of the others, padded with zeros. With
K = L L', r = L^-1 k, and the columns of Q an orthonormal basis of those of L^-1 in B, that is

    r~ = r - Q Q' r,    mean = r~' L^-1 y,    variance = s^2 + noise - r~' r~,

so that one factorisation does for all folds.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import cholesky, lapack, solve_triangular

from bayesrace.arrays import Floats, Rows
from bayesrace.errors import InputError
from bayesrace.gp.expression import kernel_matrix

__all__ = ["Covariance", "Posterior"]

_SINGULAR: Final = "GP: the covariance of the samples is singular; train without repeated samples"

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

    InputError if the covariance of the samples is singular.
    """

    def __init__(self, covariance: Covariance, z: Floats, y: Floats) -> None:
        self._covariance, self._z = covariance, z
        matrix = covariance.between(z, z)
        matrix[np.diag_indices_from(matrix)] += covariance.noise
        try:
            self._factor = cholesky(matrix, lower=True, overwrite_a=True)
        except np.linalg.LinAlgError as error:
            raise InputError(_SINGULAR) from error
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
