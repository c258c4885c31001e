"""scikit-learn's Gaussian process, with which the project's own is compared."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern, WhiteKernel

from bayesrace.arrays import Floats

__all__ = ["correlation", "scikit_gp"]

_NU = {"matern05": 0.5, "matern15": 1.5, "matern25": 2.5}


def correlation(kind: str, length_scales: ArrayLike, **bounds: Any) -> Any:
    """The kernel of variance 1 without noise."""
    if kind == "rbf":
        return RBF(length_scales, **bounds)
    return Matern(length_scales, nu=_NU[kind], **bounds)


def scikit_gp(kind: str, theta: Floats, z: Floats, y: Floats) -> GaussianProcessRegressor:
    """Fitted with the hyperparameters log [signal variance, length scales (6), noise variance]."""
    signal, *lengths, noise = np.exp(theta)
    covariance = ConstantKernel(signal) * correlation(kind, lengths) + WhiteKernel(noise)
    return GaussianProcessRegressor(covariance, alpha=0.0, optimizer=None).fit(z, y)
