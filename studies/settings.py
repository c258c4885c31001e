"""What ``bayesrace bench`` measures and ``bayesrace tune`` searches."""

import re
from typing import Annotated, Any, Final

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from bayesrace.codegen.settings import ProblemName
from bayesrace.controller.settings import MpcSettings
from bayesrace.defaults import Option
from bayesrace.operation.settings import PreparationSettings
from bayesrace.tracks import DEFAULT_RACE_TRACK
from bayesrace.vehicles import CarSetting, default_car

__all__ = ["PUBLISHED", "BenchSettings", "Case", "TuneSettings", "spread"]

Case = tuple[ProblemName, float]
"""Problem and caution."""

PUBLISHED: Final[Case] = ("tracking", 0.0)
"""What IPOPT solves: it knows no uncertainty."""


class BenchSettings(PreparationSettings):
    """What is measured."""

    tracks: Annotated[tuple[str, ...], Option("--track")] = Field(
        (),
        description="track to record problems on; empty: the car's race track, and two more with "
        "hairpins for the 1:43 car",
    )
    published: bool = Field(False, description="tracking without caution alone, as published")
    problems: int = Field(900, ge=10, description="control steps of a case, of all tracks")
    peers: int = Field(25, ge=1, description="number of them that IPOPT solves, too")

    @property
    def driven_on(self) -> tuple[str, ...]:
        """The tracks, in order; random ones are 1:43 circuits."""
        race = self.car.race_track
        more = ("random:11", "random:15") if race == DEFAULT_RACE_TRACK else ()
        return self.tracks or (race, *more)

    @property
    def cases(self) -> tuple[Case, ...]:
        """What is driven; not progress on linear tyres, which have no limit."""
        caution = MpcSettings().caution
        progress: tuple[Case, ...] = ("progress", caution), ("progress", 0.0)
        both: tuple[Case, ...] = ("tracking", caution), PUBLISHED
        if self.published:
            return (PUBLISHED,)
        return both if self.car.tyres.model == "linear" else both + progress


_SPAN: Final = re.compile(r"(.*?)(\d{1,9})\.\.(\d{1,9})")


def spread(value: Any, most: int = 1_000_000) -> list[Any]:
    """``TEXT A..B`` as TEXT with each number, or as numbers alone; all else as it is.

    Of more than ``most`` numbers, one more than that.
    """
    match = _SPAN.fullmatch(value) if isinstance(value, str) else None
    if match is None:
        return [value]
    text, first, last = match[1], int(match[2]), int(match[3])
    numbers = range(first, min(last, first + most) + 1)
    return [f"{text}{number}" if text else number for number in numbers]


def _every(names: list[str]) -> tuple[str, ...]:
    return tuple(one for name in names for one in spread(name))


_Tracks = Annotated[tuple[str, ...], BeforeValidator(_every), Option(metavar="TRACK")]


class TuneSettings(BaseModel):
    """What is searched, and on which tracks."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)

    car: CarSetting = Field(default_factory=default_car)
    track: _Tracks = Field(
        ("harbour", "random:21..24"),
        min_length=1,
        description="track to tune on: a name, random:SEED, random:FIRST..LAST; empty: harbour, "
        "random:21..24",
    )
    held_out: _Tracks = Field(
        ("random:31..36",),
        min_length=1,
        description="track that judges the result; empty: random:31..36",
    )
    trials: int = Field(60, ge=1, le=100_000, description="trials, the defaults included")
    batch: int = Field(4, ge=1, le=1000, description="trials that are proposed at once")
    seed: int = Field(0, ge=0, description="seed of the search")
