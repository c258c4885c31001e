"""Rules for the fields of messages: one small class for each kind of value.

A rule's ``check`` returns the value as the message keeps it, or raises ``ValueError`` with what is
wrong; the codec adds the names of message and field. Comparisons are written so that NaN fails
them. :func:`meta` puts a rule into the annotation of a field, where msgspec finds as much of it as
it can check by itself, and :func:`rules_of` finds the whole. :func:`wire_bytes` is the size of a
rule's largest value in msgpack's widest form: the codec refuses longer input unread.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, get_args, get_type_hints

from msgspec import Meta

__all__ = [
    "Choice", "Flag", "Integer", "Real", "Rule", "Scalar", "Scalars", "Text", "Vector",
    "meta", "rules_of", "wire_bytes",
]  # fmt: skip

Scalar = bool | int | float | str
"""Value in the data map of an event or a reply."""

_INT64_MAX = 2**63 - 1
_REAL_MAX = 1e12
_TEXT_MAX = 2000

_NUMBER_BYTES = 9
_HEAD_BYTES = 5
"""Before the content of a text, array or map."""
_CHARACTER_BYTES = 4


@dataclass(frozen=True)
class Integer:
    """Whole number within [low, high]; bool is not one."""

    low: int = 0
    high: int = _INT64_MAX

    def check(self, value: Any) -> int:
        """The number; ValueError if it is of another type or outside the range."""
        if type(value) is int and self.low <= value <= self.high:
            return value
        raise ValueError(f"{value!r:.40} is not an integer within [{self.low}, {self.high}]")


@dataclass(frozen=True)
class Real:
    """Finite float within [low, high]; an integer on the wire is not one."""

    low: float = -_REAL_MAX
    high: float = _REAL_MAX

    def check(self, value: Any) -> float:
        """The number; ValueError if it is of another type or outside the range."""
        if type(value) is float and self.low <= value <= self.high:
            return value
        raise ValueError(f"{value!r:.40} is not a float within [{self.low:g}, {self.high:g}]")


@dataclass(frozen=True)
class Flag:
    """True or false."""

    def check(self, value: Any) -> bool:
        """The flag; ValueError if it is of another type."""
        if type(value) is bool:
            return value
        raise ValueError(f"{value!r:.40} is not true or false")


@dataclass(frozen=True)
class Text:
    """UTF-8 text of at most ``longest`` characters."""

    longest: int = _TEXT_MAX

    def check(self, value: Any) -> str:
        """The text; ValueError if it is of another type or too long."""
        if type(value) is str and len(value) <= self.longest:
            return value
        raise ValueError(f"{value!r:.40} is not text of at most {self.longest} characters")


@dataclass(frozen=True)
class Choice:
    """One of a few words."""

    words: tuple[str, ...]

    def check(self, value: Any) -> str:
        """The word; ValueError if it is none of them."""
        if type(value) is str and value in self.words:
            return value
        raise ValueError(f"{value!r:.40} is not one of {', '.join(self.words)}")


@dataclass(frozen=True)
class Vector:
    """Finite floats, each within [-limit, limit].

    Exactly ``length`` of them; or, with ``rows``, any whole number of rows up to that many.
    ``names`` of the numbers (of a row) are for JSON, where an array without names stays one.
    ``limit`` comes from the numbers' own annotation, whose range must be symmetric.
    """

    length: int
    rows: int | None = None
    names: tuple[str, ...] = ()
    limit: float = math.nan

    def check(self, value: Any) -> tuple[float, ...]:
        """The numbers; ValueError if one is no float in range, or their count is wrong."""
        if type(value) is not list:
            raise ValueError(f"{value!r:.40} is not an array")
        count, length = len(value), self.length
        if count != length and (self.rows is None or count % length or count > self.most):
            shape = "" if self.rows is None else f"up to {self.rows} rows of "
            raise ValueError(f"{count} numbers are not {shape}{length}")
        limit = self.limit
        for number in value:
            if type(number) is not float or not -limit <= number <= limit:
                raise ValueError(f"{number!r:.40} is not a float within ±{limit:g}")
        return tuple(value)

    @property
    def most(self) -> int:
        """Most numbers."""
        return self.length if self.rows is None else self.length * self.rows


@dataclass(frozen=True)
class Scalars:
    """Flat map from short names to single values."""

    most: int = 200
    characters: int = 20_000
    """Most characters of all names and texts together."""

    def check(self, value: Any) -> Mapping[str, Scalar]:
        """The map, read-only; ValueError if it is too large or holds something else."""
        if type(value) is not dict or len(value) > self.most:
            raise ValueError(f"{value!r:.40} is not a map of at most {self.most} entries")
        characters = 0
        for name, scalar in value.items():
            if type(name) is not str or len(name) > 100:
                raise ValueError("a name in the map is not text of at most 100 characters")
            if not _is_scalar(scalar):
                raise ValueError(
                    f"{name!r:.40} is not a flag, an integer of 64 bits, a float within "
                    f"±{_REAL_MAX:g} or a text of at most {_TEXT_MAX} characters"
                )
            characters += len(name) + (len(scalar) if type(scalar) is str else 0)
        if characters > self.characters:
            raise ValueError(f"{characters} characters, at most {self.characters} allowed")
        return MappingProxyType(value)


def _is_scalar(value: Any) -> bool:
    kind = type(value)
    if kind is str:
        return len(value) <= _TEXT_MAX
    if kind is int or kind is float:
        return bool(abs(value) <= (_INT64_MAX if kind is int else _REAL_MAX))
    return kind is bool


Rule = Integer | Real | Flag | Text | Choice | Vector | Scalars


def meta(rule: Rule) -> Meta:
    """The rule for a field's annotation, ``Annotated[type, meta(rule)]``.

    msgspec itself checks ranges of numbers and lengths of texts and vectors.
    """
    extra = {"rule": rule}
    match rule:
        case Integer(low, high) | Real(low, high):
            return Meta(ge=low, le=high, extra=extra)
        case Text(longest):
            return Meta(max_length=longest, extra=extra)
        case Vector(length, rows):
            return Meta(min_length=0 if rows else length, max_length=rule.most, extra=extra)
    return Meta(extra=extra)


def rules_of(kind: type) -> dict[str, Rule]:
    """The rules of a class's fields, by name; TypeError if a field has none."""
    hints = get_type_hints(kind, include_extras=True)
    return {name: _rule(f"{kind.__name__}.{name}", hint) for name, hint in hints.items()}


