"""Tables of numbers in CSV files, and what comments of the form ``# key: value`` say about them.

Columns are separated by commas, semicolons, tabs or spaces; what follows a # is a comment. A first
line of column names, with or without #, gives the order of the columns. Every number that is
written reads back as the same double.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.files import read_text, write_whole

__all__ = ["read_table", "write_table"]

_MOST_POINTS: Final = 20_000
"""Rows of a file: a point each centimetre of a track ten times as long as any here."""
_LARGEST: Final = 1e8
"""Of the numbers in a file: more than any map's coordinates in metres."""
_KEY: Final = re.compile(r"#\s*(\w+):\s*(\S+)\s*")


def write_table(
    path: Path | str,
    columns: tuple[str, ...],
    table: Floats,
    about: Mapping[str, object] | None = None,
    separator: str = "; ",
) -> None:
    """Writes the whole file or nothing."""
    lines = [f"# {separator.join(columns)}"]
    lines += [f"# {key}: {value}" for key, value in (about or {}).items()]
    lines += [separator.join(repr(value) for value in row) for row in table.tolist()]
    write_whole(Path(path), "\n".join(lines) + "\n")


def read_table(path: Path, columns: tuple[str, ...]) -> tuple[Floats, list[int], dict[str, str]]:
    """Numbers (n, len(columns)) of a CSV file, the line number of each row, and what the comments
    say, by key.

    A header with these names in another order is honoured. Raises InputError for a file that can't
    be read, a header with other units, a wrong column count or a cell that is no number; what the
    numbers mean is checked by the caller.
    """
    text = read_text(path, "the CSV file", "give an existing one, of at most 20,000 points")
    values: list[list[float]] = []
    rows: list[int] = []
    about: dict[str, str] = {}
    order = list(range(len(columns)))
    for row, line in enumerate(text.splitlines(), start=1):
        if said := _KEY.fullmatch(line):
            about[said[1]] = said[2]
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
    return np.array(values, dtype=float).reshape(-1, len(columns)), rows, about


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
    numbers = []
    for cell in cells:
        try:
            numbers.append(float(cell.replace("_", "?")))  # no other program reads 1_0 as a number
        except ValueError:
            raise InputError(
                f"{path}, row {row}: '{cell[:40]}' is not a number; "
                "write numbers with a decimal point"
            ) from None
    if not all(abs(number) <= _LARGEST for number in numbers):
        raise InputError(
            f"{path}, row {row}: a value is not finite or beyond {_LARGEST:g}; "
            "give every value as a finite number in SI units"
        )
    return numbers
