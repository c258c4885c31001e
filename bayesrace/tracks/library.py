"""One way to any track: a built-in name, ``random:SEED``, ``random10:SEED`` or a CSV file."""

from pathlib import Path

from bayesrace.errors import InputError
from bayesrace.tracks.builtin import builtin_track, builtin_tracks
from bayesrace.tracks.files import default_car_width_m, read_track
from bayesrace.tracks.generator import RANDOM_TRACKS, random_track
from bayesrace.tracks.track import Track

__all__ = ["is_random_track", "load_track"]

_MAPS = (".yaml", ".yml")
_SEED_DIGITS = 18


def is_random_track(name: str) -> bool:
    """Whether the name is that of a generated circuit: ``random:SEED`` or ``random10:SEED``."""
    kind, _, seed = name.partition(":")
    return kind in RANDOM_TRACKS and _is_seed(seed)


def load_track(name_or_path: str | Path, car_width_m: float | None = None) -> Track:
    """The built-in track of that name, ``random:SEED`` or ``random10:SEED`` (for 1:43 and 1:10
    cars), or the track in that CSV file.

    ``car_width_m``: least width of a track from a file; default: the default car's. Raises
    InputError saying what there is instead.
    """
    text = str(name_or_path)
    if text in builtin_tracks():
        return _wide_enough(builtin_track(text), car_width_m)
    kind, colon, seed = text.partition(":")
    if colon and kind in RANDOM_TRACKS:
        return _wide_enough(random_track(_seed(text, seed), kind), car_width_m)
    path = Path(name_or_path)
    if not path.is_file():
        raise InputError(
            f"no track '{text}': neither a file nor built in; "
            f"built in: {', '.join(builtin_tracks())}, random:SEED, random10:SEED (1:10)"
        )
    if path.suffix in _MAPS:
        raise InputError(
            f"{text} is a map: 'bayesrace tracks {text} --out track.csv --picture track.svg' makes "
            "a track of it, and a picture to check it by"
        )
    return read_track(path, car_width_m)


def _seed(text: str, digits: str) -> int:
    if not _is_seed(digits):
        raise InputError(
            f"'{text[:40]}': the seed must be a whole number from 0 on, of at most {_SEED_DIGITS} "
            "digits, as in random:7"
        )
    return int(digits)


def _is_seed(digits: str) -> bool:
    return digits.isascii() and digits.isdigit() and len(digits) <= _SEED_DIGITS


def _wide_enough(track: Track, car_width_m: float | None) -> Track:
    """The same track; raises InputError if it is narrower than the car."""
    width = float((track.width_right_m + track.width_left_m).min())
    car = default_car_width_m(car_width_m)
    if width < car:
        raise InputError(
            f"track '{track.name}' is {width:.3g} m wide, the car {car:.3g} m; "
            "choose a wider track or a smaller car"
        )
    return track
