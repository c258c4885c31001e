"""How a plant process is started."""

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from bayesrace.option import Option
from bayesrace.realtime import RealtimeSettings
from bayesrace.transport import PLANT_ENDPOINT, Endpoints
from bayesrace.vehicles import CarSetting, default_car
from plant.settings import SensorNoise, SimulatorName

__all__ = ["PlantSettings"]


class PlantSettings(BaseModel):
    """How a plant process is started; what a run is like comes with its request."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    car: CarSetting = Field(default_factory=default_car)
    name: str = Field("", description="name of the car in the network; empty: the car's own")
    endpoints: Endpoints = Endpoints(listen=(PLANT_ENDPOINT,))
    rate_hz: float = Field(
        50.0, ge=1, le=500, description="rate of the states [Hz]; their period in lockstep"
    )
    delay_s: Annotated[float, Option(unit="ms", per_unit=1000)] = Field(
        0.0, ge=0, le=1, description="delay put on states and on actuations each"
    )
    noise: Annotated[SensorNoise, Option(metavar="NAME=STD")] = Field(
        SensorNoise(), description="standard deviation of a sensor; empty: exact"
    )
    seed: int = Field(
        0, ge=0, description="seed of the sensors' noise, which is the same in each run"
    )
    fmu: Path | None = Field(
        None, description="Co-Simulation FMU (2.0, 3.0) that simulates the car"
    )
    fmu_map: Annotated[Path | None, Option("--map")] = Field(
        None,
        description="meaning of the FMU's variables (TOML), as 'bayesrace fmu inspect' begins it; "
        "None: they have our names",
    )
    simulator: SimulatorName = Field(
        "equations",
        description="what simulates the car without an FMU: equations, or slipx, for --car slipx",
    )
    realtime: RealtimeSettings = RealtimeSettings()
    controller_wait_s: float = Field(
        2.0, ge=0, le=60, description="how long a lockstep run waits for a controller to appear"
    )
    parent_pid: int | None = Field(None, description="end when this process, the parent, ends")
