"""Thresholds by which weights are worse than others, with the reason for each; docs/learning.md
explains the tests."""

from typing import Final

from pydantic import BaseModel, ConfigDict, Field

__all__ = ["SAMPLES", "WATCHED", "GateSettings"]

SAMPLES: Final = 512
"""BR_SAMPLES in controller/native/bayesrace_mpc.h: what a controller keeps."""

WATCHED: Final = 100
"""BR_WATCHED there: the newest of these, on which weights are compared while they are watched."""


class GateSettings(BaseModel):
    """When new weights are refused, and when they are rolled back.

    One-step errors are compared as velocities after one Ts. The new weights are worse if for any
    output

        error_new > worse_factor * error_old + worse_share * error_nominal + resolution * Ts * few

    with RMSEs over the same samples and ``nominal`` the model without correction. ``resolution``
    and the bound on corrections depend on the car: :class:`bayesrace.vehicles.tuning.GateTuning`.
    ``few`` is 100, the samples that the watch compares on, over the number of samples, and at
    least 1: a handful of samples, as after a standing start, must be far worse.
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
    least_samples: int = Field(
        50, ge=1, le=SAMPLES, description="with fewer of the newest 512, only on probation"
    )
    watch_s: float = Field(10.0, ge=0, le=3600, description="driving after which weights stay")
    watch_least: int = Field(
        5, ge=1, le=WATCHED, description="samples: no rollback for one outlier"
    )
    watch_cycles: int = Field(
        25, ge=1, le=5000, description="cycles, nearly all of them without a solution, after which "
        "weights are rolled back: a car that stands has no error to compare",
    )  # fmt: skip
    slow_share: float = Field(
        0.7, gt=0, le=1, description="of the fastest speed that was watched: the limit where going "
        "back would be no better",
    )  # fmt: skip
