"""What training tells beside the weights: kernels by smoothness, the cost of choosing samples.

Every number is held out: a sample is predicted by a GP that has not seen its part of the drive
(kernels) or its stretch of the track (choices); see :mod:`learning.folds`.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from learning.crossvalidation import calibrated
from learning.hyperparameters import Fit
from learning.regression import judged
from learning.scores import PredictionErrors
from learning.subset import at_random, evenly

__all__ = ["TESTS", "ChoiceScore", "KernelScore", "choice_scores"]

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]

TESTS: Final = 2000
"""Samples that a GP is judged by at most, evenly spread over all."""

_DRAWS: Final = 5
"""Random choices that the baseline is the mean of."""


@dataclass(frozen=True)
class KernelScore:
    """How one kernel, at its best hyperparameters, explains one output (SI units)."""

    output: str
    kernel: str
    log_likelihood: float
    rmse: float
    log_density: float
    coverage: float
    chosen: bool

    @classmethod
    def of(
        cls, output: str, fit: Fit, held: PredictionErrors, scale: float, chosen: bool
    ) -> "KernelScore":
        """From errors in units of ``scale``."""
        return cls(
            output,
            fit.kind,
            fit.log_likelihood,
            held.rmse * scale,
            held.log_density - math.log(scale),
            held.coverage,
            chosen,
        )


@dataclass(frozen=True)
class ChoiceScore:
    """What is left of one output's prediction with some of the samples (SI units).

    ``choice``: "all" (at most :data:`TESTS`, evenly spread), "greedy" (what the weights hold) or
    "random" (mean of several draws of the same number).
    """

    output: str
    choice: str
    points: int
    rmse: float
    log_density: float


def choice_scores(
    output: str, fit: Fit, z: Floats, y: Floats, rows: Rows, folds: Rows, seed: int, scale: float
) -> list[ChoiceScore]:
    """All samples, the chosen ``rows``, and as many at random; scaled ``z`` (n, 6), ``y`` (n,).

    Variances are calibrated as those of weights are.
    """
    tests = evenly(len(y), TESTS)

    def judge(some: Rows) -> PredictionErrors:
        return calibrated(judged(fit.kind, fit.theta, z, y, some, tests, folds), folds[tests])

    def score(choice: str, count: int, errors: list[PredictionErrors]) -> ChoiceScore:
        square = float(np.mean([one.rmse**2 for one in errors]))
        density = float(np.mean([one.log_density for one in errors]))
        return ChoiceScore(
            output, choice, count, math.sqrt(square) * scale, density - math.log(scale)
        )

    draws = [at_random(len(y), len(rows), seed + draw) for draw in range(_DRAWS)]
    return [
        score("all", len(tests), [judge(tests)]),
        score("greedy", len(rows), [judge(rows)]),
        score("random", len(rows), [judge(draw) for draw in draws]),
    ]
