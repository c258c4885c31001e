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


def scikit_gp(
    kind: str, theta: Floats, z: Floats, y: Floats, bounds: Floats | None = None
) -> GaussianProcessRegressor:
    """Fitted with the hyperparameters log [signal variance, length scales (6), noise variance].

    ``bounds`` (8, 2): the hyperparameters are optimised within, from ``theta``.
    """
    signal, *lengths, noise = np.exp(theta)
    within: Any = [(1e-12, 1e12)] * 3
    if bounds is not None:
        within = [np.exp(bounds[0]), np.exp(bounds[1:-1]), np.exp(bounds[-1])]
    kernel = correlation(kind, lengths, length_scale_bounds=within[1])
    covariance = ConstantKernel(signal, within[0]) * kernel + WhiteKernel(noise, within[2])
    optimizer = None if bounds is None else "fmin_l_bfgs_b"
    return GaussianProcessRegressor(covariance, alpha=0.0, optimizer=optimizer).fit(z, y)
