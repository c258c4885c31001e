"""What training reports beside the weights: kernels by smoothness, the cost of choosing samples.

Every number is held out: a GP predicts a sample without its part of the drive (kernels) or its
stretch of the track (choices); see :mod:`learning.folds`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from bayesrace.arrays import Rows
from bayesrace.errors import InputError
from learning.hyperparameters import Fit
from learning.posterior import Covariance, Posterior
from learning.scores import PredictionErrors
from learning.target import Target

__all__ = ["ChoiceScore", "KernelScore", "choice_scores", "choose_kernel"]

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


def choose_kernel(target: Target, fits: Sequence[Fit]) -> tuple[Fit, list[KernelScore]]:
    """The kernel of largest held-out log density, of fits with one kernel each."""
    held: list[tuple[Fit, PredictionErrors]] = []
    for fit in fits:
        try:
            posterior = Posterior(fit.covariance, target.z, target.y)
            held.append((fit, posterior.held_out(target.folds)))
        except InputError:  # singular at this kernel's optimum; another one may do
            if fit is fits[-1] and not held:
                raise
    chosen, _ = max(held, key=lambda one: one[1].log_density)
    scale = target.y_scale
    return chosen, [
        KernelScore(
            output=target.name,
            kernel=fit.kind,
            rmse=errors.rmse * scale,
            log_density=errors.log_density - math.log(scale),
            chosen=fit is chosen,
        )
        for fit, errors in held
    ]


def choice_scores(
    target: Target, covariance: Covariance, rows: Rows, seed: int
) -> list[ChoiceScore]:
    """Predictions from all samples, from the chosen ``rows``, and from as many at random.

    Variances are calibrated as those of weights are.
    """

    def score(choice: str, *choices: Rows) -> ChoiceScore:
        held = [target.calibrated(target.errors_from(some, covariance)) for some in choices]
        rmse = math.sqrt(np.mean([one.rmse**2 for one in held])) * target.y_scale
        density = float(np.mean([one.log_density for one in held])) - math.log(target.y_scale)
        return ChoiceScore(target.name, choice, len(choices[0]), rmse, density)

    generators = [np.random.default_rng(seed + draw) for draw in range(_DRAWS)]
    draws = [one.choice(len(target.y), len(rows), replace=False) for one in generators]
    return [score("all", target.tests), score("greedy", rows), score("random", *draws)]
