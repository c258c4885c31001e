"""Training by scikit-learn alone, to compare with: the same residuals, evenly chosen samples."""

import warnings
from typing import Final

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from bayesrace.gp.scikit import weights_of
from bayesrace.gp.weights import OUTPUTS, Weights
from bayesrace.integrators import Discretisation
from bayesrace.learning.dataset import Dataset
from bayesrace.learning.settings import Progress
from bayesrace.learning.subset import evenly
from bayesrace.learning.training import check_samples
from bayesrace.learning.validation import residual

__all__ = ["train"]

_WITHIN: Final = (1e-2, 1e2)
"""Of the length scales, over the standard deviation of their feature."""
_SIGNAL: Final = (1e-3, 1e4)
_NOISE: Final = (1e-6, 1.0)
"""Bounds of signal and noise, over the targets' variance."""


def train(
    samples: Dataset, discretisation: Discretisation, points: int, report: Progress
) -> Weights:
    """A ``GaussianProcessRegressor`` for each output, an RBF kernel with a length scale for each
    feature; InputError as in :func:`bayesrace.learning.training.fit`."""
    errors = residual(samples, discretisation)
    check_samples(samples, errors)
    rows = evenly(len(samples), min(points, len(samples)))
    z, y = samples.features[rows], errors[rows]
    size = z.std(axis=0)
    bounds = np.outer(size, _WITHIN)
    fitted: list[GaussianProcessRegressor] = []
    for name, target in zip(OUTPUTS, y.T, strict=True):
        covariance = ConstantKernel(1.0, _SIGNAL) * RBF(2 * size, bounds)
        kernel = covariance + WhiteKernel(1e-3, _NOISE)
        with warnings.catch_warnings():
            # A bound is met where a feature does not matter, or the samples have no noise.
            warnings.simplefilter("ignore", ConvergenceWarning)
            fitted.append(GaussianProcessRegressor(kernel, normalize_y=True).fit(z, target))
        report(len(fitted) / len(OUTPUTS), name)
    return weights_of(fitted, samples.car, discretisation)
