"""What one can choose about a racing line, and the error when there is none."""

from pydantic import BaseModel, ConfigDict, Field

__all__ = ["RaceLineError", "RaceLineSettings"]


class RaceLineError(RuntimeError):
    """The optimiser found no racing line; the message says how it ended and what may help."""


class RaceLineSettings(BaseModel):
    """Settings of :func:`bayesrace.raceline.compute_raceline`; the car's tuning has its steps."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    friction: float | None = Field(
        default=None, gt=0, le=5, description="horizontal acceleration over g; None: the car's"
    )
    margin_m: float | None = Field(
        default=None, ge=0, description="centre of gravity to track edge; None: half a car's width"
    )
    max_iterations: int = Field(default=500, ge=1, description="iteration limit of the optimiser")
