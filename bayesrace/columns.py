"""A log as columns: each topic is one structured NumPy array, with a row for each message.

Columns are named as the fields of the message: integers are 64 bits wide, vectors of a fixed length
are sub-arrays, and texts, maps and vectors of any length are Python objects. ``counters.overruns``
is one entry of a map: an integer, 0 where it is missing. Of messages from a log there are two
columns more: ``n``, the number of the message among all that are read, and ``wall_ns``, calendar
time of its arrival at the recorder.
"""

from collections.abc import Callable, Iterable, Mapping
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from msgspec import inspect
from numpy.typing import NDArray

from bayesrace.log import LogReader
from bayesrace.messages import Message, Topic

__all__ = ["Columns", "LogColumns", "columns_of", "with_estimates"]

Columns = NDArray[Any]
"""A structured array: a name gives a column; a mask or a slice gives rows with all columns."""

_AT_ONCE: Final = 4096
"""Messages that are held as Python objects until they become rows of an array."""

_STAMPS: Final = [("n", np.int64), ("wall_ns", np.int64)]
_NUMBERS: Final = {inspect.IntType: np.int64, inspect.FloatType: np.float64, inspect.BoolType: bool}


def columns_of(kind: type[Message], messages: Iterable[Message], names: str) -> Columns:
    """The columns of messages of one kind that are in memory."""
    form = _Form(kind, names)
    return np.array([form.row(one) for one in messages], form.dtype)


def with_estimates(states: Columns, cycles: Columns) -> Columns:
    """``states`` with ``x`` as the controller has estimated it where ``estimated``; those of which
    it has not are left out.

    ``states`` has run, seq, x and estimated, or is of the truth and stays as it is; ``cycles`` has
    run, state_seq and estimate.
    """
    if "estimated" not in (states.dtype.names or ()) or not states["estimated"].any():
        return states
    found = {
        (run, seq): estimate[:7]
        for run, seq, estimate in cycles[["run", "state_seq", "estimate"]].tolist()
        if estimate
    }
    rows = states[["run", "seq", "estimated"]].tolist()
    kept = [not estimated or (run, seq) in found for run, seq, estimated in rows]
    filled: Columns = states[kept]
    for row in np.flatnonzero(filled["estimated"]):
        filled["x"][row] = found[filled["run"][row], filled["seq"][row]]
    return filled


class LogColumns:
    """The topics of a log as columns; the log may still be written.

    After :meth:`read`, ``columns[TOPIC]`` is the array of a topic, which later reading leaves as it
    is; ``reader`` states what could not be decoded.
    """

    def __init__(
        self, path: Path, wanted: Mapping[Topic[Any], str], car: str = "", most: int = 0
    ) -> None:
        """``wanted``: the names of each topic's columns. ``car``: its name in the network; all cars
        if empty. ``most``: reading ends when a topic has so many messages; 0: no limit."""
        self.reader = LogReader(path)
        self._car, self._most, self._count = car, most, 0
        self._forms = {topic: _Form(topic.message, names) for topic, names in wanted.items()}
        self._topics = {topic.message: topic for topic in wanted}
        self._rows: dict[Topic[Any], list[tuple[Any, ...]]] = {topic: [] for topic in wanted}
        self._arrays: dict[Topic[Any], list[Columns]] = {topic: [] for topic in wanted}

    def read(self) -> Self:
        """Takes in what has been added to the log; InputError if it is none."""
        for entry in self.reader.newer(tuple(self._forms)):
            number, self._count = self._count, self._count + 1
            if self._car and entry.key.split("/")[1] != self._car:
                continue
            topic = self._topics[type(entry.message)]
            rows = self._rows[topic]
            rows.append((number, entry.wall_ns, *self._forms[topic].row(entry.message)))
            if len(rows) >= _AT_ONCE:
                self._pack(topic)
                if 0 < self._most <= sum(map(len, self._arrays[topic])):
                    break
        return self

    def __getitem__(self, topic: Topic[Any]) -> Columns:
        """All rows of a topic that have been read."""
        arrays = self._arrays[topic]
        if self._rows[topic] or not arrays:
            self._pack(topic)
        if len(arrays) > 1:
            arrays[:] = [np.concatenate(arrays)]
        return arrays[0]

    def _pack(self, topic: Topic[Any]) -> None:
        dtype = np.dtype([*_STAMPS, *self._forms[topic].dtype])
        self._arrays[topic].append(np.array(self._rows[topic], dtype))
        self._rows[topic].clear()


class _Form:
    """How a message of one kind becomes a row with these columns."""

    def __init__(self, kind: type[Message], names: str) -> None:
        self._values = [_value_of(name) for name in names.split()]
        types = _types(kind)
        self.dtype = [
            (name, np.int64) if "." in name else (name, *types[name]) for name in names.split()
        ]

    def row(self, message: Message) -> tuple[Any, ...]:
        return tuple(value(message) for value in self._values)


def _value_of(name: str) -> Callable[[Message], Any]:
    """Reads the value of a column from a message."""
    field, _, entry = name.partition(".")
    get = attrgetter(field)

    def count(message: Message) -> int:
        value = get(message).get(entry)
        return value if type(value) is int else 0

    return count if entry else get


@cache
def _types(kind: type[Message]) -> dict[str, tuple[Any, ...]]:
    """NumPy's type of each field, and its length if it is a vector."""
    found: dict[str, tuple[Any, ...]] = {}
    described: Any = inspect.type_info(kind)
    for field in described.fields:
        form = field.type.type if isinstance(field.type, inspect.Metadata) else field.type
        length = getattr(form, "min_length", None)
        if isinstance(form, inspect.VarTupleType) and length and length == form.max_length:
            found[field.name] = np.float64, (length,)
        else:
            found[field.name] = (_NUMBERS.get(type(form), object),)
    return found
