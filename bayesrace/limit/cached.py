"""Limits that were computed before, from the cache."""

from contextlib import suppress
from pathlib import Path

from bayesrace.cache import cache_folder, kept
from bayesrace.errors import InputError
from bayesrace.limit import compute_limit
from bayesrace.limit.lap import LimitLap, LimitSettings, read_limit, write_limit
from bayesrace.raceline.cached import optimised_identity
from bayesrace.tracks import Track
from bayesrace.vehicles.parameters import CarParameters

__all__ = ["known_limit", "limit"]


def limit(track: Track, car: CarParameters, settings: LimitSettings | None = None) -> LimitLap:
    """:func:`compute_limit`, or what it returned for the same track, car and settings before."""
    settings = settings or LimitSettings()
    return kept(
        _file(track, car, settings),
        lambda path: write_limit(path, compute_limit(track, car, settings)),
        read_limit,
    )


def known_limit(track: Track, car: CarParameters, settings: LimitSettings) -> LimitLap | None:
    """The limit if it was computed before."""
    with suppress(InputError):
        return read_limit(_file(track, car, settings))
    return None


def _file(track: Track, car: CarParameters, settings: LimitSettings) -> Path:
    """Named after car, track, settings and code."""
    return cache_folder() / f"limit-{optimised_identity(track, car, settings)}.csv"
