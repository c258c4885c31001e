"""Run-time settings: of the OCP (paper, equation 8) and the SQP that solves it; of the control
cycle around the step, its fallback and delay compensation; and of the checks of new weights."""

import math
from statistics import NormalDist
from typing import Annotated, Any, Final, Literal, get_args

from pydantic import Field, field_validator, model_validator

from bayesrace.defaults import Option
from bayesrace.strict import StrictModel
from bayesrace.vehicles import Car
from bayesrace.vehicles.parts import GRAVITY_MPS2

__all__ = [
    "SAMPLES", "WATCHED", "CompensationMode", "CompensationSettings", "CycleSettings",
    "FallbackSettings", "GateSettings", "MpcSettings",
]  # fmt: skip

SAMPLES: Final = 512
"""BR_SAMPLES in controller/native/bayesrace_mpc.h: what a controller keeps."""

WATCHED: Final = 100
"""BR_WATCHED there: the newest of these, on which weights are compared while they are watched."""

_SOLVER: Final = (
    "tolerance", "defect_max", "early_stop_tol", "iterations", "iterations_cold",
    "qp_steps",
)  # fmt: skip
"""BR_SOLVER_FIELDS in controller/native/bayesrace_mpc.h that have the names of settings."""

_BEND: Final = 5.0
"""Wheelbases: radius of the bend that a car still takes at its limit where weights slow it down."""


def _objective(text: str) -> Any:
    return Field(None, gt=0, description=f"{text}; the car's, from its tuning, without")


class MpcSettings(StrictModel):
    """All of these can change between two steps; nothing needs a recompilation."""

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
        description="probability with which the car is within the tube of its plan, by the learned "
        "model's uncertainty, from 0.5 on; where the tube takes half of the track, the car slows "
        "down. 0: the paper's controller, which takes the model's mean for the truth",
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
    qp_steps: int = Field(
        6000,
        ge=200,
        le=1_000_000,
        description="active-set steps that all QPs of a step may take together, and those of a "
        "preparation: then the best plan so far counts, and the next step goes on from it",
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

    def parameters(self, car: Car, problem: str = "tracking") -> dict[str, float]:
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


class FallbackSettings(StrictModel):
    """How far down, how fast: see controller/native/br_fallback.c."""

    shifted_s: Annotated[float, Option("--bridge", unit="ms", per_unit=1000)] = Field(
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


CompensationMode = Literal["off", "measured", "fixed"]
"""In the order of br_compensation in controller/native/bayesrace_cycle.h."""


class CompensationSettings(StrictModel):
    """Over which delay the state is predicted: see controller/native/br_state.c.

    Also by a text: the mode, or milliseconds of a fixed delay.
    """

    mode: CompensationMode = Field(
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


class GateSettings(StrictModel):
    """When new weights are refused, and when they are rolled back.

    One-step errors are compared as velocities after one Ts. The new weights are worse if for any
    output

        error_new > worse_factor * error_old + worse_share * error_nominal + resolution * Ts * few

    with RMSEs over the same samples and ``nominal`` the model without correction. Where states are
    estimated, RMSEs are what is left of the errors beyond the noise: each square less the variance
    of the estimated step, weighted by 1 / (1 + variance / (resolution * Ts)^2). ``resolution``
    and the bound on corrections depend on the car: :class:`bayesrace.vehicles.tuning.GateTuning`.
    ``few`` is 100, the samples that the watch compares on, over the number of samples, and at
    least 1: a handful of samples, as after a standing start, must be far worse.
    """

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

    def probation(self, car: Car, step_s: float) -> dict[str, Any]:
        """The members of br_mpc_probation (controller/native/bayesrace_mpc.h) by name."""
        bend_m = _BEND * car.wheelbase_m
        return {
            "worse_factor": self.worse_factor,
            "worse_share": self.worse_share,
            "watch_samples": self.watch_s / step_s,
            "slow_share": self.slow_share,
            "slow_least_mps": math.sqrt(car.friction * GRAVITY_MPS2 * bend_m),
            "watch_least": self.watch_least,
            "watch_cycles": self.watch_cycles,
            "resolution": tuple(one * step_s for one in car.tuning.gate.resolution),
        }


class CycleSettings(StrictModel):
    """Of the control cycle, whatever hands it the states: see controller/native/br_cycle.c."""

    compensation: Annotated[
        CompensationSettings, Option("--delay", metavar="DELAY", default="measured")
    ] = Field(
        CompensationSettings(),
        description="delay over which the state is predicted: measured, off, or milliseconds",
    )
    fallback: FallbackSettings = FallbackSettings()
    stale_s: float = Field(
        default=0.06, gt=0, le=60, description="age from which a state is not predicted forward"
    )
    sensor_tolerance: float = Field(
        default=1.0,
        ge=0,
        le=1e3,
        description="contradictions in measured states beyond which they are not believed, as a "
        "multiple of those by noise of motion capture; 0: every state is",
    )
    hold: bool = Field(False, description="do not drive before 'bayesrace go'")

    def cycle_values(self, car: Car) -> dict[str, float]:
        """The numbers of br_driving (controller/native/bayesrace_cycle.h) by name, but limits."""
        return {
            **car.brake_numbers,
            "standing_mps": car.tuning.driving.standing_mps,
            "stop_mps2": car.tuning.driving.stop_mps2,
            "shifted_s": self.fallback.shifted_s,
            "limit_tolerance": self.fallback.tolerance,
            "recover_cycles": self.fallback.recover_cycles,
            "compensation": get_args(CompensationMode).index(self.compensation.mode),
            "delay_s": self.compensation.delay_s,
            "longest_s": self.compensation.longest_s,
            "stale_s": self.stale_s,
            "sensor_tolerance": self.sensor_tolerance,
        }
