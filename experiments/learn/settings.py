"""What a learning job is told."""

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from bayesrace.integrators import PREDICTION, Discretisation
from bayesrace.vehicles import CarSetting, default_car

__all__ = ["LearnSettings"]


class LearnSettings(BaseModel):
    """Settings of ``bayesrace learn``; they go into the folder that it leaves."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    car: CarSetting = Field(default_factory=default_car)
    name: str = Field(
        default_factory=lambda known: known["car"].name if "car" in known else "",
        description="name of the car in the network [its own]",
    )
    discretisation: Discretisation = PREDICTION
    points: int = Field(400, ge=20, le=20_000, description="training points per output")
    keep: int = Field(1200, ge=100, le=20_000, description="samples kept from lap to lap")
    laps: int | None = Field(None, ge=1, description="end after so many; none is without end")
    track: str | None = Field(None, description="laps are timed and excursions seen by it")
    compare: Path | None = Field(None, description="race whose lap times are drawn beside")
    seed: int = Field(0, ge=0, description="of the optimiser's starts")
