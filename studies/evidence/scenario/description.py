"""The TOML file of a scenario: car, track and controller, what happens, and what must hold."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import BeforeValidator, Field, ValidationError, model_validator

from bayesrace.controller.process_settings import ControllerSettings
from bayesrace.controller.settings import MpcSettings
from bayesrace.errors import InputError, faults_in
from bayesrace.files import parse_toml, read_text
from bayesrace.operation.settings import PreparationSettings
from bayesrace.plant.faults import SensorFaults
from bayesrace.plant.world import World
from bayesrace.strict import StrictModel
from bayesrace.studies.evidence.scenario.events import (
    KINDS,
    Event,
    SensorEvent,
    WeightsEvent,
    WorldEvent,
)
from bayesrace.tracks import Track
from bayesrace.transport import Endpoint

__all__ = ["KINDS", "Holds", "Scenario", "read_scenario", "shipped"]

_SHIPPED: Final = Path(__file__).parent / "shipped"
_REMEDY: Final = "docs/scenarios.md shows one; 'bayesrace scenario --list' names those that ship"

_CONTROL: Final = {"rate_hz", "budget", "hold", "sensor_tolerance"}


def _list(given: Any) -> Any:
    return [given] if isinstance(given, str) else given


_Names = Annotated[tuple[str, ...], BeforeValidator(_list)]


class Holds(StrictModel):
    """What must hold, of the truth and of what was recorded. What is not given is not checked."""

    off_track_samples: int | None = Field(0, ge=0, description="of the whole drive, at most")
    off_track_m: float | None = Field(None, ge=0, description="how far off the track, at most [m]")
    laps: int | None = Field(None, ge=0, description="laps driven, at least")
    lap_s: float | None = Field(None, gt=0, description="slowest flying lap, at most [s]")
    lap_over_undisturbed: float | None = Field(
        None, gt=0, description="slowest flying lap over that of a drive without events, at most"
    )
    fallback_share: float | None = Field(
        None, ge=0, le=1, description="share of cycles that no solution drove, at most"
    )
    stands: bool | None = Field(None, description="whether the car stands at the end")
    detected_within_s: float | None = Field(
        None, ge=0, description="from the first sensor event to the first fault found, at most [s]"
    )
    detected: _Names | None = Field(None, min_length=1, description="kinds, of which it is one")
    drives_on_within_s: float | None = Field(
        None, ge=0, description="from the end of the last event until solutions drive [s], at most"
    )
    latency_p50_ms: float | None = Field(
        None, gt=0, description="state to actuation, median, at most [ms]"
    )
    latency_p99_ms: float | None = Field(None, gt=0, description="the same, 99 % of them [ms]")
    unaccounted: int | None = Field(
        None, ge=0, description="messages sent, not received and not counted as lost, at most"
    )
    ends: str | None = Field(None, description="reason of the run's end: laps, max_time, …")
    happens: _Names = Field((), description="kinds of events that are in the log")
    happens_not: _Names = Field((), description="kinds of events that are not")


class Scenario(StrictModel):
    """One drive of a plant and a controller process."""

    name: str = Field("", exclude=True)
    why: str = Field(description="what it shows, in a sentence")
    mode: Literal["simulated", "realtime"] = Field(
        "simulated", description="time: simulated, to the bit, or real, with processes"
    )
    track: str = Field("", description="a name, random:SEED or a file; empty: the car's")
    laps: int = Field(3, ge=0, le=1000, description="after which the run ends; 0: by its time")
    max_time_s: float = Field(40.0, gt=0, le=3600, description="after which it ends at the latest")
    weights: str = Field(
        "updated", description="that the controller begins with: learned, updated, none or a file"
    )
    buffer_ms: float = Field(0.0, ge=0, le=500, description="jitter buffer of the plant [ms]")
    seed: int = Field(0, ge=0, description="of the link's randomness")
    race: PreparationSettings = Field(
        default_factory=PreparationSettings, description="settings of 'bayesrace race'"
    )
    controller: ControllerSettings = Field(
        ControllerSettings(), description=f"settings of its process: {', '.join(sorted(_CONTROL))}"
    )
    mpc: MpcSettings = Field(MpcSettings(), description="settings of its control problem")
    endpoints: tuple[Endpoint, ...] = Field(
        (), description="of a plant and a controller that run elsewhere, by which they are reached"
    )
    event: tuple[Event, ...] = Field((), max_length=100, description="what happens")
    holds: Holds = Field(Holds(), description="what must hold")

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if given := self.controller.model_fields_set - _CONTROL:
            raise ValueError(
                f"controller.{min(given)} follows from the scenario; there are "
                f"{', '.join(sorted(_CONTROL))}"
            )
        if not self.laps and self.holds.laps:
            raise ValueError("holds.laps: laps = 0 ends the run by its time; leave one of them out")
        kinds: set[str] = {one.kind for one in self.event}
        detecting = self.holds.detected_within_s is not None or self.holds.detected
        if detecting and "sensor" not in kinds:
            raise ValueError("holds.detected…: no sensor event, and so nothing to detect")
        if self.holds.drives_on_within_s is not None and not self.event:
            raise ValueError("holds.drives_on_within_s: nothing happens; add an [[event]]")
        if self.holds.unaccounted is not None and "kill" in kinds:
            raise ValueError("holds.unaccounted: who is killed says no more what it has received")
        for one in self.event:
            if one.at_s >= self.max_time_s:
                raise ValueError(f"event at {one.at_s:g} s: the run ends at {self.max_time_s:g} s")
        self._check_place(kinds)
        for fault in self.faults.root:
            fault.check(self.race.instruments)
        return self

    def _check_place(self, kinds: set[str]) -> None:
        """What cannot happen to processes that were started elsewhere."""
        if self.endpoints and self.mode == "simulated":
            raise ValueError('endpoints are of processes: add mode = "realtime", or leave them')
        foreign = kinds - {"stop", "go", "weights", "rollback"}
        if self.endpoints and foreign:
            raise ValueError(
                f"event '{min(foreign)}': plant and controller were started elsewhere, where only "
                "stop, go, weights and rollback reach them; leave out endpoints or the event"
            )

    @property
    def states_hz(self) -> float:
        """Rate of states and of cycles."""
        return self.controller.rate_hz

    @property
    def faults(self) -> SensorFaults:
        """Of the plant's sensors."""
        return SensorFaults(tuple(o.played() for o in self.event if isinstance(o, SensorEvent)))

    def world(self, track: Track) -> World:
        """What changes while the car drives."""
        events = (one.played(track) for one in self.event if isinstance(one, WorldEvent))
        return World((*self.race.changes.root, *events))

    @property
    def undisturbed(self) -> "Scenario":
        """The same drive, in which nothing happens; nothing of it is checked."""
        update = {"event": (), "holds": Holds(off_track_samples=None)}
        return self.model_copy(update=update)

    @property
    def wanted_weights(self) -> set[str]:
        """All that it names."""
        return {self.weights, *(o.weights for o in self.event if isinstance(o, WeightsEvent))}


