"""Settings of the control cycle around the step: fallback and delay compensation."""

from typing import Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, model_validator

from bayesrace.vehicles.parameters import CarParameters

__all__ = ["CompensationSettings", "FallbackSettings", "cycle_values", "input_limits"]


class FallbackSettings(BaseModel):
    """How far down, how fast: see controller/native/br_fallback.c."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    shifted_s: float = Field(
        default=0.1, ge=0, le=2, description="how long after its first input a plan may be driven"
    )
    recover_cycles: int = Field(
        default=3,
        ge=1,
        le=100,
        description="usable solutions in a row that end braking; the last of them is driven. "
        "A car that stands drives the first",
    )
    tolerance: float = Field(
        default=1e-3, ge=0, le=0.1, description="excess over a limit that is clipped, not refused"
    )


_Mode = Literal["off", "measured", "fixed"]
"""In the order of br_compensation in controller/native/bayesrace_cycle.h."""


class CompensationSettings(BaseModel):
    """Over which delay the state is predicted: see controller/native/br_delay.c.

    Also by a text: the mode, or milliseconds of a fixed delay.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    mode: _Mode = Field(
        "measured", description="off: the state is taken as it is, as if everything were at once"
    )
    delay_s: float = Field(0.0, ge=0, le=1, description="delay from decision to acting if fixed")
    longest_s: float = Field(
        0.5, gt=0, le=1, description="no prediction goes farther; a longer delay is not covered"
    )

    @model_validator(mode="before")
    @classmethod
    def _by_text(cls, value: Any) -> Any:
        if not isinstance(value, str):
            return value
        if value in ("measured", "off"):
            return {"mode": value}
        try:
            return {"mode": "fixed", "delay_s": float(value) * 1e-3}
        except ValueError:
            raise ValueError("give 'measured', 'off', or a number of milliseconds") from None


def cycle_values(
    car: CarParameters,
    fallback: FallbackSettings,
    compensation: CompensationSettings,
    stale_s: float,
    sensor_tolerance: float,
) -> dict[str, float]:
    """The numbers of br_driving (controller/native/bayesrace_cycle.h) by name, limits left out."""
    return {
        **car.brake_numbers,
        "standing_mps": car.tuning.driving.standing_mps,
        "stop_mps2": car.tuning.driving.stop_mps2,
        "shifted_s": fallback.shifted_s,
        "limit_tolerance": fallback.tolerance,
        "recover_cycles": fallback.recover_cycles,
        "compensation": get_args(_Mode).index(compensation.mode),
        "delay_s": compensation.delay_s,
        "longest_s": compensation.longest_s,
        "stale_s": stale_s,
        "sensor_tolerance": sensor_tolerance,
    }


def input_limits(car: CarParameters) -> dict[str, tuple[float, float]]:
    """The limits of drive command and steering rate there."""
    rate = car.delta_rate_max_radps
    return {"u_low": (car.d_min, -rate), "u_high": (car.d_max, rate)}
