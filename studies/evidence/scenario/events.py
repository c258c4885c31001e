"""What can happen in a scenario: rows ``[[event]]``, each with its moment and how long it lasts."""

from collections.abc import Callable, Iterable
from functools import partial
from typing import Annotated, Any, Final, Literal, Self, get_args

from pydantic import Field, model_validator

from bayesrace.operation.driving_system import DrivingSystem, Part
from bayesrace.plant.faults import SensorFault
from bayesrace.plant.world import Change, What
from bayesrace.strict import StrictModel
from bayesrace.tracks import Track
from bayesrace.transport.relay import Link

__all__ = ["KINDS", "Event", "timeline"]

_FOREVER_S: Final = 1e6

FindWeights = Callable[[str], Any]
"""The content of the weights of that name."""

Receiver = Literal["plant", "controller", "both"]


class _Event(StrictModel):
    at_s: float = Field(ge=0, le=3600, description="when it begins, after the start [s]")

    @property
    def end_s(self) -> float:
        """When it is over; a million seconds if it never is."""
        lasts_s: float | None = getattr(self, "for_s", 0.0)
        return _FOREVER_S if lasts_s is None else self.at_s + lasts_s

    @property
    def settled_s(self) -> float:
        """When nothing of it happens any more; of what is there for good, when it began."""
        return self.end_s if self.end_s < _FOREVER_S else self.at_s

    @property
    def words(self) -> str:
        """For a person."""
        values = self.model_dump(exclude_defaults=True, exclude={"kind", "at_s", "for_s"})
        lasts_s: float | None = getattr(self, "for_s", None)
        said = [getattr(self, "kind", ""), *(f"{k} {v}" for k, v in values.items())]
        return ", ".join(said) + (f", for {lasts_s:g} s" if lasts_s else "")

    def begin(self, system: DrivingSystem, weights: FindWeights) -> object:
        """Makes it happen; ``weights`` finds those of a name. Nothing where the plant itself was
        started with it."""

    def end(self, system: DrivingSystem) -> object:
        """Ends it."""


class _Lasting(_Event):
    for_s: float | None = Field(None, gt=0, le=3600, description="how long [s]; without: for good")


class _OnLink(_Lasting):
    to: Receiver = Field("both", description="whose messages: those for plant, controller, both")

    @property
    def ways(self) -> tuple[Part, ...]:
        """By who receives."""
        return get_args(Part) if self.to == "both" else (self.to,)


class LinkEvent(_OnLink):
    """The link between plant and controller gets worse."""

    kind: Literal["link"]
    delay_ms: float = Field(0.0, ge=0, le=5000, description="time on the way [ms]")
    jitter_ms: float = Field(0.0, ge=0, le=5000, description="so much more or less of it [ms]")
    loss: float = Field(0.0, ge=0, lt=1, description="probability with which a message is lost")
    reordered: bool = Field(
        False,
        description="as UDP: what is lost stays lost, and messages overtake each other; without, "
        "as TCP: it comes later and holds up what follows. In real time of the whole drive",
    )

    def begin(self, system: DrivingSystem, weights: FindWeights) -> None:
        """Both ways have the same numbers."""
        link = Link(1e-3 * self.delay_ms, 1e-3 * self.jitter_ms, self.loss, not self.reordered)
        for way in self.ways:
            system.set_link(way, link)

    def end(self, system: DrivingSystem) -> None:
        """A perfect link."""
        for way in self.ways:
            system.set_link(way, Link(ordered=not self.reordered))


class PartitionEvent(_OnLink):
    """Nothing gets through."""

    kind: Literal["partition"]

    def begin(self, system: DrivingSystem, weights: FindWeights) -> None:
        """One way or both."""
        for way in self.ways:
            system.hold(way)

    def end(self, system: DrivingSystem) -> None:
        """What has waited arrives."""
        for way in self.ways:
            system.release(way)


