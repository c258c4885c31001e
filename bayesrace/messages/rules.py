"""What a field of a message may hold: one small rule per kind of value.

A rule's ``check`` returns the value as the dataclass keeps it or raises ``ValueError`` saying what
is wrong; the codec adds message and field name. Comparisons are written so that NaN fails them.

A rule also says how large its values get on the wire, in the widest form that msgpack has for them:
what is larger is refused before anything is made of it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Protocol

__all__ = ["Choice", "Flag", "Integer", "Real", "Rule", "Scalar", "Scalars", "Text", "Vector"]

Scalar = bool | int | float | str
"""What an event's or a reply's data map may hold."""

_INT64_MAX = 2**63 - 1
_REAL_MAX = 1e12

_NUMBER_BYTES = 9
_HEAD_BYTES = 5
"""Before the content of a text, array or map."""
_CHARACTER_BYTES = 4


class Rule(Protocol):
    """Checks one decoded value."""

    def check(self, value: Any) -> Any:
        """The value as the message keeps it; ValueError if it is not acceptable."""

    @property
    def wire_bytes(self) -> int:
        """Most bytes that an acceptable value takes."""


@dataclass(frozen=True)
class Integer:
    """Whole number within [low, high]; bool is not one."""

    low: int = 0
    high: int = _INT64_MAX

    def check(self, value: Any) -> int:
        """See :meth:`Rule.check`."""
        if type(value) is not int:
            raise ValueError(f"expected an integer, got {type(value).__name__}")
        if not self.low <= value <= self.high:
            raise ValueError(f"{value} is outside [{self.low}, {self.high}]")
        return value

    @property
    def wire_bytes(self) -> int:
        """See :attr:`Rule.wire_bytes`."""
        return _NUMBER_BYTES


@dataclass(frozen=True)
class Real:
    """Finite float within [low, high]; an integer on the wire is not one."""

    low: float = -_REAL_MAX
    high: float = _REAL_MAX

    def check(self, value: Any) -> float:
        """See :meth:`Rule.check`."""
        if type(value) is not float:
            raise ValueError(f"expected a float, got {type(value).__name__}")
        if not self.low <= value <= self.high:
            raise ValueError(f"{value} is outside [{self.low:g}, {self.high:g}]")
        return value

    @property
    def wire_bytes(self) -> int:
        """See :attr:`Rule.wire_bytes`."""
        return _NUMBER_BYTES


@dataclass(frozen=True)
class Flag:
    """True or false."""

    def check(self, value: Any) -> bool:
        """See :meth:`Rule.check`."""
        if type(value) is not bool:
            raise ValueError(f"expected true or false, got {type(value).__name__}")
        return value

    @property
    def wire_bytes(self) -> int:
        """See :attr:`Rule.wire_bytes`."""
        return 1


@dataclass(frozen=True)
class Text:
    """Text of at most ``longest`` characters that UTF-8 can carry."""

    longest: int = 2000

    def check(self, value: Any) -> str:
        """See :meth:`Rule.check`."""
        if type(value) is not str:
            raise ValueError(f"expected text, got {type(value).__name__}")
        if len(value) > self.longest:
            raise ValueError(f"text of {len(value)} characters, at most {self.longest} allowed")
        return value

    @property
    def wire_bytes(self) -> int:
        """See :attr:`Rule.wire_bytes`."""
        return _HEAD_BYTES + _CHARACTER_BYTES * self.longest


@dataclass(frozen=True)
class Choice:
    """One of a few words."""

    words: tuple[str, ...]

    def check(self, value: Any) -> str:
        """See :meth:`Rule.check`."""
        if type(value) is not str or value not in self.words:
            raise ValueError(f"expected one of {', '.join(self.words)}")
        return value

    @property
    def wire_bytes(self) -> int:
        """See :attr:`Rule.wire_bytes`."""
        return _HEAD_BYTES + _CHARACTER_BYTES * max(map(len, self.words))


@dataclass(frozen=True)
class Vector:
    """Finite floats, each within [-limit, limit].

    Exactly ``length`` of them; or, with ``rows``, any whole number of rows up to that many.
    ``names`` of the numbers (of a row) are for JSON, where an array without names stays one.
    """

    length: int
    limit: float = 1e6
    rows: int | None = None
    names: tuple[str, ...] = ()

    def check(self, value: Any) -> tuple[float, ...]:
        """See :meth:`Rule.check`."""
        if type(value) is not list:
            raise ValueError(f"expected an array, got {type(value).__name__}")
        count = len(value)
        if self.rows is None:
            if count != self.length:
                raise ValueError(f"expected {self.length} numbers, got {count}")
        elif count % self.length or count > self.rows * self.length:
            raise ValueError(f"{count} numbers are not up to {self.rows} rows of {self.length}")
        limit = self.limit
        for number in value:
            if type(number) is not float or not -limit <= number <= limit:
                raise ValueError(f"{number!r:.40} is not a float within ±{limit:g}")
        return tuple(value)

    @property
    def most(self) -> int:
        """Most numbers."""
        return self.length if self.rows is None else self.length * self.rows

    @property
    def wire_bytes(self) -> int:
        """See :attr:`Rule.wire_bytes`."""
        return _HEAD_BYTES + _NUMBER_BYTES * self.most


@dataclass(frozen=True)
class Scalars:
    """Flat map from short names to single values."""

    most: int = 200
    characters: int = 20_000
    """Most characters of all names and texts together."""

    def check(self, value: Any) -> Mapping[str, Scalar]:
        """See :meth:`Rule.check`."""
        if type(value) is not dict:
            raise ValueError(f"expected a map, got {type(value).__name__}")
        if len(value) > self.most:
            raise ValueError(f"{len(value)} entries, at most {self.most} allowed")
        characters = 0
        for name, scalar in value.items():
            if type(name) is not str or len(name) > 100:
                raise ValueError("a name in the map is not text of at most 100 characters")
            characters += len(name) + _check_scalar(name, scalar)
        if characters > self.characters:
            raise ValueError(f"{characters} characters, at most {self.characters} allowed")
        return MappingProxyType(value)

    @property
    def wire_bytes(self) -> int:
        """See :attr:`Rule.wire_bytes`."""
        return (
            _HEAD_BYTES
            + self.most * (_HEAD_BYTES + _NUMBER_BYTES)
            + _CHARACTER_BYTES * self.characters
        )


def _check_scalar(name: str, value: Any) -> int:
    """Refuses what is no scalar; the number of characters, 0 unless it is a text."""
    kind = type(value)
    if kind is bool:
        return 0
    if kind is int:
        if not -_INT64_MAX <= value <= _INT64_MAX:
            raise ValueError(f"{name!r:.40} is an integer beyond 64 bits")
        return 0
    if kind is float:
        if not -_REAL_MAX <= value <= _REAL_MAX:
            raise ValueError(f"{name!r:.40} is not a finite number of sensible size")
        return 0
    if kind is not str or len(value) > 2000:
        raise ValueError(f"{name!r:.40} is neither a number nor a short text")
    return len(value)
