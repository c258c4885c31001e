"""One output to learn: its samples in standardised units, and how well some predict the others."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bayesrace.arrays import Floats, Rows
from bayesrace.gp.weights import GpOutput
from learning.posterior import Covariance, Posterior
from learning.scores import PredictionErrors
from learning.subset import evenly

__all__ = ["Target"]

_TESTS: Final = 2000
"""Samples that a GP is judged by at most, evenly spread over all."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Target:
    """Features ``z`` (n, 6) and one output's residual ``y`` (n,), both standardised.

    Each column is in units of its standard deviation (``z_scale`` (6,), ``y_scale``) about its
    mean. ``folds`` (n,) numbers what cross-validation leaves out together.
    """

    name: str
    z: Floats
    y: Floats
    folds: Rows
    z_scale: Floats
    y_mean: float
    y_scale: float

    @classmethod
    def of(cls, name: str, z: Floats, y: Floats, folds: Rows) -> "Target":
        """From features and residual in SI units."""
        z_scale, y_mean, y_scale = z.std(axis=0), float(y.mean()), float(y.std())
        return cls(
            name=name,
            z=(z - z.mean(axis=0)) / z_scale,
            y=(y - y_mean) / y_scale,
            folds=folds,
            z_scale=z_scale,
            y_mean=y_mean,
            y_scale=y_scale,
        )

    def select(self, rows: Rows, folds: Rows) -> "Target":
        """The given samples, in units of all, with other ``folds``."""
        return replace(self, z=self.z[rows], y=self.y[rows], folds=folds)

    def theta_of(self, output: GpOutput) -> Floats:
        """Hyperparameters of earlier weights in the units of this target."""
        ratio = (output.y_scale / self.y_scale) ** 2
        lengths = output.length_scales / self.z_scale
        noise = max(output.noise_variance, 1e-12)
        return np.log([output.signal_variance * ratio, *lengths, noise * ratio])

    @property
    def tests(self) -> Rows:
        """Samples that a choice of samples is judged by."""
        return evenly(len(self.y), _TESTS)

    def errors_from(self, rows: Rows, covariance: Covariance) -> PredictionErrors:
        """Errors at the tests, each predicted from the samples ``rows`` of all other folds."""
        tests = self.tests
        posterior = Posterior(covariance, self.z[rows], self.y[rows])
        own = self.folds[tests]
        mean, sigma = posterior.predict_without(self.folds[rows], self.z[tests], own)
        return PredictionErrors(self.y[tests] - mean, sigma)

    def calibrated(self, errors: PredictionErrors) -> PredictionErrors:
        """Errors of :meth:`errors_from`, each fold's variances scaled by those of the others."""
        return errors.calibrated(self.folds[self.tests])

    def metrics(self, errors: PredictionErrors) -> dict[str, float]:
        """The scores of :meth:`calibrated` errors in SI units."""
        return errors.metrics(self.y[self.tests], self.y_mean, self.y_scale)
