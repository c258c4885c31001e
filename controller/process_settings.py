"""How a controller process is started."""

from pydantic import BaseModel, ConfigDict, Field

from bayesrace.realtime import RealtimeSettings
from bayesrace.transport import CONTROLLER_ENDPOINT, PLANT_ENDPOINT, Endpoints
from bayesrace.vehicles import CarSetting, default_car
from controller.cycle_settings import CompensationSettings, FallbackSettings
from controller.weights.settings import GateSettings

__all__ = ["ControllerSettings"]


class ControllerSettings(BaseModel):
    """How a controller process is started; what it drives is made by the caller."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    car: CarSetting = Field(default_factory=default_car)
    name: str = Field(default="", description="name in message keys; the car's own if empty")
    endpoints: Endpoints = Endpoints(listen=(CONTROLLER_ENDPOINT,), connect=(PLANT_ENDPOINT,))
    rate_hz: float = Field(50.0, ge=1, le=500, description="of the loop in real time")
    budget: float = Field(
        0.8, gt=0, le=1, description="fraction of the period that a cycle may take, step included"
    )
    compensation: CompensationSettings = CompensationSettings()
    fallback: FallbackSettings = FallbackSettings()
    stale_s: float = Field(
        default=0.06, gt=0, le=60, description="age from which a state is not predicted forward"
    )
    sensor_tolerance: float = Field(
        default=1.0,
        ge=0,
        le=1e3,
        description="multiple of the contradictions in measured states that noise of motion "
        "capture causes; beyond, a state is not believed; 0: every state is",
    )
    hold: bool = Field(False, description="wait for 'go' before driving")
    gate: GateSettings = GateSettings()
    realtime: RealtimeSettings = RealtimeSettings()
    parent_pid: int | None = Field(None, description="end when this process, the parent, ends")
