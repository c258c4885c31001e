"""The settings of one latency measurement, which go into its folder."""

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from bayesrace.realtime import RealtimeSettings
from bayesrace.tracks import DEFAULT_RACE_TRACK
from bayesrace.transport import Endpoints
from bayesrace.vehicles import CarSetting, default_car

__all__ = ["LatencySettings"]


class LatencySettings(BaseModel):
    """What to measure, and for how long."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    car: CarSetting = Field(default_factory=default_car)
    name: str = Field("", description="name in message keys; the car's own if empty")
    rate_hz: float = Field(50.0, ge=1, le=500, description="of plant and controller")
    duration_s: float = Field(20.0, gt=0, description="counted, after the warm-up")
    warm_up_s: float = Field(3.0, ge=0, le=60, description="plant time before cycles count")
    load: int = Field(0, ge=0, le=1024, description="busy processes beside")
    track: str = Field(DEFAULT_RACE_TRACK, description="empty: not known")
    realtime: RealtimeSettings = RealtimeSettings()
    weights: Path | None = Field(None, description="instead of those trained here")
    artefact: Path | None = Field(None, description="instead of the one built here")
    raceline: Path | None = Field(None, description="instead of the one computed here")
    attach: Endpoints | None = Field(None, description="where a running system is")
    log: Path | None = Field(None, description="log of a recorded run, in place of a new one")

    @property
    def car_name(self) -> str:
        """The name of the car in message keys; empty: that of the only car in the log."""
        return self.name or ("" if self.log else self.car.name)
