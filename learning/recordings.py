"""Recordings of other programs as series of numbers: CSV files and rosbag2 recordings.

In a bag a name is ``TOPIC:FIELD``, as ``/odom:pose.pose.position.x`` or ``/joints:position.0``; a
field that is a quaternion is its yaw angle.
"""

from collections.abc import Collection
from functools import reduce
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from bayesrace.arrays import Floats
from bayesrace.errors import InputError

__all__ = ["Series", "csv_columns", "read_bag", "read_csv"]


class Series(NamedTuple):
    """What was recorded one after another, (n,) each."""

    time: Floats
    """Since the beginning of the recording: of a bag in seconds, of a CSV file in its unit."""
    value: Floats

    @classmethod
    def checked(cls, what: str, time: ArrayLike, value: ArrayLike) -> "Series":
        """InputError about ``what``, unless all is finite and the time increases."""
        one = cls(np.asarray(time, dtype=np.float64), np.asarray(value, dtype=np.float64))
        wrong = ~np.isfinite(one).all(axis=0)
        if wrong.any():
            raise InputError(f"{what}: row {wrong.argmax() + 1} is not finite; leave it out")
        if (late := np.diff(one.time) <= 0).any():
            raise InputError(f"{what}: the time of row {late.argmax() + 2} is no later than that "
                             "before it; sort the rows, each time once")  # fmt: skip
        return one


def csv_columns(path: Path) -> list[str]:
    """Names of the columns of a text file, in its first line."""
    return _csv(path)[0]


def read_csv(path: Path, names: Collection[str], time: str) -> dict[str, Series]:
    """Columns of a text file; InputError for one that is missing, and for what is no number."""
    columns, separator, lines = _csv(path)
    wanted = [time, *names]
    if missing := [name for name in wanted if name not in columns]:
        raise InputError(f"{path} has no column '{missing[0]}'; it has {', '.join(columns)}")
    places = [columns.index(name) for name in wanted]
    try:
        rows = np.loadtxt(lines, delimiter=separator, usecols=places, ndmin=2)
    except ValueError as error:
        raise InputError(f"{path}, below its first line: {error}; give numbers alone") from error
    since = rows[:, 0] - rows[0, 0]
    found = zip(names, rows.T[1:], strict=True)
    return {name: Series.checked(f"{path}: '{name}'", since, value) for name, value in found}


def _csv(path: Path) -> tuple[list[str], str, list[str]]:
    """Names, what separates them (comma, semicolon or tab), and the lines that follow."""
    try:
        head, *lines = path.read_text(encoding="utf-8-sig").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read the drive {path}: {error}") from error
    if not any(line.strip() for line in lines):
        raise InputError(f"{path} has no rows; give a first line with names, and rows of numbers")
    separator = max(",;\t", key=head.count)
    return [name.strip(' "\r') for name in head.lstrip("#").split(separator)], separator, lines


def read_bag(path: Path, names: Collection[str], time: str) -> dict[str, Series]:
    """Fields of the messages in a rosbag2 recording (MCAP or SQLite): its folder, or one file.

    ``time``: the field with a message's time, or ``recorded``, when the bag has got it. InputError
    for topics and fields that are missing, and for what is no number.
    """
    from rosbags.highlevel import AnyReader  # of the extra ros2

    from bayesrace.ros2.types import TYPES

    try:
        with AnyReader([path], default_typestore=TYPES) as bag:  # some have no definitions
            return _fields(path, bag, names, time)
    except InputError:
        raise
    except Exception as error:  # damage raises anything of SQLite, YAML, CDR or decompression
        raise InputError(f"{path} is no rosbag2 recording that can be read ({error})") from error


def _fields(path: Path, bag: Any, names: Collection[str], time: str) -> dict[str, Series]:
    wanted: dict[str, list[tuple[str, str]]] = {}
    for name in names:
        wanted.setdefault(name.partition(":")[0], []).append((name, name.partition(":")[2]))
    held = sorted(name for name, topic in bag.topics.items() if topic.msgcount)
    if missing := [topic for topic in wanted if topic not in held]:
        raise InputError(f"{path} has no messages on '{missing[0]}'; it has {', '.join(held)}")
    rows: dict[str, list[tuple[int, float]]] = {name: [] for name in names}
    for connection, at_ns, data in bag.messages([c for c in bag.connections if c.topic in wanted]):
        message = bag.deserialize(data, connection.msgtype)
        place = f"{path}: '{connection.topic}' ({connection.msgtype})"
        if time != "recorded":
            stamp = _field(message, time, place)
            whole = hasattr(stamp, "nanosec")
            at_ns = stamp.sec * 10**9 + stamp.nanosec if whole else round(stamp * 10**9)
        for name, field in wanted[connection.topic]:
            rows[name].append((at_ns, _number(_field(message, field, place), place, field)))
    first_ns = min(one[0][0] for one in rows.values())
    return {
        name: Series.checked(f"{path}: '{name}'", [1e-9 * (at - first_ns) for at, _ in one],
                             [value for _, value in one])
        for name, one in rows.items()
    }  # fmt: skip


def _field(message: Any, path: str, place: str) -> Any:
    """What is at ``path`` within a message."""

    def below(value: Any, part: str) -> Any:
        return value[int(part)] if part.isdecimal() else getattr(value, part)

    try:
        return reduce(below, path.split("."), message)
    except (AttributeError, IndexError, TypeError):
        listed = ", ".join(name for name in vars(message) if not name.startswith("_"))
        raise InputError(f"{place} has no field '{path}'; it has {listed}") from None


def _number(value: Any, place: str, field: str) -> float:
    from bayesrace.ros2.types import heading_of

    try:
        return heading_of(value) if hasattr(value, "w") else float(value)
    except InputError as error:
        raise InputError(f"{place}: '{field}' is {error}") from None
    except (TypeError, ValueError):
        raise InputError(f"{place}: '{field}' is no number; name a field within it") from None
