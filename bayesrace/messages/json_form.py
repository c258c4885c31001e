"""Messages as JSON, for logs that other tools read: the same fields, states and inputs by name.

Floats keep their bits. NaN and infinities, which no valid message holds, become the strings "NaN",
"Infinity" and "-Infinity".
"""

from collections.abc import Mapping
from contextlib import suppress
from itertools import chain
from typing import Any, Final, NamedTuple, TypeVar

import msgpack
import msgspec
import pydantic_core

from bayesrace.errors import InputError
from bayesrace.messages.codec import checked, is_readable, schema_version
from bayesrace.messages.rules import (
    Choice,
    Flag,
    Integer,
    Real,
    Rule,
    Scalars,
    Text,
    Vector,
    rules_of,
)
from bayesrace.messages.types import Message

__all__ = ["decode_json", "json_schema", "to_json"]

M = TypeVar("M", bound=Message)

_MALFORMED = (
    ValueError,
    TypeError,
    KeyError,
    OverflowError,
    RecursionError,
    msgpack.UnpackException,
)
_read: Final = msgspec.json.Decoder().decode


class _Form(NamedTuple):
    """A class of messages, prepared for fast conversion."""

    rules: Mapping[str, Rule]
    keys: frozenset[str]
    vectors: tuple[tuple[str, Vector], ...]
    reals: tuple[str, ...]
    readable: bool
    """msgspec checks all of its rules. Rows are whole if their columns are of one length."""


class _Forms(dict[type[Message], _Form]):
    """Prepares a class at its first use."""

    def __missing__(self, kind: type[Message]) -> _Form:
        rules = rules_of(kind)
        vectors = tuple((name, rule) for name, rule in rules.items() if isinstance(rule, Vector))
        reals = tuple(name for name, rule in rules.items() if isinstance(rule, Real))
        whole = all(one.names or one.rows is None or one.length == 1 for _, one in vectors)
        keys = frozenset(("schema", *rules))
        self[kind] = _Form(rules, keys, vectors, reals, whole and is_readable(rules))
        return self[kind]


_FORMS: Final = _Forms()


def to_json(kind: type[Message], data: bytes) -> bytes | None:
    """An encoded message of class ``kind`` in the form of :func:`json_schema`.

    None if the bytes are no map of its fields; the values are not checked.
    """
    form = _FORMS[kind]
    try:
        content = msgpack.unpackb(data)
        if type(content) is not dict or content.keys() != form.keys:
            return None
        for name, rule in form.vectors:
            content[name] = _named(rule, content[name])
        return pydantic_core.to_json(content, inf_nan_mode="strings")
    except _MALFORMED:
        return None


def decode_json(kind: type[M], data: bytes) -> M:
    """The message of class ``kind`` whose JSON is ``data``, checked as :func:`decode` checks.

    JSON does not distinguish 1 from 1.0: where a float belongs, an integer becomes one. InputError
    for anything but exactly one such message.
    """
    form = _FORMS[kind]
    try:
        content = _read(data)
        for name, rule in form.vectors:
            content[name] = _flat(rule, content[name])
        if form.readable and type(content) is dict and content.keys() == form.keys:
            with suppress(msgspec.ValidationError):  # the checks below say more about the fault
                return msgspec.convert(content, kind)
        for name in form.reals:
            content[name] = _float(content[name])
    except _MALFORMED as error:
        raise InputError(f"{kind.__name__}: not a message in JSON ({error!r:.100})") from None
    return checked(kind, content)


def _named(rule: Vector, value: Any) -> Any:
    """The numbers by name; columns of them, if there are rows."""
    if not rule.names:
        return value
    if rule.rows is None:
        return dict(zip(rule.names, value, strict=True))
    return {name: value[i :: rule.length] for i, name in enumerate(rule.names)}


def _flat(rule: Vector, value: Any) -> Any:
    if rule.names:
        columns = [value[name] for name in rule.names]
        several = rule.rows is not None
        value = list(chain.from_iterable(zip(*columns, strict=True))) if several else columns
    return [_float(number) for number in value] if int in map(type, value) else value


def _float(value: Any) -> Any:
    return float(value) if type(value) is int else value


def json_schema(kind: type[Message]) -> dict[str, Any]:
    """JSON schema of a class of messages, in the subset that viewers such as Foxglove read:
    every value has one type, every object its properties."""
    properties = {"schema": {"type": "integer", "const": schema_version(kind)}}
    properties |= {name: _schema(rule) for name, rule in _FORMS[kind].rules.items()}
    summary = (kind.__doc__ or "").split("\n")[0]
    return {"title": kind.__name__, "description": summary, **_object(properties)}


def _object(properties: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "type": "object", "properties": properties, "required": list(properties),
        "additionalProperties": False,
    }  # fmt: skip


def _schema(rule: Rule) -> dict[str, Any]:
    match rule:
        case Integer():
            return {"type": "integer", "minimum": rule.low, "maximum": rule.high}
        case Real():
            return {"type": "number", "minimum": rule.low, "maximum": rule.high}
        case Flag():
            return {"type": "boolean"}
        case Text():
            return {"type": "string", "maxLength": rule.longest}
        case Choice():
            return {"type": "string", "enum": list(rule.words)}
        case Scalars():
            return {"type": "object", "properties": {}, "maxProperties": rule.most}
        case Vector():
            number = {"type": "number", "minimum": -rule.limit, "maximum": rule.limit}
            size = {"minItems": 0 if rule.rows else rule.length, "maxItems": rule.most}
            if not rule.names:
                return {"type": "array", "items": number, **size}
            column = {"type": "array", "items": number, "maxItems": rule.rows}
            return _object(dict.fromkeys(rule.names, column if rule.rows else number))
    raise AssertionError(rule)
