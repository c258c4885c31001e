"""Built-in circuits, each a polygon of our own design with rounded corners.

For 1:43 cars, ``paddock`` is short and wide, for learning to drive; ``harbour`` is long and narrow,
for the race. For 1:10 cars, ``workshop`` is small and narrow, ``airfield`` large and wide. Driving
order is the order of the corners; the start line is on the edge into the first corner.
"""

from functools import cache
from typing import Final, NamedTuple

import numpy as np

from bayesrace.errors import InputError
from bayesrace.tracks.shapes import Corner, rounded_polygon
from bayesrace.tracks.track import Track

__all__ = ["DEFAULT_RACE_TRACK", "DEFAULT_TRAINING_TRACK", "builtin_track", "builtin_tracks"]

DEFAULT_TRAINING_TRACK: Final = "paddock"
DEFAULT_RACE_TRACK: Final = "harbour"


class _Design(NamedTuple):
    corners: tuple[Corner, ...]
    width_m: float
    start_m: float
    """How far before the first corner's arc the start line is."""
    scale: float = 1.0
    """Of the circuit's points and easing; 1 for a 1:43 car."""


_DESIGNS: Final[dict[str, _Design]] = {
    # Driven clockwise: straight, hairpin, hump, left-right chicane, U-turn, kinked way back.
    "paddock": _Design(
        corners=(
            (1.75, 1.12, 0.48),
            (1.62, -1.00, 0.31),
            (0.98, -1.00, 0.31),
            (0.92, 0.28, 0.32),
            (0.05, 0.36, 0.34),
            (-0.02, -0.22, 0.32),
            (-0.48, -0.62, 0.32),
            (-0.52, -1.12, 0.34),
            (-1.62, -1.02, 0.50),
            (-1.50, -0.10, 0.45),
            (-1.78, 0.40, 0.45),
            (-1.70, 1.16, 0.42),
        ),
        width_m=0.46,
        start_m=1.3,
    ),
    # Driven anticlockwise: straight, hairpin, infield, chicane, hairpin, long straight, esses.
    "harbour": _Design(
        corners=(
            (1.75, -1.42, 0.42),
            (1.80, 0.20, 0.25),
            (1.26, 0.16, 0.25),
            (1.16, -0.74, 0.30),
            (0.30, -0.84, 0.32),
            (0.22, -0.16, 0.30),
            (-0.22, 0.24, 0.30),
            (-0.26, 0.86, 0.32),
            (1.62, 0.92, 0.26),
            (1.66, 1.46, 0.26),
            (-1.50, 1.56, 0.50),
            (-1.72, 0.62, 0.36),
            (-1.12, 0.16, 0.30),
            (-1.16, -0.34, 0.30),
            (-1.74, -0.76, 0.32),
            (-1.66, -1.46, 0.40),
        ),
        width_m=0.37,
        start_m=1.2,
    ),
    # 1:10, indoors. Driven anticlockwise: straight, right angle, S between two halls, hairpin.
    "workshop": _Design(
        corners=(
            (4.9, -2.2, 0.9),
            (4.9, 1.2, 1.0),
            (2.4, 1.3, 0.85),
            (1.6, -0.5, 0.85),
            (-0.4, -0.5, 0.85),
            (-0.9, 1.9, 1.0),
            (-4.6, 1.9, 1.1),
            (-4.6, -2.2, 1.1),
        ),
        width_m=1.0,
        start_m=4.0,
        scale=4.0,
    ),
    # 1:10, as wide as F1TENTH races have it. Driven clockwise: long straight, wide right, chicane,
    # hairpin, esses, kink, last corner.
    "airfield": _Design(
        corners=(
            (17.0, 9.0, 3.2),
            (16.0, 1.0, 2.6),
            (9.5, 2.0, 2.4),
            (8.5, -5.5, 2.4),
            (16.5, -7.0, 2.0),
            (16.0, -11.0, 2.0),
            (1.0, -10.5, 3.0),
            (-2.5, -4.0, 3.2),
            (-8.5, -9.5, 2.8),
            (-16.0, -7.0, 3.6),
            (-12.5, 1.5, 3.4),
            (-17.5, 8.5, 2.8),
        ),
        width_m=2.2,
        start_m=10.0,
        scale=8.0,
    ),
}


def builtin_tracks() -> tuple[str, ...]:
    """Names of the built-in tracks, for :func:`bayesrace.tracks.load_track`."""
    return tuple(sorted(_DESIGNS))


@cache
def builtin_track(name: str) -> Track:
    """The built-in track called ``name``; raises InputError naming those there are."""
    design = _DESIGNS.get(name)
    if design is None:
        raise InputError(f"unknown track '{name}'; built in: {', '.join(builtin_tracks())}")
    points = rounded_polygon(design.corners, 0.04 * design.scale, 0.05 * design.scale)
    if points is None:
        raise AssertionError(f"the corners of built-in track '{name}' overlap")
    spacing = float(np.linalg.norm(points[1] - points[0]))
    points = np.roll(points, round(design.start_m / spacing), axis=0)
    return Track.from_points(name, points, design.width_m / 2, design.width_m / 2)
