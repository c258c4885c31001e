"""Racing lines: minimum-time optimisation, the line as data, its file form.

Order: the line (line.py), gates across the track (gates.py), the friction circle (friction.py), the
nonlinear programme over both (ocp.py, solved as nlp.py has it), lines through a few nodes, for
optimisers without derivatives (nodes.py), and the cache (cached.py).

CasADi is imported on the first call of :func:`compute_raceline`, not with this package.
"""

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
from bayesrace.vehicles.parameters import CarParameters

__all__ = [
    "LineIdentity",
    "RaceLine",
    "RaceLineError",
    "RaceLineSettings",
    "check_line",
    "compute_raceline",
    "read_raceline",
    "read_raceline_for",
    "same_track",
    "write_raceline",
]


def compute_raceline(
    track: Track, car: CarParameters, settings: RaceLineSettings | None = None
) -> RaceLine:
    """Minimum-time flying lap of ``car`` on ``track``; see :mod:`bayesrace.raceline.ocp`.

    Raises InputError when the margin leaves no room, RaceLineError when the optimiser fails.
    """
    from bayesrace.raceline.ocp import solve

    return solve(track, car, settings or RaceLineSettings())
