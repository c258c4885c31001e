"""What a racing line was made for: in the header of its file, checked where it is driven."""

import logging
from pathlib import Path
from typing import Final

from bayesrace.cache import digest
from bayesrace.errors import InputError
from bayesrace.raceline.line import LineIdentity, RaceLine, read_raceline
from bayesrace.raceline.settings import RaceLineSettings
from bayesrace.tracks import Track
from bayesrace.vehicles.parameters import CarParameters

__all__ = ["check_line", "line_identity", "read_raceline_for", "same_track"]

_log = logging.getLogger("bayesrace.raceline")

_REMEDY: Final = "run 'bayesrace raceline' for this one, or name the one that the line is for"


def line_identity(track: Track, car: CarParameters, settings: RaceLineSettings) -> LineIdentity:
    """Of the line that these give."""
    return LineIdentity(
        car=car.identity,
        width_m=car.width_m,
        friction=car.friction if settings.friction is None else settings.friction,
        track=track.identity,
        settings=digest([settings.model_dump_json(), car.tuning.raceline.model_dump_json()]),
    )


def check_line(line: RaceLine, track: Track, car: CarParameters, where: str) -> None:
    """InputError, beginning with ``where``, if the line was made for another car, grip or track.

    Names do not count, only what they stand for. A line that does not say what it was made for is
    accepted, with a warning in the log; how it was computed (``settings``) is not compared.
    """
    made = line.made_for
    if made is None:
        _log.warning(
            "%s does not say for which car, grip and track it was made: it is driven as it is",
            where,
        )
        return
    if _shape(made.car) != car.digest():
        raise InputError(
            f"{where} was made for the car '{made.car}', this is '{car.identity}': {_REMEDY}"
        )
    if made.width_m != car.width_m:
        raise InputError(
            f"{where} was made for a car {made.width_m:g} m wide, '{car.name}' is "
            f"{car.width_m:g} m: {_REMEDY}"
        )
    if made.friction != car.friction:
        raise InputError(
            f"{where} was made for a friction of {made.friction:g}, the car '{car.name}' has "
            f"{car.friction:g}: run 'bayesrace raceline' for it, or name a car's file with "
            f"friction = {made.friction:g} in [limits]"
        )
    if not same_track(made.track, track.identity):
        raise InputError(
            f"{where} was made for the track '{made.track}', this is '{track.identity}': {_REMEDY}"
        )


def same_track(one: str, other: str) -> bool:
    """Whether two :attr:`bayesrace.tracks.Track.identity` are of one shape, whatever the names."""
    return _shape(one) == _shape(other)


def _shape(identity: str) -> str:
    """The digest of a name with a digest."""
    return identity.rpartition("-")[2]


def read_raceline_for(path: Path, track: Track, car: CarParameters) -> RaceLine:
    """The racing line in a file, to be driven by ``car`` on ``track``; see :func:`check_line`."""
    line = read_raceline(path, track.name)
    check_line(line, track, car, str(path))
    return line
