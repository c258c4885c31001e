"""Racing line and track as the table that the native planner reads (br_mpc_set_path)."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.raceline.line import RaceLine
from bayesrace.tracks import Track
from bayesrace.tracks.spline import PlaneSpline

__all__ = ["CAPACITY", "PATH_COLUMNS", "PathTable", "make_path_table"]

CAPACITY: Final = 8192
"""BR_PATH_CAPACITY in controller/native/bayesrace_mpc.h."""

PATH_COLUMNS: Final = 7
"""BR_PATH_COLUMNS there."""

ASTRAY_MAX: Final = 0.05
"""Share of a line that may be farther out than half the track's width: with more it belongs to
another track."""


@dataclass(frozen=True, eq=False)
class PathTable:
    """Rows x, y, speed, left unit normal of the centreline (2), lower and upper bound of n . p.

    ``rows`` has shape (n, 7), sampled every ``spacing_m`` along the closed racing line.
    """

    rows: Floats
    spacing_m: float


def make_path_table(track: Track, line: RaceLine, spacing_m: float) -> PathTable:
    """Samples the line and, at each sample's projection on the centreline, the two half-planes.

    The half-planes are parallel to the centreline (paper, equation 8d), their normal has length 1,
    their distance is the track's width there. ``spacing_m``: wanted distance of rows; between them
    the planner interpolates linearly. InputError if the line belongs to another track.
    """
    count = min(CAPACITY, max(8, math.ceil(line.length_m / spacing_m)))
    s: Floats = np.arange(count, dtype=np.float64) * (line.length_m / count)
    nodes = np.append(line.s_m, line.s_m[0] + line.length_m)
    xy = PlaneSpline(line.s_m, line.xy_m, line.length_m)(s)
    speed = np.interp(s, nodes, np.append(line.vx_mps, line.vx_mps[0]), period=line.length_m)
    on_track = track.project_path(xy)
    right, left = track.widths(on_track.s_m)
    astray = float(np.mean(on_track.off_track_m > (right + left) / 2))
    if astray > ASTRAY_MAX:
        raise InputError(
            f"{100 * astray:.0f} % of the racing line '{line.track_name}' is far outside the track "
            f"'{track.name}': it was computed for another track; run 'bayesrace raceline'"
        )
    normal = track.normal(on_track.s_m)
    along = np.sum(normal * track.position(on_track.s_m), axis=1)
    rows = np.column_stack([xy, speed, normal, along - right, along + left])
    return PathTable(np.ascontiguousarray(rows), line.length_m / count)
