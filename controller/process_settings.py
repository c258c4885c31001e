"""How a controller process is started."""

from typing import Annotated

from pydantic import Field

from bayesrace.controller.settings import CycleSettings, GateSettings
from bayesrace.defaults import Option
from bayesrace.realtime import RealtimeSettings
from bayesrace.transport import CONTROLLER_ENDPOINT, PLANT_ENDPOINT, Endpoints
from bayesrace.vehicles import CarSetting, default_car

__all__ = ["ControllerSettings"]


class ControllerSettings(CycleSettings):
    """How a controller process is started; what it drives is made by the caller."""

    car: CarSetting = Field(default_factory=default_car)
    name: str = Field("", description="name of the car in the network; empty: the car's own")
    shadow: str = Field(
        "",
        pattern=r"^[A-Za-z0-9_-]{0,40}$",
        description="decide beside the controller that drives, as a shadow of this name, and send "
        "nothing to the car: docs/shadow.md; empty: drive",
    )
    endpoints: Endpoints = Endpoints(listen=(CONTROLLER_ENDPOINT,), connect=(PLANT_ENDPOINT,))
    rate_hz: float = Field(50.0, ge=1, le=500, description="rate in real time [Hz]")
    budget: Annotated[float, Option(metavar="SHARE")] = Field(
        0.8, ge=0.05, le=1, description="share of the period that a cycle may take, step included"
    )
    gate: GateSettings = GateSettings()
    realtime: RealtimeSettings = RealtimeSettings()
    parent_pid: int | None = Field(None, description="end when this process, the parent, ends")