def _rule(name: str, hint: Any) -> Rule:
    value, *annotations = get_args(hint) or [hint]
    rules = [one.extra["rule"] for one in annotations if isinstance(one, Meta) and one.extra]
    if not rules:
        raise TypeError(f"{name} has no rule: Annotated[type, meta(rule)]")
    rule: Rule = rules[0]
    return _limited(name, rule, get_args(value)[0]) if isinstance(rule, Vector) else rule


def _limited(name: str, rule: Vector, number_hint: Any) -> Vector:
    """The rule with the limit of the numbers' annotation, the only place to state it."""
    number = _rule(f"a number of {name}", number_hint)
    if not (isinstance(number, Real) and number.low == -number.high and math.isnan(rule.limit)):
        raise TypeError(f"{name}: annotate its numbers with meta(Real(-limit, limit))")
    return replace(rule, limit=number.high)


def wire_bytes(rule: Rule) -> int:
    """Most bytes that an acceptable value takes."""
    match rule:
        case Integer() | Real():
            return _NUMBER_BYTES
        case Flag():
            return 1
        case Text(longest):
            return _HEAD_BYTES + _CHARACTER_BYTES * longest
        case Choice(words):
            return _HEAD_BYTES + _CHARACTER_BYTES * max(map(len, words))
        case Vector():
            return _HEAD_BYTES + _NUMBER_BYTES * rule.most
        case Scalars(most, characters):
            entries = most * (_HEAD_BYTES + _NUMBER_BYTES)
            return _HEAD_BYTES + entries + _CHARACTER_BYTES * characters
