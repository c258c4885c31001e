"""What ``bayesrace latency`` can be told, as one resolved object that goes into its folder."""

from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from bayesrace.realtime import RealtimeSettings
from bayesrace.tracks import DEFAULT_RACE_TRACK
from bayesrace.vehicles import CarSetting, default_car

__all__ = ["LatencySettings"]


class LatencySettings(BaseModel):
    """One measurement."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    car: CarSetting = Field(default_factory=default_car)
    name: str = Field("", description="name in message keys; the car's own if empty")
    rate_hz: float = Field(50.0, ge=1, le=500, description="of plant and controller")
    duration_s: float = Field(20.0, gt=0, le=1e6, description="observed, after the settling")
    settle_s: float = Field(3.0, ge=0, le=60, description="driven before that")
    load: int = Field(0, ge=0, le=1024, description="busy processes beside")
    track: str = Field(DEFAULT_RACE_TRACK, description="empty: not known, where attached")
    realtime: RealtimeSettings = RealtimeSettings()
    weights: Path | None = Field(None, description="instead of those trained here")
    artefact: Path | None = Field(None, description="instead of the one built here")
    raceline: Path | None = Field(None, description="instead of the one computed here")
    attach: tuple[str, ...] = Field(
        (), description="endpoints of a running system; nothing is started if there are any"
    )

    @property
    def car_name(self) -> str:
        """In message keys."""
        return self.name or self.car.name
