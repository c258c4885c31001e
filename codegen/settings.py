"""What shapes the generated code. Everything else of the OCP is set at run time."""

from typing import Literal

from pydantic import Field, field_validator

from bayesrace.defaults import MAX_POINTS, PATH_ROWS
from bayesrace.integrators import PERFECT, PREDICTION, Discretisation
from bayesrace.strict import StrictModel
from bayesrace.vehicles import DEFAULT_CAR, Car, CarSetting, default_car, get_car

__all__ = ["BuildSettings", "ProblemName"]

ProblemName = Literal["tracking", "progress"]


class BuildSettings(StrictModel):
    """One controller to build."""

    car: CarSetting = Field(default_factory=default_car)
    model: Literal["e_kinematic", "dynamic"] = Field(
        "e_kinematic", description="prediction model: e_kinematic, or dynamic, which is BestCase"
    )
    problem: ProblemName = Field(
        "tracking",
        description="control problem: tracking (the line, at its speed) or progress (as fast as "
        "possible)",
    )
    discretisation: Discretisation = Field(PREDICTION, description="scheme, step, sub-steps")
    horizon: int | None = Field(
        None, ge=2, le=100, description="stages of the horizon; None: the car's, from its tuning"
    )
    free_stages: int | None = Field(
        None,
        ge=1,
        le=100,
        description="first stages, whose inputs each change by themselves in a QP; the car's "
        "without",
    )
    block_stages: int | None = Field(
        None,
        ge=1,
        le=100,
        description="of the stages after them, so many change alike; 1: no blocks; the car's "
        "without",
    )
    gp_capacity: int = Field(1024, ge=8, le=MAX_POINTS, description="most points per output")
    path_rows: int = Field(PATH_ROWS, ge=8, le=65536, description="most rows of the line's table")
    weight_buffers: int = Field(
        3,
        ge=1,
        le=3,
        description="3: new weights while driving, and back to those before; 1: at the start only, "
        "in a third of the memory",
    )
    estimator: bool = Field(
        True, description="estimate states: they come as a whole, and the estimator is left out"
    )

    @field_validator("weight_buffers")
    @classmethod
    def _one_or_three(cls, count: int) -> int:
        if count == 2:
            raise ValueError("1 or 3: in use, proven, and spare, or one for all")
        return count

    @property
    def stages(self) -> int:
        """The horizon, resolved."""
        tuning = self.car.tuning
        own = tuning.progress if self.problem == "progress" else tuning.objective
        return self.horizon or own.horizon

    @property
    def blocks(self) -> tuple[int, int]:
        """Free stages, at most all, and stages of a block after them, resolved."""
        free, block = self.free_stages, self.block_stages
        if self.problem == "progress":
            own = self.car.tuning.progress
            free, block = free or own.free_stages, block or own.block_stages
        if block is None or block == 1:
            return self.stages, 1
        return min(free or self.stages, self.stages), block

    @classmethod
    def best_case(
        cls,
        car: str | Car = DEFAULT_CAR,
        horizon: int | None = None,
        problem: ProblemName = "tracking",
    ) -> "BuildSettings":
        """The controller with the perfect model, for comparison and validation only."""
        return cls(
            car=get_car(car),
            model="dynamic",
            problem=problem,
            discretisation=PERFECT,
            horizon=horizon,
            gp_capacity=8,
        )
