"""Racing lines: minimum-time optimisation, the line as data, its file form, and the cache.

Order: the line (line.py), gates across the track (gates.py), the friction circle, and lines through
a few nodes for optimisers without derivatives (friction.py), the nonlinear programme over gates and
circle (ocp.py, solved as nlp.py has it).

CasADi is imported on the first call of :func:`compute_raceline`, not with this package.
"""

from pathlib import Path

from pydantic import BaseModel

from bayesrace.cache import cache_folder, cpu_identity, digest, kept, software
from bayesrace.raceline.line import (
    LineIdentity,
    RaceLine,
    RaceLineError,
    RaceLineSettings,
    check_line,
    read_raceline,
    read_raceline_for,
    same_track,
    write_raceline,
)
from bayesrace.tracks import Track
from bayesrace.vehicles.parameters import Car

__all__ = [
    "LineIdentity",
    "RaceLine",
    "RaceLineError",
    "RaceLineSettings",
    "check_line",
    "compute_raceline",
    "optimised_identity",
    "raceline_file",
    "racing_line",
    "read_raceline",
    "read_raceline_for",
    "same_track",
    "write_raceline",
]


def compute_raceline(track: Track, car: Car, settings: RaceLineSettings | None = None) -> RaceLine:
    """Minimum-time flying lap of ``car`` on ``track``; see :mod:`bayesrace.raceline.ocp`.

    Raises InputError when the margin leaves no room, RaceLineError when the optimiser fails.
    """
    from bayesrace.raceline.ocp import solve

    return solve(track, car, settings or RaceLineSettings())


def racing_line(track: Track, car: Car, settings: RaceLineSettings | None = None) -> RaceLine:
    """:func:`compute_raceline`, or what it returned for the same track, car and settings before."""
    settings = settings or RaceLineSettings()
    return kept(
        raceline_file(track, car, settings),
        lambda path: write_raceline(path, compute_raceline(track, car, settings)),
        lambda path: read_raceline(path, track.name),
    )


def raceline_file(track: Track, car: Car, settings: RaceLineSettings) -> Path:
    """Where the line is kept, in a folder named after car, track, settings and code."""
    identity = optimised_identity(track, car, settings)
    return cache_folder() / f"line-{identity}" / "race_raceline.csv"


def optimised_identity(track: Track, car: Car, settings: BaseModel) -> str:
    """Digest of all that shapes a racing line or a limit of a car on a track."""
    sources = ("vehicles", "tracks", "raceline", "limit")
    inputs = [car.model_dump_json(), settings.model_dump_json(), track.identity]
    # The last bits depend on the processor.
    return digest([*inputs, cpu_identity(), *software(sources, ("casadi", "numpy"))])