class PauseEvent(_Event):
    """A process does not run for a while, as on a machine that stalls."""

    kind: Literal["pause"]
    process: Part = Field(description="plant or controller")
    for_s: float = Field(gt=0, le=60, description="how long [s]")

    def begin(self, system: DrivingSystem, weights: FindWeights) -> None:
        """It goes on by itself."""
        system.pause(self.process, self.for_s)


class KillEvent(_Lasting):
    """The controller is killed, and started again when that is over."""

    kind: Literal["kill"]

    def begin(self, system: DrivingSystem, weights: FindWeights) -> None:
        """SIGKILL."""
        system.kill()

    def end(self, system: DrivingSystem) -> None:
        """As it was started first."""
        system.start()


class CommandEvent(_Event):
    """A command of the operator."""

    kind: Literal["stop", "go", "rollback"]

    def begin(self, system: DrivingSystem, weights: FindWeights) -> object:
        """As ``bayesrace stop``, ``go`` and ``rollback``."""
        commands = {"stop": system.stop, "go": system.go, "rollback": system.roll_back}
        return commands[self.kind]()


class WeightsEvent(_Event):
    """New weights are published."""

    kind: Literal["weights"]
    weights: str = Field(description="learned, updated, or a file")

    def begin(self, system: DrivingSystem, weights: FindWeights) -> object:
        """As ``bayesrace publish``."""
        return system.publish(weights(self.weights))


class SensorEvent(_Lasting):
    """A sensor fails: one of docs/faults.md."""

    kind: Literal["sensor"]
    fault: str = Field(description="its name, as docs/scenarios.md lists them")
    instrument: str = Field("", description="that fails; empty: the state, measured as a whole")

    @model_validator(mode="after")
    def _known(self) -> Self:
        self.played()
        return self

    def played(self) -> SensorFault:
        """As the plant plays it."""
        return SensorFault(
            fault=self.fault, instrument=self.instrument, from_s=self.at_s, until_s=self.end_s
        )


class WorldEvent(_Lasting):
    """The car or its road changes: everywhere, or at a place of the track."""

    kind: What
    share: float = Field(ge=0.05, le=5, description="of what it was [-]")
    over_s: float = Field(0.0, ge=0, le=3600, description="how long it grows [s]; 0: at once")
    along_m: float | None = Field(
        None, ge=0, le=1e4, description="way along the centreline to the middle of the place [m]"
    )
    radius_m: float | None = Field(None, gt=0, le=1e3, description="radius of the place [m]")

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if (self.along_m is None) != (self.radius_m is None):
            raise ValueError("a place takes along_m and radius_m: give both, or none")
        return self

    def played(self, track: Track) -> Change:
        """As the plant plays it."""
        place: dict[str, Any] = {}
        if self.along_m is not None:
            x_m, y_m = track.position(self.along_m % track.length_m).tolist()
            place = {"x_m": x_m, "y_m": y_m, "radius_m": self.radius_m}
        return Change(
            what=self.kind, share=self.share, over_s=self.over_s,
            from_s=self.at_s, until_s=self.end_s, **place,
        )  # fmt: skip


Event = Annotated[
    LinkEvent | PartitionEvent | PauseEvent | KillEvent | CommandEvent | WeightsEvent
    | SensorEvent | WorldEvent,
    Field(discriminator="kind"),
]  # fmt: skip
"""A row, by its ``kind``."""

KINDS: Final[tuple[str, ...]] = tuple(
    kind
    for event in get_args(get_args(Event)[0])
    for kind in get_args(event.model_fields["kind"].annotation)
)
"""Of events."""


def timeline(
    events: Iterable[Event], weights: FindWeights
) -> list[tuple[float, Callable[[DrivingSystem], object]]]:
    """When what is done to the system, in this order."""
    steps: list[tuple[float, Callable[[DrivingSystem], object]]] = []
    for one in events:
        steps.append((one.at_s, partial(one.begin, weights=weights)))
        if one.at_s < one.end_s < _FOREVER_S:
            steps.append((one.end_s, one.end))
    return sorted(steps, key=lambda step: step[0])
