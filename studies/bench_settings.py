"""What ``bayesrace bench`` measures."""

from typing import Annotated, Final

from pydantic import Field

from bayesrace.option import Option
from bayesrace.tracks import DEFAULT_RACE_TRACK
from codegen.settings import ProblemName
from controller.settings import MpcSettings
from operation.settings import PreparationSettings

__all__ = ["PUBLISHED", "BenchSettings", "Case"]

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
