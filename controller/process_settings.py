"""How a controller process is started."""

from typing import Annotated, get_args

from pydantic import BaseModel, ConfigDict, Field

from bayesrace.controller.settings import (
    CompensationMode,
    CompensationSettings,
    FallbackSettings,
    GateSettings,
)
from bayesrace.defaults import Option
from bayesrace.realtime import RealtimeSettings
from bayesrace.transport import CONTROLLER_ENDPOINT, PLANT_ENDPOINT, Endpoints
from bayesrace.vehicles import Car, CarSetting, default_car

__all__ = ["ControllerSettings"]


class ControllerSettings(BaseModel):
    """How a controller process is started; what it drives is made by the caller."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    car: CarSetting = Field(default_factory=default_car)
    name: str = Field("", description="name of the car in the network; empty: the car's own")
    endpoints: Endpoints = Endpoints(listen=(CONTROLLER_ENDPOINT,), connect=(PLANT_ENDPOINT,))
    rate_hz: float = Field(50.0, ge=1, le=500, description="rate in real time [Hz]")
    budget: Annotated[float, Option(metavar="SHARE")] = Field(
        0.8, ge=0.05, le=1, description="share of the period that a cycle may take, step included"
    )
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
    gate: GateSettings = GateSettings()
    realtime: RealtimeSettings = RealtimeSettings()
    parent_pid: int | None = Field(None, description="end when this process, the parent, ends")

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
