"""Run-time settings of the OCP (paper, equation 8) and of the SQP that solves it."""

from statistics import NormalDist
from typing import Annotated, Any, Final

from pydantic import BaseModel, ConfigDict, Field, field_validator

from bayesrace.defaults import Option
from bayesrace.vehicles import CarParameters

__all__ = ["MpcSettings"]


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
