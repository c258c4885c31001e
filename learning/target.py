"""One output to learn: its samples in standardised units, and how well some predict the others.

Every score is held out: a GP predicts a sample without its part of the drive (kernels) or its
stretch of the track (choices of samples); see :mod:`learning.folds`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from bayesrace.arrays import Floats, Rows
from bayesrace.errors import InputError
from bayesrace.gp.weights import GpOutput
from learning.hyperparameters import Fit
from learning.posterior import Covariance, Posterior
from learning.scores import PredictionErrors
from learning.subset import evenly

__all__ = ["ChoiceScore", "KernelScore", "Target"]

_TESTS: Final = 2000
"""Samples that a GP is judged by at most, evenly spread over all."""
_DRAWS: Final = 5
"""Random choices that the baseline is the mean of."""


@dataclass(frozen=True)
class KernelScore:
    """How one kernel, at its best hyperparameters, explains one output (SI units)."""

    output: str
    kernel: str
    rmse: float
    log_density: float
    chosen: bool


@dataclass(frozen=True)
class ChoiceScore:
    """How well some of the samples predict one output (SI units).

    ``choice``: "all" (a limited number, evenly spread), "greedy" (those in the weights) or
    "random" (mean of several draws of the same number).
    """

    output: str
    choice: str
    points: int
    rmse: float
    log_density: float


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
        """Samples that GPs are judged by."""
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
        """The scores of :meth:`errors_from`, :meth:`calibrated`, in SI units."""
        return self.calibrated(errors).metrics(self.y[self.tests], self.y_mean, self.y_scale)

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
        return chosen, [
            KernelScore(self.name, fit.kind, *self._si(errors), fit is chosen)
            for fit, errors in held
        ]

    def compare(self, covariance: Covariance, chosen: Rows, seed: int) -> list[ChoiceScore]:
        """Predictions from all samples, from the ``chosen`` rows, and from as many at random.

        Variances are calibrated as those of weights are.
        """
        generators = [np.random.default_rng(seed + draw) for draw in range(_DRAWS)]
        draws = [one.choice(len(self.y), len(chosen), replace=False) for one in generators]
        scores = []
        for name, choices in (("all", [self.tests]), ("greedy", [chosen]), ("random", draws)):
            held = [self.calibrated(self.errors_from(rows, covariance)) for rows in choices]
            rmse, density = np.array([self._si(errors) for errors in held]).T
            mean = math.sqrt(np.mean(rmse**2)), float(density.mean())
            scores.append(ChoiceScore(self.name, name, len(choices[0]), *mean))
        return scores

    def _si(self, errors: PredictionErrors) -> tuple[float, float]:
        """RMSE and log density in SI units."""
        return errors.rmse * self.y_scale, errors.log_density - math.log(self.y_scale)
