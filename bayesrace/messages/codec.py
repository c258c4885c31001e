"""Bytes to messages and back: msgpack maps with a schema version, refused unless exactly right.

Nothing here executes what it reads. :func:`decode` returns a message whose every field has passed
its rule, or raises :class:`InputError`, and nothing else. Input longer than the longest valid
message of its class is refused unread, so invalid input costs little more time and memory than the
longest valid one.

msgspec reads what :func:`encode` writes, a state in 1.6 us. It takes an integer for a float, and
knows neither rows nor maps of scalars; so what it has read counts only if it encodes to the same
bytes. All else, from other encoders or damaged, is read by msgpack and checked rule by rule, which
also says what is wrong.
"""

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, Generic, TypeVar, cast

import msgpack
import msgspec

from bayesrace.errors import InputError
from bayesrace.messages.rules import (
    Choice,
    Integer,
    Rule,
    Scalars,
    Text,
    Vector,
    rules_of,
    wire_bytes,
)
from bayesrace.messages.types import Message

__all__ = [
    "Decoder", "checked", "decode", "encode", "is_readable", "largest_bytes", "peek_seq",
    "schema_version",
]  # fmt: skip

M = TypeVar("M", bound=Message)

_NAME_HEAD_BYTES: Final = 5
_UNKNOWN_NAMES: Final = 20
"""More fields than a message has are still read, to be named in the refusal."""

_LOG_PERIOD_NS: Final = 1_000_000_000
"""Between two lines of a decoder in the log."""

_MALFORMED: Final = (ValueError, TypeError, OverflowError, msgpack.UnpackException)
"""What msgpack raises; msgspec's own errors are ValueErrors."""


@dataclass(frozen=True)
class _Spec:
    """A message class prepared for fast coding."""

    schema: int
    keys: frozenset[str]
    """Names on the wire: ``schema`` and the fields."""
    read: Callable[[bytes], Any] | None
    """msgspec's reader; None for a class with a rule of which it knows nothing."""
    rows: tuple[tuple[str, int], ...]
    """Vectors of rows, and the length of a row."""
    checks: tuple[tuple[str, Callable[[Any], Any]], ...]
    wire_bytes: int
    """Most bytes of a valid message."""
    unpack: Callable[[bytes], Any]
    """msgpack's reader, with limits so that it does not begin to read a larger value."""


class _Specs(dict[type[Message], _Spec]):
    """Makes the specification of a class at its first use."""

    def __missing__(self, kind: type[Message]) -> _Spec:
        rules = rules_of(kind)
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
        self[kind] = spec = _Spec(
            schema=schema_version(kind),
            keys=frozenset(content),
            read=msgspec.msgpack.Decoder(kind).decode if is_readable(rules) else None,
            rows=tuple((n, r.length) for n, r in rules.items() if isinstance(r, Vector) and r.rows),
            checks=tuple((name, rule.check) for name, rule in rules.items()),
            wire_bytes=_NAME_HEAD_BYTES + sum(sizes),
            unpack=unpack,
        )
        return spec


_SPECS: Final = _Specs()


def is_readable(rules: Mapping[str, Rule]) -> bool:
    """Whether msgspec checks all of these rules; of vectors of rows it checks the length alone."""
    return not any(isinstance(rule, Choice | Scalars) for rule in rules.values())


def _distinct(pairs: list[tuple[Any, Any]]) -> dict[Any, Any]:
    mapping = dict(pairs)
    if len(mapping) != len(pairs):
        raise ValueError("a name occurs twice")
    return mapping


def _plain(value: Any) -> Any:
    """msgspec's fallback: NumPy's floats become floats, read-only maps become maps; anything else
    is a programming error."""
    for kind in (float, int, str):
        if isinstance(value, kind):
            return kind(value)
    if hasattr(value, "items"):
        return dict(value)
    raise TypeError(f"a {type(value).__name__} cannot be part of a message")


_encode: Final = msgspec.msgpack.Encoder(enc_hook=_plain).encode


def encode(message: Message) -> bytes:
    """The message as a msgpack map, fields in the order of the class after ``schema``."""
    return _encode(message)


def schema_version(kind: type[Message]) -> int:
    """The version of a class's fields."""
    return cast(int, kind.__struct_config__.tag)


def decode(kind: type[M], data: bytes) -> M:
    """The message of class ``kind`` in ``data``.

    Raises InputError for anything but exactly one such message: other bytes, another schema
    version, a missing, repeated or unknown field, a value of another type, length or range.
    """
    spec, title = _SPECS[kind], kind.__name__
    if len(data) > spec.wire_bytes:
        raise InputError(f"{title}: {len(data)} bytes, at most {spec.wire_bytes} allowed")
    message: M | None = _read(spec, data)
    if message is not None:
        return message
    try:
        content = spec.unpack(data)
    except _MALFORMED as error:
        raise InputError(f"{title}: not a message ({error or 'malformed'})") from None
    return checked(kind, content)


def _read(spec: _Spec, data: bytes) -> Any:
    """The message, if the bytes are exactly those that :func:`encode` makes of one."""
    if spec.read is None:
        return None
    try:
        message = spec.read(data)
    except _MALFORMED:
        return None
    whole = all(len(getattr(message, name)) % length == 0 for name, length in spec.rows)
    return message if whole and _encode(message) == data else None


def checked(kind: type[M], content: Any) -> M:
    """The message of class ``kind`` with this content, a map of its fields and its schema version.

    Raises InputError for anything else.
    """
    spec, title = _SPECS[kind], kind.__name__
    if type(content) is not dict:
        raise InputError(f"{title}: not a message (no map)")
    version = content.get("schema", spec.schema)  # first: it explains other fields
    if type(version) is not int or version != spec.schema:
        raise InputError(
            f"{title}: schema version {version!r:.40}, this program reads "
            f"{spec.schema}; use the same release on both sides"
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
