"""Thresholds of the gate, with the reason for each; docs/decisions/ has the measurements."""

from pydantic import BaseModel, ConfigDict, Field

__all__ = ["GateSettings"]


class GateSettings(BaseModel):
    """When weights are refused, and when they are given up again.

    One-step errors are compared as velocities after one Ts. The new weights are worse if for any
    output

        error_new > worse_factor * error_old + worse_share * error_nominal + resolution * Ts

    with RMSEs over the same samples and ``nominal`` the model without correction. ``resolution``
    and the bound on corrections depend on the car: :class:`bayesrace.vehicles.tuning.GateTuning`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    worse_factor: float = Field(
        1.2, ge=1, description="error of new weights that is no reason to refuse them, in old ones"
    )
    worse_share: float = Field(
        0.1,
        ge=0,
        description="the same as a share of the uncorrected model's error: good weights that are "
        "learned again differ by several times their error, which is next to nothing",
    )
    plausible_states: int = Field(
        500, ge=0, le=10_000, description="states all over what the car can do, for that bound"
    )
    recent_samples: int = Field(
        500, ge=1, le=5000, description="newest samples that are compared on: a lap or two"
    )
    recent_s: float = Field(
        60.0, gt=0, description="older samples are of another car: tyres and track change"
    )
    least_samples: int = Field(
        50, ge=1, le=5000, description="with fewer, weights are accepted on probation alone"
    )
    hang_s: float = Field(
        15.0,
        ge=0.5,
        le=3600,
        description="without a sign of life for this long a gatekeeper hangs, and is replaced; "
        "a check takes some .1 s, and many times that beside other work",
    )
    watch_s: float = Field(
        10.0, ge=0, le=3600, description="driving after which weights are no longer watched"
    )
    watch_least: int = Field(
        5, ge=1, le=1000, description="samples before the watch gives weights up: single outliers"
    )
    watch_cycles: int = Field(
        25,
        ge=1,
        le=5000,
        description="cycles since the takeover, nearly all of them without a solution, after which "
        "weights are given up: with some the OCP has none, and a car that stands has no error",
    )
    watch_window: int = Field(
        100,
        ge=1,
        le=5000,
        description="newest samples that the watch compares on, at first those from before the "
        "takeover; in one fast bend of half a second good weights can be worse than none",
    )
