"""What one can choose about a limit."""

from pydantic import BaseModel, ConfigDict, Field

__all__ = ["LimitSettings"]


class LimitSettings(BaseModel):
    """Settings of :func:`bayesrace.limit.compute_limit`."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    standing: bool = Field(False, description="from the start pose; otherwise a flying lap")
    start_speed_mps: float = Field(
        0.1, ge=0, le=5, description="speed at the start of a standing lap"
    )
    margin_m: float = Field(0.0, ge=0, description="least distance from the track's edge")
    body: bool = Field(
        False, description="the car's outline keeps the margin; otherwise its centre of gravity"
    )
    lateral_speed_mps: float | None = Field(
        None, gt=0, description="largest |vy|, for a lap without slides; None: any"
    )
    max_iterations: int = Field(300, ge=1, description="iteration limit of the optimiser")
