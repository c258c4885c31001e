"""The settings of one latency measurement, which go into its folder."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from bayesrace.defaults import Option
from bayesrace.realtime import RealtimeSettings
from bayesrace.strict import StrictModel
from bayesrace.transport import Endpoints
from bayesrace.vehicles import CarSetting, default_car

__all__ = ["LatencySettings"]


def _own_track(known: dict[str, Any]) -> str:
    elsewhere = known.get("log") or known.get("attach")
    return "" if elsewhere or "car" not in known else str(known["car"].race_track)


class LatencySettings(StrictModel):
    """What to measure, and for how long."""

    car: CarSetting = Field(default_factory=default_car)
    log: Path | None = Field(None, description="log of a run (MCAP), in place of a new run")
    attach: Endpoints | None = Field(None, description="where a running system is")
    name: str = Field("", description="name of the car in the network; empty: the car's own")
    rate_hz: float = Field(50.0, ge=1, le=500, description="rate of plant and controller [Hz]")
    duration_s: float = Field(
        default_factory=lambda known: 1e9 if known.get("log") else 20.0,
        ge=1,
        le=1e9,
        description="time that counts, after the warm-up [s]; empty: 20; all of a log",
    )
    warm_up_s: float = Field(3.0, ge=0, le=60, description="plant time before cycles count")
    load: int = Field(0, ge=0, le=1024, description="busy processes to start as load")
    track: str = Field(
        default_factory=_own_track,
        description="track: name, random:SEED, random10:SEED or CSV file; empty: the car's; not "
        "known of a log or a running system",
    )
    realtime: RealtimeSettings = RealtimeSettings()
    weights: Path | None = Field(None, description="GP weights; None: trained")
    artefact: Annotated[Path | None, Option(metavar="DIR")] = Field(
        None, description="folder of 'bayesrace build'; None: built"
    )
    raceline: Path | None = Field(
        None, description="racing line to drive, as 'bayesrace raceline' writes it; None: computed"
    )

    @property
    def car_name(self) -> str:
        """The name of the car in message keys; empty: that of the only car in the log."""
        return self.name or ("" if self.log else self.car.name)
