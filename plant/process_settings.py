"""How a plant process is started."""

from typing import Annotated, Self

from pydantic import Field, model_validator

from bayesrace.defaults import Option
from bayesrace.plant.faults import SensorFault, SensorFaultsSetting
from bayesrace.plant.settings import CarSimulation
from bayesrace.realtime import RealtimeSettings
from bayesrace.transport import PLANT_ENDPOINT, Endpoints

__all__ = ["PlantSettings"]


class PlantSettings(CarSimulation):
    """How a plant process is started; what a run is like comes with its request."""

    name: str = Field("", description="name of the car in the network; empty: the car's own")
    endpoints: Endpoints = Endpoints(listen=(PLANT_ENDPOINT,))
    rate_hz: float = Field(
        50.0, ge=1, le=500, description="rate of the states [Hz]; their period in lockstep"
    )
    buffer_s: Annotated[float, Option(unit="ms", per_unit=1000)] = Field(
        0.0,
        ge=0,
        le=0.5,
        description="jitter buffer, in real time: time from a decision until its input acts, at "
        "least, so that delays which vary become one that is constant",
    )
    seed: int = Field(
        0, ge=0, description="seed of the sensors' errors, which are the same in each run"
    )
    sensor_faults: SensorFaultsSetting = None
    realtime: RealtimeSettings = RealtimeSettings()
    controller_wait_s: float = Field(
        2.0, ge=0, le=60, description="how long a lockstep run waits for a controller to appear"
    )
    hold_to_run: bool = Field(False, description="refuse runs that are not held")
    parent_pid: int | None = Field(None, description="end when this process, the parent, ends")

    @property
    def states_hz(self) -> float:
        """Rate of the states."""
        return self.rate_hz

    @property
    def faults(self) -> tuple[SensorFault, ...]:
        """Of the sensors."""
        return self.sensor_faults.root if self.sensor_faults else ()

    @model_validator(mode="after")
    def _can_fail(self) -> Self:
        for one in self.faults:
            one.check(self.instruments)
        return self
