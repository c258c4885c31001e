"""Bytes to messages and back: msgpack maps with a schema version, refused unless exactly right.

Nothing here executes what it reads. :func:`decode` returns a message whose every field has passed
its rule, or raises :class:`InputError`, and nothing else. Input longer than the longest valid
message of its class is refused unread, so invalid input costs no more time and memory than valid.
"""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import partial
from operator import attrgetter
from typing import Any, Final, Generic, TypeVar, get_args, get_type_hints

import msgpack

from bayesrace.errors import InputError
from bayesrace.messages.rules import Integer, Rule, Scalars, Text, Vector, wire_bytes
from bayesrace.messages.types import Message

__all__ = ["Decoder", "checked", "decode", "encode", "largest_bytes", "peek_seq"]

M = TypeVar("M", bound=Message)

_NAME_HEAD_BYTES: Final = 5
_UNKNOWN_NAMES: Final = 20
"""More fields than a message has are still read, to be named in the refusal."""

_LOG_PERIOD_NS: Final = 1_000_000_000
"""Between two lines of a decoder in the log."""

_MALFORMED: Final = (ValueError, TypeError, OverflowError, msgpack.UnpackException)


@dataclass(frozen=True)
class _Spec:
    """A message class prepared for fast coding."""

    rules: dict[str, Rule]
    names: tuple[str, ...]
    """Names on the wire, in their order: ``schema`` and the fields."""
    keys: frozenset[str]
    values_of: Callable[[Any], tuple[Any, ...]]
    """Their values in a message."""
    checks: tuple[tuple[str, Callable[[Any], Any]], ...]
    wire_bytes: int
    """Most bytes of a valid message."""
    unpack: Callable[[bytes], Any]
    """msgpack's reader, with limits so that it does not begin to read a larger value."""


class _Specs(dict[type[Message], _Spec]):
    """Makes the specification of a class at its first use."""

    def __missing__(self, kind: type[Message]) -> _Spec:
        hints = get_type_hints(kind, include_extras=True)
        rules: dict[str, Rule] = {one.name: get_args(hints[one.name])[1] for one in fields(kind)}
        content = {"schema": Integer(), **rules}
        sizes = (_NAME_HEAD_BYTES + len(name) + wire_bytes(rule) for name, rule in content.items())
        arrays = [rule.most for rule in rules.values() if isinstance(rule, Vector)]
        maps = [rule.most for rule in rules.values() if isinstance(rule, Scalars)]
        texts = [wire_bytes(rule) for rule in rules.values() if isinstance(rule, Text | Scalars)]
        unpack = partial(
            msgpack.unpackb,
            object_pairs_hook=_distinct,
            max_array_len=max(arrays, default=0),
            max_map_len=max([len(rules) + _UNKNOWN_NAMES, *maps]),
            max_str_len=max(texts, default=100),
            max_bin_len=0,
            max_ext_len=0,
        )
        checks = tuple((name, rule.check) for name, rule in rules.items())
        values_of, limit = attrgetter("SCHEMA", *rules), _NAME_HEAD_BYTES + sum(sizes)
        self[kind] = spec = _Spec(
            rules, tuple(content), frozenset(content), values_of, checks, limit, unpack
        )
        return spec


_SPECS: Final = _Specs()


def _distinct(pairs: list[tuple[Any, Any]]) -> dict[Any, Any]:
    mapping = dict(pairs)
    if len(mapping) != len(pairs):
        raise ValueError("a name occurs twice")
    return mapping


def _plain(value: Any) -> Any:
    """msgpack's fallback: read-only maps become maps; anything else is a programming error."""
    if hasattr(value, "items"):
        return dict(value)
    raise TypeError(f"a {type(value).__name__} cannot be part of a message")


def encode(message: Message) -> bytes:
    """The message as a msgpack map, fields in the order of the dataclass after ``schema``."""
    spec = _SPECS[type(message)]
    content = dict(zip(spec.names, spec.values_of(message), strict=True))
    packed: bytes = msgpack.packb(content, default=_plain)
    return packed


def decode(kind: type[M], data: bytes) -> M:
    """The message of class ``kind`` in ``data``.

    Raises InputError for anything but exactly one such message: other bytes, another schema
    version, a missing, repeated or unknown field, a value of another type, length or range.
    """
    spec, title = _SPECS[kind], kind.__name__
    if len(data) > spec.wire_bytes:
        raise InputError(f"{title}: {len(data)} bytes, at most {spec.wire_bytes} allowed")
    try:
        content = spec.unpack(data)
    except _MALFORMED as error:
        raise InputError(f"{title}: not a message ({error or 'malformed'})") from None
    return checked(kind, content)


def checked(kind: type[M], content: Any) -> M:
    """The message of class ``kind`` with this content, a map of its fields and its schema version.

    Raises InputError for anything else.
    """
    spec, title = _SPECS[kind], kind.__name__
    if type(content) is not dict:
        raise InputError(f"{title}: not a message (no map)")
    version = content.get("schema", kind.SCHEMA)  # first: it explains other fields
    if type(version) is not int or version != kind.SCHEMA:
        raise InputError(
            f"{title}: schema version {version!r:.40}, this program reads "
            f"{kind.SCHEMA}; use the same release on both sides"
        )
    if content.keys() != spec.keys:
        odd = sorted(repr(name)[:40] for name in content.keys() ^ spec.keys)
        raise InputError(f"{title}: missing or unknown fields: {', '.join(odd[:5])}")
    values = {}
    for name, check in spec.checks:
        try:
            values[name] = check(content[name])
        except ValueError as error:
            raise InputError(f"{title}.{name}: {error}") from None
    return kind(**values)


def largest_bytes(kind: type[Message]) -> int:
    """Most bytes of a valid message of class ``kind``; longer input is refused unread."""
    return _SPECS[kind].wire_bytes


class Decoder(Generic[M]):
    """Decodes one topic; counts what it refuses, and logs that at a limited rate.

    With ``logger=None`` it only counts and keeps the last reason, for threads that must not do
    input or output.
    """

    def __init__(self, kind: type[M], logger: logging.Logger | None = None) -> None:
        self._kind = kind
        self.accepted = 0
        self.refused = 0
        self.last_reason = ""
        self._logger = logger
        self._next_log_ns = 0
        self._logged = 0

    def __call__(self, data: bytes) -> M | None:
        """The message, or None if it was refused."""
        try:
            message = decode(self._kind, data)
        except InputError as error:
            self.refused += 1
            self.last_reason = str(error)
            if self._logger is not None:
                self.report(self._logger)
            return None
        self.accepted += 1
        return message

    def report(self, logger: logging.Logger) -> None:
        """Log what was refused since the last report, unless that was just now."""
        now_ns, count = time.monotonic_ns(), self.refused - self._logged
        if count and now_ns >= self._next_log_ns:
            logger.warning("refused %d message(s), the last: %s", count, self.last_reason)
            self._logged, self._next_log_ns = self.refused, now_ns + _LOG_PERIOD_NS


def peek_seq(data: bytes) -> int | None:
    """The ``seq`` of an encoded message without decoding it, for counting; None if it has none.

    Looks where :func:`encode` puts it, so another encoder's field order gives None.
    """
    at = data.find(b"\xa3seq", 0, 24) + 4
    if at < 4 or at >= len(data):
        return None
    code = data[at]
    if code < 0x80:
        return code
    if not 0xCC <= code <= 0xCF:
        return None
    size = 1 << (code - 0xCC)
    number = data[at + 1 : at + 1 + size]
    return int.from_bytes(number, "big") if len(number) == size else None
