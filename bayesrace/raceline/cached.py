"""Racing lines that were computed before, from the cache."""

from pathlib import Path
from typing import Final

from pydantic import BaseModel

from bayesrace.cache import cache_folder, digest, kept, software
from bayesrace.cpu import cpu_identity
from bayesrace.raceline import compute_raceline
from bayesrace.raceline.line import RaceLine, RaceLineSettings, read_raceline, write_raceline
from bayesrace.tracks import Track
from bayesrace.vehicles.parameters import CarParameters

__all__ = ["optimised_identity", "raceline_file", "racing_line"]

_SOURCES: Final = (
    "bayesrace/vehicles", "bayesrace/tracks", "bayesrace/raceline", "bayesrace/limit",
)  # fmt: skip


def racing_line(
    track: Track, car: CarParameters, settings: RaceLineSettings | None = None
) -> RaceLine:
    """:func:`compute_raceline`, or what it returned for the same track, car and settings before."""
    settings = settings or RaceLineSettings()
    return kept(
        raceline_file(track, car, settings),
        lambda path: write_raceline(path, compute_raceline(track, car, settings)),
        lambda path: read_raceline(path, track.name),
    )


def raceline_file(track: Track, car: CarParameters, settings: RaceLineSettings) -> Path:
    """Where the line is kept, in a folder named after car, track, settings and code."""
    identity = optimised_identity(track, car, settings)
    return cache_folder() / f"line-{identity}" / "race_raceline.csv"


def optimised_identity(track: Track, car: CarParameters, settings: BaseModel) -> str:
    """Digest of all that shapes a racing line or a limit of a car on a track."""
    return digest(
        [
            car.model_dump_json(),
            settings.model_dump_json(),
            track.identity,
            cpu_identity(),  # on which the last bits depend
            *software(_SOURCES, ("casadi", "numpy")),
        ]
    )
