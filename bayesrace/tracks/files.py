"""Tracks as CSV files: ``x_m, y_m, w_tr_right_m, w_tr_left_m``, one row per centreline point.

The form the TUM and F1TENTH communities use. Lines starting with # are comments; a first line of
column names without # is accepted; comma or semicolon; spaces anywhere; the first point may be
repeated at the end.
"""

from pathlib import Path
from typing import Final

import numpy as np

from bayesrace.errors import InputError
from bayesrace.files import read_text, write_whole
from bayesrace.tracks.checks import find_fault
from bayesrace.tracks.spline import FloatArray
from bayesrace.tracks.track import Track, drop_repeated

__all__ = ["read_table", "read_track", "write_track"]

_MOST_POINTS: Final = 20_000
"""Rows of a file: a point each centimetre of a track ten times as long as any here."""
_LARGEST: Final = 1e6
"""Of the numbers in a file: above it, no SI unit of a track or a racing line makes sense."""

COLUMNS = ("x_m", "y_m", "w_tr_right_m", "w_tr_left_m")


def read_track(path: Path | str, car_width_m: float | None = None) -> Track:
    """The track in a CSV file, named after the file.

    ``car_width_m``: the track must be at least as wide; default: the default car's. Raises
    InputError naming file, row (line number in the file) and remedy.
    """
    path = Path(path)
    table, rows = read_table(path, COLUMNS)
    points, right, left = drop_repeated(table[:, :2], table[:, 2], table[:, 3])
    fault = find_fault(points, right, left, default_car_width_m(car_width_m))
    if fault is not None:
        raise InputError(fault.text(str(path), "row", rows))
    return Track._from_checked(path.stem, points, right, left)


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


def read_table(path: Path, columns: tuple[str, ...]) -> tuple[FloatArray, list[int]]:
    """Numbers (n, len(columns)) of a CSV file and the line number of each row.

    Raises InputError for a file that can't be read, a wrong column count or a cell that is no
    number; what the numbers mean is checked by the caller.
    """
    text = read_text(path, "the CSV file", "give an existing one, of at most 20,000 points")
    values: list[list[float]] = []
    rows: list[int] = []
    for row, line in enumerate(text.splitlines(), start=1):
        content = line.split("#", 1)[0].strip()
        if not content:
            continue
        cells = [cell.strip() for cell in content.split(";" if ";" in content else ",")]
        if not rows and tuple(cells) == columns:
            continue
        if len(rows) == _MOST_POINTS:
            raise InputError(
                f"{path}, row {row}: more than {_MOST_POINTS} points; "
                "give fewer, some centimetres apart"
            )
        values.append(_numbers(path, row, cells, columns))
        rows.append(row)
    return np.array(values, dtype=float).reshape(-1, len(columns)), rows


def _numbers(path: Path, row: int, cells: list[str], columns: tuple[str, ...]) -> list[float]:
    if len(cells) != len(columns):
        raise InputError(
            f"{path}, row {row}: {len(cells)} columns instead of {len(columns)}; "
            f"each row needs {', '.join(columns)}, separated by commas or semicolons"
        )
    try:
        numbers = [_number(cell) for cell in cells]
    except ValueError as error:
        bad = next((cell for cell in cells if not _is_number(cell)), str(error))
        raise InputError(
            f"{path}, row {row}: '{bad[:40]}' is not a number; write numbers with a decimal point"
        ) from None
    if not all(abs(number) <= _LARGEST for number in numbers):
        raise InputError(
            f"{path}, row {row}: a value is not finite or beyond {_LARGEST:.0f}; "
            "give every value as a finite number in SI units"
        )
    return numbers


def _number(cell: str) -> float:
    """ValueError for what is no number to other programs, such as '1_0', either."""
    if "_" in cell:
        raise ValueError(cell)
    return float(cell)


def _is_number(cell: str) -> bool:
    try:
        _number(cell)
    except ValueError:
        return False
    return True
