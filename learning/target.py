"""One output to learn: its samples in standardised units, and how well some predict the others.

Every score is held out: a GP predicts a sample without its part of the drive (kernels) or its
stretch of the track (choices of samples); see :mod:`bayesrace.learning.subset`.

A prediction of one output is a mean and a standard deviation sigma, with the learned noise in it.
With error = truth - mean, over n samples

    RMSE                     sqrt(mean(error^2))
    R^2                      1 - sum(error^2) / sum((truth - mean(truth))^2)
    coverage                 share of |error| <= 1.96 sigma, the 95 % interval
    log predictive density   mean of log N(error; 0, sigma^2)

Where the truth is estimated its variance ("noise") is no error: it is taken off each square in RMSE
and R^2, and is in sigma^2.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from threadpoolctl import threadpool_limits

from bayesrace.arrays import Floats, Rows
from bayesrace.errors import InputError
from bayesrace.gp.weights import GpOutput
from bayesrace.learning.gaussian_process import (
    Covariance,
    Fit,
    PairDistances,
    Posterior,
    maximise,
    starts,
)
from bayesrace.learning.subset import evenly

__all__ = ["NORMAL_95", "KernelScore", "PredictionErrors", "Target", "interpolated"]

NORMAL_95: Final = 1.959963984540054
"""Half the width of the 95 % interval, in standard deviations."""

_TESTS: Final = 2000
"""Samples that a GP is judged by at most, evenly spread over all."""

_ITERATIONS: Final = 50
"""Of the optimiser, for a GP that is not published."""


@dataclass(frozen=True, eq=False)
class PredictionErrors:
    """Errors and predictive standard deviations of one output, each (n,), in the same unit.

    ``noise`` (n,): variances of the truth that is compared with; they are in those of sigma.
    """

    error: Floats
    sigma: Floats
    noise: Floats | float = 0.0

    @property
    def rmse(self) -> float:
        """Root mean square error, beyond the noise."""
        return self._beyond(self.error)

    def _beyond(self, values: Floats, scale: float = 1.0) -> float:
        """Root mean square of values in units of which ``scale`` make one of the errors."""
        noise = float(np.mean(self.noise)) * scale**2
        return math.sqrt(max(float(np.mean(values**2)) - noise, 0.0))

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
        noise = np.broadcast_to(self.noise, truth.shape)
        spread = float(np.sum((truth - truth.mean()) ** 2 - noise))
        left = max(float(np.sum(self.error**2 - noise)), 0.0)
        return {
            "rmse": self.rmse * scale,
            "uncorrected_rmse": self._beyond(offset + scale * truth, scale),
            "r2": 1.0 - left / spread if spread > 0 else 0.0,
            "coverage": float(np.mean(np.abs(self.error) <= NORMAL_95 * self.sigma)),
            "log_density": self.log_density - math.log(scale),
        }


@dataclass(frozen=True)
class KernelScore:
    """How one kernel, at its best hyperparameters, explains one output (SI units)."""

    output: str
    kernel: str
    rmse: float
    log_density: float
    chosen: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class Target:
    """Features ``z`` (n, 6) and one output's residual ``y`` (n,), both standardised.

    Each column is in units of its standard deviation (``z_scale`` (6,), ``y_scale``) about its
    mean. ``folds`` (n,) numbers what cross-validation leaves out together. ``known`` (n,):
    variances of ``y``, where states are estimated; else 0.
    """

    name: str
    z: Floats
    y: Floats
    folds: Rows
    known: Floats
    z_scale: Floats
    y_mean: float
    y_scale: float

    @classmethod
    def of(
        cls, name: str, z: Floats, y: Floats, folds: Rows, deviation: Floats | float = 0.0
    ) -> "Target":
        """From features and residual, with its deviation, in SI units."""
        z_scale, y_mean, y_scale = z.std(axis=0), float(y.mean()), float(y.std()) or 1.0
        z_scale = np.where(z_scale > 0, z_scale, 1.0)
        return cls(
            name=name,
            z=(z - z.mean(axis=0)) / z_scale,
            y=(y - y_mean) / y_scale,
            folds=folds,
            known=np.broadcast_to((np.asarray(deviation) / y_scale) ** 2, y.shape),
            z_scale=z_scale,
            y_mean=y_mean,
            y_scale=y_scale,
        )

    def select(self, rows: Rows, folds: Rows) -> "Target":
        """The given samples, in units of all, with other ``folds``."""
        return replace(self, z=self.z[rows], y=self.y[rows], folds=folds, known=self.known[rows])

    def theta_of(self, output: GpOutput) -> Floats:
        """Hyperparameters of earlier weights in the units of this target."""
        ratio = (output.y_scale / self.y_scale) ** 2
        lengths = output.length_scales / self.z_scale
        noise = max(output.noise_variance, 1e-12)
        return np.log([output.signal_variance * ratio, *lengths, noise * ratio])

    @property
    def tests(self) -> Rows:
        """Samples that GPs are judged by."""
        return evenly(len(self.y), _TESTS)

    def posterior(self, rows: Rows, covariance: Covariance) -> Posterior:
        """The GP after seeing these samples."""
        return Posterior(covariance, self.z[rows], self.y[rows], self.known[rows])

    def errors_from(self, rows: Rows, covariance: Covariance) -> PredictionErrors:
        """Errors at the tests, each predicted from the samples ``rows`` of all other folds."""
        tests = self.tests
        posterior = self.posterior(rows, covariance)
        own = self.folds[tests]
        mean, sigma = posterior.predict_without(self.folds[rows], self.z[tests], own)
        if (known := self.known[tests]).any():
            sigma = np.sqrt(sigma**2 + known)
        return PredictionErrors(self.y[tests] - mean, sigma, known)

    @property
    def unknown(self) -> float:
        """Variance that is published as noise for what is not known of samples: the median."""
        return float(np.median(self.known))

    def published_errors(self, rows: Rows, covariance: Covariance) -> PredictionErrors:
        """:meth:`errors_from` with the standard deviations that are published, in which all samples
        are known as well as :attr:`unknown` says."""
        errors = self.errors_from(rows, covariance)
        if not self.known.any():
            return errors
        same = replace(self, known=np.zeros_like(self.known))
        published = replace(covariance, noise=covariance.noise + self.unknown)
        return replace(errors, sigma=same.errors_from(rows, published).sigma)

    def metrics(self, errors: PredictionErrors) -> dict[str, float]:
        """Scores of such errors in SI units, each fold's variances scaled by the others."""
        held = errors.calibrated(self.folds[self.tests])
        return held.metrics(self.y[self.tests], self.y_mean, self.y_scale)

    def choose_kernel(self, fits: Sequence[Fit]) -> tuple[Fit, list[KernelScore]]:
        """The kernel of largest held-out log density, of fits with one kernel each."""
        held: list[tuple[Fit, PredictionErrors]] = []
        for fit in fits:
            try:
                held.append((fit, self.errors_from(np.arange(len(self.y)), fit.covariance)))
            except InputError:  # singular at this kernel's optimum; another one may do
                if fit is fits[-1] and not held:
                    raise
        chosen, _ = max(held, key=lambda one: one[1].log_density)
        scores = []
        for fit, errors in held:
            rmse, density = errors.rmse * self.y_scale, errors.log_density - math.log(self.y_scale)
            scores.append(KernelScore(self.name, fit.kind, rmse, density, fit is chosen))
        return chosen, scores


def interpolated(z: Floats, y: Floats, deviation: Floats, at: Floats) -> tuple[Floats, Floats]:
    """Mean and standard deviation, noise included, (m,) each, at features ``at`` (m, 6).

    By a GP with an RBF kernel, from one start, of samples with features ``z`` (n, 6) and one output
    ``y`` (n,), whose standard deviations are ``deviation`` (n,); all in SI units.
    """
    target = Target.of("", z, y, np.zeros(len(z), dtype=np.int64), deviation)
    first, pairs = starts(0, 0)[0], PairDistances(target.z)
    with threadpool_limits(1, "blas"):
        fit = maximise("rbf", pairs, target.y, first, _ITERATIONS, known=target.known)
        posterior = target.posterior(np.arange(len(z)), fit.covariance)
        mean, sigma = posterior.predict((at - z.mean(axis=0)) / target.z_scale)
    return target.y_mean + target.y_scale * mean, target.y_scale * sigma
