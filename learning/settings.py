"""What training may be given; kept apart from it, which takes a second to import."""

from collections.abc import Callable
from typing import Final, Literal

from pydantic import Field

from bayesrace.defaults import MAX_POINTS
from bayesrace.strict import StrictModel

__all__ = [
    "DEFAULT_KERNELS",
    "MIN_SAMPLES",
    "TOLERANCE",
    "WIDEN",
    "Kernel",
    "Progress",
    "TrainingSettings",
]

Kernel = Literal["rbf", "matern05", "matern15", "matern25"]
"""As in :data:`bayesrace.gp.weights.KERNELS`."""

DEFAULT_KERNELS: Final[tuple[Kernel, ...]] = ("rbf", "matern25")
"""Candidates of which held-out errors choose one for each output."""

Progress = Callable[[float, str], None]
"""Called from the training's own thread with the share done (0 to 1) and what was done."""

MIN_SAMPLES: Final = 20

TOLERANCE: Final = 1e-7
"""Relative gain of the likelihood per iteration at which the optimiser stops."""

WIDEN: Final = 1.45
"""Of first weights: what first laps on many tracks take for a band that holds."""


class TrainingSettings(StrictModel):
    """How to train; the defaults use training samples alone to decide."""

    kernels: tuple[Kernel, ...] = Field(
        DEFAULT_KERNELS, min_length=1, description="candidates; held-out log density decides"
    )
    restarts: int = Field(2, ge=0, le=100, description="further starts of the optimiser per kernel")
    seed: int = Field(0, ge=0, le=2**32 - 1, description="seed of the optimiser's starts")
    capacity: int = Field(
        1024, ge=1, le=MAX_POINTS, description="training points per output at most"
    )
    hyper_points: int = Field(
        400, ge=MIN_SAMPLES, description="samples that hyperparameters are found with at most"
    )
    tolerance: float = Field(
        TOLERANCE, gt=0, lt=1, description="relative gain at which the optimiser stops"
    )
    iterations: int = Field(100, ge=1, description="optimiser iterations per start")
    folds: int = Field(
        10, ge=2, description="parts of the drive, or of the track, each held out in turn"
    )
    widen: float = Field(
        WIDEN,
        ge=1,
        le=100,
        description="factor on the standard deviations of weights that begin with no others, where "
        "states are measured: what is driven with them differs from the samples",
    )
    threads: int = Field(0, ge=0, description="parallel fits; 0 is one per core")
