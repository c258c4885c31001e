"""Tracks as CSV files: ``x_m, y_m, w_tr_right_m, w_tr_left_m``, one row per centreline point.

The form the TUM and F1TENTH communities use. Columns are separated by commas, semicolons, tabs or
spaces; what follows a # is a comment. A first line of column names, with or without #, gives the
order of the columns. The first point may be repeated at the end.
"""

from pathlib import Path
from typing import Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.files import read_text, write_whole
from bayesrace.tracks.checks import Fault, find_fault, find_scale_fault, find_value_fault
from bayesrace.tracks.smoothing import smooth
from bayesrace.tracks.track import Track, drop_repeated

__all__ = ["read_recentred", "read_smoothed", "read_table", "read_track", "write_track"]

_MOST_POINTS: Final = 20_000
"""Rows of a file: a point each centimetre of a track ten times as long as any here."""
_LARGEST: Final = 1e8
"""Of the numbers in a file: more than any map's coordinates in metres."""

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
    lines = [f"# {','.join(COLUMNS)}"]
    lines += [",".join(repr(value) for value in row) for row in nodes.tolist()]
    write_whole(Path(path), "\n".join(lines) + "\n")


def default_car_width_m(car_width_m: float | None) -> float:
    """The given width, or that of the default car."""
    if car_width_m is not None:
        return car_width_m
    from bayesrace.vehicles import DEFAULT_CAR, get_car

    return get_car(DEFAULT_CAR).width_m


def read_table(path: Path, columns: tuple[str, ...]) -> tuple[Floats, list[int]]:
    """Numbers (n, len(columns)) of a CSV file and the line number of each row.

    A header with these names in another order is honoured. Raises InputError for a file that can't
    be read, a header with other units, a wrong column count or a cell that is no number; what the
    numbers mean is checked by the caller.
    """
    text = read_text(path, "the CSV file", "give an existing one, of at most 20,000 points")
    values: list[list[float]] = []
    rows: list[int] = []
    order = list(range(len(columns)))
    for row, line in enumerate(text.splitlines(), start=1):
        if not rows and (header := _header(path, row, line, columns)):
            order = header
            continue
        content = line.split("#", 1)[0].strip()
        if not content:
            continue
        if len(rows) == _MOST_POINTS:
            raise InputError(
                f"{path}, row {row}: more than {_MOST_POINTS} points; "
                "give fewer, some centimetres apart"
            )
        numbers = _numbers(path, row, _cells(content), columns)
        values.append([numbers[i] for i in order])
        rows.append(row)
    return np.array(values, dtype=float).reshape(-1, len(columns)), rows


def _cells(line: str) -> list[str]:
    separator = next((mark for mark in ";,\t" if mark in line), None)
    return [cell.strip() for cell in line.split(separator)]


def _header(path: Path, row: int, line: str, columns: tuple[str, ...]) -> list[int] | None:
    """The place of each of ``columns`` in the file, if this line names all of them."""
    names = _cells(line.strip().removeprefix("#").strip().lower())
    found, wanted = [_quantity(name) for name in names], [_quantity(name) for name in columns]
    if sorted(found) != sorted(wanted):
        return None
    order = [found.index(quantity) for quantity in wanted]
    for column, name in zip(columns, (names[i] for i in order), strict=True):
        if _unit(name) not in ("", _unit(column)):
            raise InputError(
                f"{path}, row {row}: the header names '{name[:40]}' where '{column}' is expected; "
                f"give the values in the unit of '{column}' and name them so"
            )
    return order


def _quantity(name: str) -> str:
    """What a column holds, by its name: 'x' of 'x_m', 'left' of 'w_tr_left_m'."""
    return next((side for side in ("right", "left") if side in name), name.split("_")[0])


def _unit(name: str) -> str:
    """The unit at the end of a column's name; empty without one."""
    unit = name.rpartition("_")[2] if "_" in name else ""
    return "" if unit in ("right", "left") else unit


def _numbers(path: Path, row: int, cells: list[str], columns: tuple[str, ...]) -> list[float]:
    if len(cells) != len(columns):
        raise InputError(
            f"{path}, row {row}: {len(cells)} column{'s' * (len(cells) != 1)} instead of "
            f"{len(columns)}; each row needs {', '.join(columns)}, separated by commas, "
            "semicolons, tabs or spaces"
        )
    try:
        numbers = [_number(cell) for cell in cells]
    except ValueError as error:
        raise InputError(
            f"{path}, row {row}: '{str(error)[:40]}' is not a number; "
            "write numbers with a decimal point"
        ) from None
    if not all(abs(number) <= _LARGEST for number in numbers):
        raise InputError(
            f"{path}, row {row}: a value is not finite or beyond {_LARGEST:g}; "
            "give every value as a finite number in SI units"
        )
    return numbers


def _number(cell: str) -> float:
    """The number; ValueError with the cell if it is none to other programs either, as '1_0'."""
    try:
        if "_" not in cell:
            return float(cell)
    except ValueError:
        pass
    raise ValueError(cell)
