"""What ``bayesrace timing`` measures, apart from what does it, which takes long to import."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from bayesrace.defaults import Option
from bayesrace.operation.settings import PreparationSettings
from bayesrace.studies.settings import BenchSettings

__all__ = ["TimingSettings"]


class TimingSettings(PreparationSettings):
    """The controller, what it has to solve, and what is asked of it."""

    tracks: Annotated[tuple[str, ...], Option("--track")] = Field(
        (), description="track to drive on, the logs' first; empty: those of 'bayesrace bench'"
    )
    weights: Path | None = Field(None, description="GP weights; None: trained")
    artefact: Annotated[Path | None, Option(metavar="DIR")] = Field(
        None, description="folder of 'bayesrace build'; None: built"
    )
    problems: int = Field(
        3000, ge=100, le=1_000_000, description="recorded cycles, of all tracks; without logs"
    )
    cases: int = Field(
        150, ge=5, le=100_000,
        description="adversarial starts: drawn at random, then as many changed from the worst",
    )  # fmt: skip
    count: int = Field(
        50, ge=0, le=100_000,
        description="recorded cycles whose instructions valgrind counts, beside those of the "
        "hardest start; 0: none",
    )  # fmt: skip
    rate_hz: float = Field(50.0, ge=1, le=500, description="rate of the controller [Hz]")
    budget: float = Field(
        0.8, ge=0, le=1, description="share of the period that a cycle may take; 0: no limit"
    )
    at_most_ms: Annotated[float | None, Option("--at-most", metavar="MS")] = Field(
        None, gt=0, description="time that each phase may take [ms]; None: the period"
    )
    exceedance: float = Field(
        1e-6, gt=0, lt=0.1,
        description="share of the blocks of cycles that may take longer than the level stated",
    )  # fmt: skip

    @property
    def driven_on(self) -> tuple[str, ...]:
        """The tracks."""
        return self.tracks or BenchSettings(car=self.car).driven_on

    @property
    def period_s(self) -> float:
        """Of the controller."""
        return 1 / self.rate_hz

    @property
    def limit_ms(self) -> float:
        """What each phase may take."""
        return 1e3 * self.period_s if self.at_most_ms is None else self.at_most_ms
