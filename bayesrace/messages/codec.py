"""Bytes to messages and back: msgpack maps with a schema version, refused unless exactly right.

Nothing here executes what it reads. :func:`decode` either returns a message whose every field has
passed its rule or raises :class:`InputError`; no other exception and no non-finite value gets past.
What is longer than the longest valid message of its kind is not read at all, so nonsense costs no
more time and memory than sense.
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
from bayesrace.messages.rules import Integer, Rule, Scalars, Text, Vector
from bayesrace.messages.types import Message

__all__ = [
    "LARGEST_BYTES",
    "Decoder",
    "decode",
    "encode",
    "largest_bytes",
    "peek_seq",
]

M = TypeVar("M", bound=Message)

LARGEST_BYTES: Final = 1 << 17
"""No valid message of any kind is longer; each has its own limit, :func:`largest_bytes`."""

_NAME_HEAD_BYTES: Final = 5
_UNKNOWN_NAMES: Final = 20
"""More fields than a message has are still read, to be named in the refusal."""

_MALFORMED: Final = (ValueError, TypeError, OverflowError, msgpack.UnpackException)


@dataclass(frozen=True)
class _Spec:
    """A message class prepared for fast coding."""

    names: tuple[str, ...]
    keys: frozenset[str]
    values_of: Callable[[Any], tuple[Any, ...]]
    checks: tuple[tuple[str, Callable[[Any], Any]], ...]
    rules: tuple[tuple[str, Rule], ...]
    wire_bytes: int
    """Most bytes of a valid message."""
    unpack: Callable[[bytes], Any]


_SPECS: dict[type[Message], _Spec] = {}


def _spec(kind: type[Message]) -> _Spec:
    spec = _SPECS.get(kind)
    if spec is None:
        hints = get_type_hints(kind, include_extras=True)
        names = tuple(field.name for field in fields(kind))
        rules = tuple((name, get_args(hints[name])[1]) for name in names)
        checks = tuple((name, rule.check) for name, rule in rules)
        keys = frozenset(("schema", *names))
        spec = _SPECS[kind] = _Spec(
            names, keys, attrgetter(*names), checks, rules, _wire_bytes(rules), _unpacker(rules)
        )
    return spec


def _wire_bytes(rules: tuple[tuple[str, Rule], ...]) -> int:
    """Most bytes of a map of these fields and the schema version."""
    fields_and_schema = (("schema", Integer()), *rules)
    entries = (_NAME_HEAD_BYTES + len(name) + rule.wire_bytes for name, rule in fields_and_schema)
    return _NAME_HEAD_BYTES + sum(entries)


def _unpacker(rules: tuple[tuple[str, Rule], ...]) -> Callable[[bytes], Any]:
    """msgpack's reader with the limits of these fields; it does not even begin a larger thing."""
    only = [rule for _, rule in rules]
    return partial(
        msgpack.unpackb,
        object_pairs_hook=_distinct,
        max_array_len=max((rule.most for rule in only if isinstance(rule, Vector)), default=0),
        max_map_len=max(
            [len(rules) + _UNKNOWN_NAMES, *(r.most for r in only if isinstance(r, Scalars))]
        ),
        max_str_len=max(
            (rule.wire_bytes for rule in only if isinstance(rule, Text | Scalars)), default=100
        ),
        max_bin_len=0,
        max_ext_len=0,
    )


def _plain(value: Any) -> Any:
    """msgpack's fallback: read-only maps become maps; anything else is a programming error."""
    if hasattr(value, "items"):
        return dict(value)
    raise TypeError(f"a {type(value).__name__} cannot be part of a message")


def _distinct(pairs: list[tuple[Any, Any]]) -> dict[Any, Any]:
    mapping = dict(pairs)
    if len(mapping) != len(pairs):
        raise ValueError("a name occurs twice")
    return mapping


def encode(message: Message) -> bytes:
    """The message as a msgpack map, fields in the order of the dataclass after ``schema``."""
    spec = _spec(type(message))
    content: dict[str, Any] = {"schema": message.SCHEMA}
    content.update(zip(spec.names, spec.values_of(message), strict=True))
    packed: bytes = msgpack.packb(content, default=_plain)
    return packed


def decode(kind: type[M], data: bytes) -> M:
    """The message of class ``kind`` in ``data``.

    Raises InputError for anything but exactly one such message: other bytes, another schema
    version, a missing, repeated or unknown field, a value of another type, length or range.
    """
    spec = _spec(kind)
    if len(data) > spec.wire_bytes:
        raise InputError(f"{kind.__name__}: {len(data)} bytes, at most {spec.wire_bytes} allowed")
    try:
        content = spec.unpack(data)
    except _MALFORMED as error:
        raise InputError(f"{kind.__name__}: not a message ({error or 'malformed'})") from None
    if type(content) is not dict or content.keys() != spec.keys:
        raise InputError(f"{kind.__name__}: not a map of exactly its fields{_odd(content, spec)}")
    version = content["schema"]
    if type(version) is not int or version != kind.SCHEMA:
        raise InputError(
            f"{kind.__name__}: schema version {version!r:.40}, this program reads "
            f"{kind.SCHEMA}; use the same release on both sides"
        )
    try:
        return kind(*[check(content[name]) for name, check in spec.checks])
    except ValueError:
        raise _explained(kind, content, spec) from None


def largest_bytes(kind: type[Message]) -> int:
    """Most bytes of a valid message of class ``kind``; longer input is refused unread."""
    return _spec(kind).wire_bytes


def _odd(content: Any, spec: _Spec) -> str:
    if type(content) is not dict:
        return ""
    odd = sorted(repr(name)[:40] for name in content.keys() ^ spec.keys)
    return f"; missing or unknown: {', '.join(odd[:5])}"


def _explained(kind: type[Message], content: dict[str, Any], spec: _Spec) -> InputError:
    """Finds the first bad field again; off the fast path."""
    for name, check in spec.checks:
        try:
            check(content[name])
        except ValueError as error:
            return InputError(f"{kind.__name__}.{name}: {error}")
    raise AssertionError("unreachable: a rule failed once and then did not")


class Decoder(Generic[M]):
    """Decodes one stream; what is refused is counted, logged at a limited rate and dropped.

    With ``logger=None`` it only counts and keeps the last reason, for threads that must not do
    input or output.
    """

    def __init__(
        self, kind: type[M], logger: logging.Logger | None = None, log_period_s: float = 1.0
    ) -> None:
        self.kind = kind
        self.accepted = 0
        self.refused = 0
        self.last_reason = ""
        self._logger = logger
        self._period_ns = int(log_period_s * 1e9)
        self._quiet_until_ns = 0
        self._logged = 0

    def __call__(self, data: bytes) -> M | None:
        """The message, or None if it was refused."""
        try:
            message = decode(self.kind, data)
        except InputError as error:
            self.refused += 1
            self.last_reason = str(error)
            if self._logger is not None:
                self.report(self._logger)
            return None
        self.accepted += 1
        return message

    def report(self, logger: logging.Logger) -> None:
        """Log what was refused since the last time, unless that was just now."""
        now_ns = time.monotonic_ns()
        if now_ns < self._quiet_until_ns or self.refused == self._logged:
            return
        logger.warning(
            "refused %d message(s), the last: %s", self.refused - self._logged, self.last_reason
        )
        self._logged = self.refused
        self._quiet_until_ns = now_ns + self._period_ns


def peek_seq(data: bytes) -> int | None:
    """The ``seq`` of an encoded message without decoding it, for who only counts; None if odd.

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
