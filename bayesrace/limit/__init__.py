"""The limit: the fastest lap that a car can drive on a track, by minimum-time optimal control.

With the true model, tyres and actuators' limits as the plant has them; gates, first guess and IPOPT
are the racing line's (:mod:`bayesrace.raceline`). Order: the lap as a file (lap.py), the nonlinear
programme (ocp.py), solved from the racing line on, on meshes twice as fine each (solve.py).

CasADi is imported on the first call of :func:`compute_limit`, not with this package.
"""

from contextlib import suppress
from pathlib import Path

from bayesrace.cache import cache_folder, kept
from bayesrace.errors import InputError
from bayesrace.limit.lap import LimitLap, LimitSettings, read_limit, write_limit
from bayesrace.raceline import optimised_identity
from bayesrace.tracks import Track
from bayesrace.vehicles.parameters import Car

__all__ = [
    "LimitLap",
    "LimitSettings",
    "compute_limit",
    "known_limit",
    "limit_lap",
    "read_limit",
    "write_limit",
]


def compute_limit(track: Track, car: Car, settings: LimitSettings | None = None) -> LimitLap:
    """The fastest lap of ``car`` on ``track``; see :mod:`bayesrace.limit.solve`.

    Raises InputError when the margin leaves no room or no lap is found.
    """
    from bayesrace.limit.solve import solve

    return solve(track, car, settings or LimitSettings())


def limit_lap(track: Track, car: Car, settings: LimitSettings | None = None) -> LimitLap:
    """:func:`compute_limit`, or what it returned for the same track, car and settings before."""
    settings = settings or LimitSettings()
    return kept(
        _file(track, car, settings),
        lambda path: write_limit(path, compute_limit(track, car, settings)),
        read_limit,
    )


def known_limit(track: Track, car: Car, settings: LimitSettings) -> LimitLap | None:
    """The limit if it was computed before."""
    with suppress(InputError):
        return read_limit(_file(track, car, settings))
    return None


def _file(track: Track, car: Car, settings: LimitSettings) -> Path:
    """Named after car, track, settings and code."""
    return cache_folder() / f"limit-{optimised_identity(track, car, settings)}.csv"
