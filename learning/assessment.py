"""What training tells beside the weights: kernels by smoothness, the cost of choosing samples.

Every number is held out: a sample is predicted by a GP that has not seen its stretch of the drive.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from learning.crossvalidation import HeldOut
from learning.hyperparameters import Fit
from learning.regression import predicted_blocks
from learning.subset import at_random, evenly

__all__ = ["TESTS", "ChoiceScore", "KernelScore", "choice_scores", "held_out_metrics"]

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
    def of(cls, output: str, fit: Fit, held: HeldOut, scale: float, chosen: bool) -> "KernelScore":
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


def held_out_metrics(held: HeldOut, y: Floats, y_mean: float, scale: float) -> dict[str, float]:
    """RMSE with and without the GP, R², coverage, log density: SI units, from scaled numbers.

    ``y``: the scaled targets that ``held`` has the errors of; the residual is y_mean + scale * y.
    """
    spread = float(np.sum((y - y.mean()) ** 2))
    return {
        "rmse": held.rmse * scale,
        "uncorrected_rmse": float(np.sqrt(np.mean((y_mean + scale * y) ** 2))),
        "r2": 1.0 - float(np.sum(held.error**2)) / spread if spread > 0 else 0.0,
        "coverage": held.coverage,
        "log_density": held.log_density - math.log(scale),
    }


def choice_scores(
    output: str, fit: Fit, z: Floats, y: Floats, rows: Rows, blocks: int, seed: int, scale: float
) -> list[ChoiceScore]:
    """All samples, the chosen ``rows``, and as many at random; scaled ``z`` (n, 6), ``y`` (n,)."""
    tests = evenly(len(y), TESTS)

    def judge(some: Rows) -> HeldOut:
        return predicted_blocks(fit.kind, fit.theta, z, y, some, tests, blocks)

    def score(choice: str, count: int, judged: list[HeldOut]) -> ChoiceScore:
        square = float(np.mean([one.rmse**2 for one in judged]))
        density = float(np.mean([one.log_density for one in judged]))
        return ChoiceScore(
            output, choice, count, math.sqrt(square) * scale, density - math.log(scale)
        )

    draws = [at_random(len(y), len(rows), seed + draw) for draw in range(_DRAWS)]
    return [
        score("all", len(tests), [judge(tests)]),
        score("greedy", len(rows), [judge(rows)]),
        score("random", len(rows), [judge(draw) for draw in draws]),
    ]
