"""Held-out errors of a GP, fold by fold, in closed form from one inverse; and their calibration.

:mod:`learning.folds` has what is left out together, and why. For a fold B (Rasmussen and Williams,
section 5.4.2, blockwise)

    y_B - mean_B = C [K^-1 y]_B,    covariance_B = C,    C = ([K^-1]_BB)^-1.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from learning.scores import PredictionErrors

__all__ = ["calibrated", "held_out"]

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]


def held_out(inverse: Floats, y: Floats, folds: Rows) -> PredictionErrors:
    """Held-out errors of targets ``y`` (n,) in ``folds`` (n,), given K^-1 (n, n), noise in K."""
    alpha = inverse @ y
    error, sigma = np.empty_like(y), np.empty_like(y)
    for fold in np.unique(folds):
        rows = np.flatnonzero(folds == fold)
        covariance = np.linalg.inv(inverse[np.ix_(rows, rows)])
        error[rows] = covariance @ alpha[rows]
        sigma[rows] = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
    return PredictionErrors(error, sigma)


def calibrated(errors: PredictionErrors, folds: Rows) -> PredictionErrors:
    """The same, each fold's variances scaled as the errors of all other folds ask for.

    What scores of calibrated predictions may be told from: an interval fitted to the very errors
    that it is judged by would hold 95 % of them whatever the GP is worth. ``folds`` (n,).
    """
    sigma = errors.sigma.copy()
    for fold in np.unique(folds):
        inside = folds == fold
        if not inside.all():
            others = PredictionErrors(errors.error[~inside], errors.sigma[~inside])
            sigma[inside] *= np.sqrt(others.variance_scale)
    return replace(errors, sigma=sigma)
