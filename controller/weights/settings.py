"""Thresholds for new weights, with the reason for each; docs/learning.md explains the tests."""

from typing import Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

__all__ = ["GateSettings"]


class GateSettings(BaseModel):
    """When new weights are refused, and when they are rolled back.

    One-step errors are compared as velocities after one Ts. The new weights are worse if for any
    output

        error_new > worse_factor * error_old + worse_share * error_nominal + resolution * Ts * few

    with RMSEs over the same samples and ``nominal`` the model without correction. ``resolution``
    and the bound on corrections depend on the car: :class:`bayesrace.vehicles.tuning.GateTuning`.
    ``few`` is ``watch_window`` over the number of samples, and at least 1: a handful of samples,
    as after a standing start, must be far worse.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    worse_factor: float = Field(1.2, ge=1, description="errors may grow by this factor, and")
    worse_share: float = Field(
        0.1, ge=0, description="by this share of the nominal error: good weights learned again "
        "differ by several times their error, which is small beside it",
    )  # fmt: skip
    plausible_states: int = Field(
        500, ge=0, le=10_000, description="states over the car's range, for the bound"
    )
    recent_samples: int = Field(500, ge=1, le=5000, description="to compare on: a lap or two")
    recent_s: float = Field(60.0, gt=0, description="older samples: tyres and track have changed")
    least_samples: int = Field(50, ge=1, le=5000, description="with fewer, only on probation")
    hang_s: float = Field(
        15.0, ge=0.5, le=3600, description="without an answer for so long the validator is "
        "replaced; a check takes some 0.1 s, and many times that beside other work",
    )  # fmt: skip
    watch_s: float = Field(10.0, ge=0, le=3600, description="driving after which weights stay")
    watch_least: int = Field(5, ge=1, le=1000, description="samples: no rollback for one outlier")
    watch_cycles: int = Field(
        25, ge=1, le=5000, description="cycles, nearly all of them without a solution, after which "
        "weights are rolled back: a car that stands has no error to compare",
    )  # fmt: skip
    slow_share: float = Field(
        0.7, gt=0, le=1, description="of the fastest speed that was watched: the limit where going "
        "back would be no better",
    )  # fmt: skip
    watch_window: int = Field(
        100, ge=1, le=5000, description="newest samples that the watch compares on, at first from "
        "before the adoption: in one fast bend good weights can be worse than none",
    )  # fmt: skip

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        """Windows that hold what is needed in them: else nothing would ever be compared."""
        if self.watch_least > self.watch_window:
            raise ValueError(f"watch_least {self.watch_least} is more than watch_window allows")
        if self.least_samples > self.recent_samples:
            raise ValueError(
                f"least_samples {self.least_samples} is more than recent_samples allows"
            )
        return self