def shipped() -> dict[str, Path]:
    """Those that ship, by name."""
    return {path.stem: path for path in sorted(_SHIPPED.glob("*.toml"))}


def read_scenario(given: str | Path, changed: Mapping[str, Any] | None = None) -> Scenario:
    """A file, or one that ships by its name; ``changed``: values by their places, as
    ``event.0.delay_ms``. InputError names file, place and remedy."""
    path = shipped().get(str(given), Path(given))
    content = parse_toml(read_text(path, "the scenario", _REMEDY), path, _REMEDY)
    for place, value in (changed or {}).items():
        _put(content, place, value)
    try:
        return Scenario.model_validate(content | {"name": path.stem})
    except ValidationError as error:
        raise InputError(f"{path}: {faults_in(error, 'the scenario', Scenario, KINDS)}") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _put(content: Any, place: str, value: Any) -> None:
    """Sets the value there; InputError if there is no such place."""
    *outer, last = place.split(".")
    inner = content
    for part in outer:
        if isinstance(inner, dict):
            inner = inner.setdefault(part, {})
        elif isinstance(inner, list) and part.isdecimal() and int(part) < len(inner):
            inner = inner[int(part)]
        else:
            there = f"0 to {len(inner) - 1}" if isinstance(inner, list) and inner else "none"
            raise InputError(f"'{place}': there is no '{part}'; there are {there}")
    if not isinstance(inner, dict):
        raise InputError(f"'{place}' names no value: write it as event.0.delay_ms")
    inner[last] = value
