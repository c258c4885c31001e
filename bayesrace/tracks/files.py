"""Tracks as CSV files: ``x_m, y_m, w_tr_right_m, w_tr_left_m``, one row per centreline point.

The form the TUM and F1TENTH communities use. Columns are separated by commas, semicolons, tabs or
spaces; what follows a # is a comment. A first line of column names, with or without #, gives the
order of the columns. The first point may be repeated at the end.
"""

from pathlib import Path

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.tracks.checks import Fault, find_fault, find_scale_fault, find_value_fault
from bayesrace.tracks.smoothing import smooth
from bayesrace.tracks.tables import read_table, write_table
from bayesrace.tracks.track import Track, drop_repeated

__all__ = ["read_recentred", "read_smoothed", "read_track", "write_track"]

COLUMNS = ("x_m", "y_m", "w_tr_right_m", "w_tr_left_m")


def read_track(path: Path | str, car_width_m: float | None = None) -> Track:
    """The track in a CSV file, named after the file.

    ``car_width_m``: the track must be at least as wide and of the car's scale; 0: of any scale;
    default: at least as wide as the default car, of any scale that is usual in metres. Raises
    InputError naming file, row (line number in the file) and remedy.
    """
    return _checked(Path(path), *_read_points(Path(path)), car_width_m)


def read_recentred(path: Path | str, car_width_m: float | None = None) -> tuple[Track, Floats]:
    """The same of a file with a map's coordinates, such as UTM's: the first point is the origin.

    And where that is in the file, (2,) [m].
    """
    points, right, left, rows = _read_points(Path(path))
    origin = points[:1].sum(axis=0)  # zero without a point
    return _checked(Path(path), points - origin, right, left, rows, car_width_m), origin


def _checked(
    path: Path, points: Floats, right: Floats, left: Floats, rows: list[int], width_m: float | None
) -> Track:
    _refuse(path, rows, find_fault(points, right, left, default_car_width_m(width_m)))
    if width_m != 0:
        _refuse(path, rows, find_scale_fault(points, right, left, width_m))
    return Track._from_checked(path.stem, points, right, left)


def read_smoothed(path: Path | str, car_width_m: float | None = None) -> tuple[Track, Floats]:
    """The track in a CSV file of points that were measured with noise, which is taken off; and how
    far each point is from the smooth centreline, (n,) [m].

    Raises InputError like :func:`read_track`, and where the smooth centreline is no track.
    """
    path = Path(path)
    points, right, left, rows = _read_points(path)
    least_m = default_car_width_m(car_width_m)
    moved = (points != np.roll(points, 1, axis=0)).any(axis=1)  # a logger that stood repeats itself
    distinct = points[moved], right[moved], left[moved]
    fault = find_value_fault(*distinct, least_m)
    _refuse(
        path,
        [row for row, kept in zip(rows, moved.tolist(), strict=False) if kept],
        fault or find_scale_fault(*distinct, car_width_m),
    )
    smoothed = smooth(*distinct)
    if find_fault(*smoothed, least_m) is not None:
        raise InputError(
            f"{path}: even smoothed, the centreline crosses itself or turns back; give the points "
            "of one lap in driving order"
        )
    track = Track._from_checked(path.stem, *smoothed)
    away_m = np.abs(track.project_points(points).n_m)
    if (outlier := away_m > right + left).any():
        first = int(np.argmax(outlier))
        raise InputError(
            f"{path}, row {rows[first]}: the point is {away_m[first]:.3g} m from the smooth "
            "centreline, farther than the track is wide; leave it out"
        )
    return track, away_m


def _read_points(path: Path) -> tuple[Floats, Floats, Floats, list[int]]:
    """Points (n, 2), widths to the right and to the left (n,), number of each row."""
    table, rows = read_table(path, COLUMNS)
    return *drop_repeated(table[:, :2], table[:, 2], table[:, 3]), rows


def _refuse(path: Path, rows: list[int], fault: Fault | None) -> None:
    if fault is not None:
        raise InputError(fault.text(str(path), "row", rows))


def write_track(path: Path | str, track: Track) -> None:
    """Writes the nodes of a track; reading the file gives the same numbers."""
    nodes = np.column_stack([track.x_m, track.y_m, track.width_right_m, track.width_left_m])
    write_table(path, COLUMNS, nodes, separator=",")


def default_car_width_m(car_width_m: float | None) -> float:
    """The given width, or that of the default car."""
    if car_width_m is not None:
        return car_width_m
    from bayesrace.vehicles import DEFAULT_CAR, get_car

    return get_car(DEFAULT_CAR).width_m
