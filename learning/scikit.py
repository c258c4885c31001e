"""Training by scikit-learn alone, to compare with: the same residuals, evenly chosen samples."""

import warnings
from typing import Final

from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from bayesrace.gp.scikit import weights_of
from bayesrace.gp.weights import Weights
from bayesrace.integrators import Discretisation
from bayesrace.learning.dataset import Dataset
from bayesrace.learning.subset import evenly
from bayesrace.learning.training import check_samples
from bayesrace.learning.validation import residual

__all__ = ["train"]

_WITHIN: Final = (1e-2, 1e2)
"""Of the length scales, over the standard deviation of their feature."""
_SIGNAL: Final = (1e-3, 1e4)
_NOISE: Final = (1e-6, 1.0)
"""Bounds of signal and noise, over the targets' variance."""


def train(samples: Dataset, discretisation: Discretisation, points: int, seed: int) -> Weights:
    """A ``GaussianProcessRegressor`` for each output, an RBF kernel with a length scale for each
    feature; InputError as in :func:`bayesrace.learning.training.fit`."""
    errors = residual(samples, discretisation)
    check_samples(samples, errors)
    rows = evenly(len(samples), min(points, len(samples)))
    z, y = samples.features[rows], errors[rows]
    size = z.std(axis=0)
    bounds = [(low * one, high * one) for one in size for low, high in (_WITHIN,)]
    fitted = []
    for target in y.T:
        kernel = ConstantKernel(1.0, (1e-3, 1e4)) * RBF(2 * size, bounds) + WhiteKernel(
            1e-3, _NOISE
        )
        regressor = GaussianProcessRegressor(kernel, normalize_y=True, random_state=seed)
        with warnings.catch_warnings():
            # A bound is met where a feature does not matter, or the samples have no noise.
            warnings.simplefilter("ignore", ConvergenceWarning)
            fitted.append(regressor.fit(z, target))
    return weights_of(fitted, samples.car, discretisation)
