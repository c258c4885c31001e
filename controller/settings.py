"""Run-time settings: of the OCP (paper, equation 8) and the SQP that solves it, and of the control
cycle around the step, its fallback and delay compensation."""

from statistics import NormalDist
from typing import Annotated, Any, Final, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from bayesrace.defaults import Option
from bayesrace.vehicles import CarParameters

__all__ = [
    "CompensationSettings",
    "FallbackSettings",
    "MpcSettings",
    "cycle_values",
    "input_limits",
]


_SOLVER: Final = ("tolerance", "defect_max", "early_stop_tol", "iterations", "iterations_cold")
"""BR_SOLVER_FIELDS in controller/native/bayesrace_mpc.h that have the names of settings."""


def _objective(text: str) -> Any:
    return Field(None, gt=0, description=f"{text}; the car's, from its tuning, without")


class MpcSettings(BaseModel):
    """All of these can change between two steps; nothing needs a recompilation."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    q_position: float | None = _objective("Q: squared position error [1/m^2]")
    r_duty: float | None = _objective("R: squared change of the drive command")
    r_delta_rate: float | None = _objective("R: squared steering rate [s^2/rad^2]")
    q_contour: float | None = _objective("progress: squared distance to the line [1/m^2]")
    gain: float | None = _objective("progress: reward of it [1/s]")
    s_slack: float | None = _objective("S: squared track violation [1/m^2]")
    constraints: bool = Field(True, description="apply the track constraints (8d)")
    margin_m: float | None = Field(
        None, ge=0, description="distance kept from the track edges [m]; the car's without"
    )
    caution: Annotated[float, Option(metavar="P")] = Field(
        0.95,
        ge=0,
        lt=1,
        description="probability with which each stage of the plan is to stay on the track in "
        "spite of the learned model's uncertainty, from 0.5 on; 0: the paper's controller, which "
        "takes the model's mean for the truth",
    )
    tolerance: float = Field(1e-6, gt=0, description="KKT residual of a converged step")
    defect_max: float = Field(
        0.03, gt=0, description="largest dynamics defect (m, rad, m/s, 10 rad/s) of a usable plan"
    )
    early_stop_tol: float = Field(
        1e-4,
        ge=0,
        description="a step stops iterating at this stationarity and tenth of the defect, or, "
        "warm started and without a time budget, when they fall by less than half and the defect "
        "is below 0.01; 0: neither",
    )
    iterations: int = Field(
        3,
        ge=1,
        le=1000,
        description="SQP iterations a step without time budget may use, once the defect is below "
        "0.01",
    )
    iterations_cold: int = Field(
        30,
        ge=1,
        le=1000,
        description="the same after a reset; with a time budget the larger limits every step",
    )

    @field_validator("caution")
    @classmethod
    def _cautious_or_not(cls, value: float) -> float:
        if 0 < value < 0.5:
            raise ValueError("is a probability from 0.5 on, or 0 for none")
        return value

    @property
    def caution_sigmas(self) -> float:
        """Standard deviations of a normal distribution that :attr:`caution` amounts to."""
        return NormalDist().inv_cdf(self.caution) if self.caution else 0.0

    def parameters(self, car: CarParameters, problem: str = "tracking") -> dict[str, float]:
        """Run-time parameters of the problem and settings of its solver, by name."""
        tuning = car.tuning.objective.model_dump(exclude={"horizon"})
        if problem == "progress":
            tuning |= car.tuning.progress.run_time
        known = {*tuning, *_SOLVER}
        stated = self.model_dump(include=known, exclude_none=True)
        values = tuning | stated
        if not self.constraints:
            values["s_slack"] = 0.0
        values["caution_sigmas"] = self.caution_sigmas
        limits = ("d_min", "d_max", "delta_max_rad", "delta_rate_max_radps")
        return values | {name: getattr(car, name) for name in limits}


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
    """Over which delay the state is predicted: see controller/native/br_state.c.

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
            known = "'measured', 'off', or a number of milliseconds"
            raise ValueError(f"give {known}, not '{value}'") from None


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
