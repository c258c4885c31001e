"""Scores of predictions with an uncertainty, as training and validation report them.

A prediction of one output is a mean and a standard deviation sigma, with the learned noise in it.
With error = truth - mean, over n samples

    RMSE                     sqrt(mean(error^2))
    R^2                      1 - sum(error^2) / sum((truth - mean(truth))^2)
    coverage                 share of |error| <= 1.96 sigma, the 95 % interval
    log predictive density   mean of log N(error; 0, sigma^2)
"""

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bayesrace.arrays import Floats, Rows

__all__ = ["NORMAL_95", "PredictionErrors"]

NORMAL_95: Final = 1.959963984540054
"""Half the width of the 95 % interval, in standard deviations."""


@dataclass(frozen=True, eq=False)
class PredictionErrors:
    """Errors and predictive standard deviations of one output, each (n,), in the same unit."""

    error: Floats
    sigma: Floats

    @property
    def rmse(self) -> float:
        """Root mean square error."""
        return float(np.sqrt(np.mean(self.error**2)))

    @property
    def log_density(self) -> float:
        """Mean log predictive density per sample."""
        score = (self.error / self.sigma) ** 2 + np.log(2 * np.pi * self.sigma**2)
        return float(-0.5 * score.mean())

    @property
    def variance_scale(self) -> float:
        """Factor on all variances that makes the 95 % interval hold 95 % of the errors; at least 1.

        An interval that holds more is kept: 20 errors say little about the one outside.
        """
        ratio = np.quantile(np.abs(self.error) / self.sigma, 0.95) / NORMAL_95
        return max(1.0, float(ratio**2))

    def calibrated(self, folds: Rows) -> "PredictionErrors":
        """The same errors, each fold's variances scaled as those of all other ``folds`` (n,) need.

        An interval fitted to the very errors that it is judged by would hold 95 % of them however
        poor the GP is.
        """
        sigma = self.sigma.copy()
        for fold in np.unique(folds):
            inside = folds == fold
            if not inside.all():
                others = PredictionErrors(self.error[~inside], self.sigma[~inside])
                sigma[inside] *= math.sqrt(others.variance_scale)
        return replace(self, sigma=sigma)

    def metrics(self, truth: Floats, offset: float = 0.0, scale: float = 1.0) -> dict[str, float]:
        """All scores, and the RMSE that predicting zero would have (``uncorrected_rmse``).

        ``truth`` (n,), errors and sigmas may be in scaled units: ``offset + scale * truth`` is the
        measured quantity, and the scores are in its unit. R^2 is 0 where ``truth`` is constant.
        """
        spread = float(np.sum((truth - truth.mean()) ** 2))
        return {
            "rmse": self.rmse * scale,
            "uncorrected_rmse": float(np.sqrt(np.mean((offset + scale * truth) ** 2))),
            "r2": 1.0 - float(np.sum(self.error**2)) / spread if spread > 0 else 0.0,
            "coverage": float(np.mean(np.abs(self.error) <= NORMAL_95 * self.sigma)),
            "log_density": self.log_density - math.log(scale),
        }
