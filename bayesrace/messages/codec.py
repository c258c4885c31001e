"""Messages as bytes: MessagePack between processes, JSON in logs. msgspec reads and writes both.

Nothing here executes what it reads. :func:`decode` and :func:`decode_json` return a message whose
every field is of its type and within its limits, or raise :class:`InputError`, and nothing else.
What other encoders write differently is read as well: fields in another order, wider numbers, an
integer where a float belongs; of a field that occurs twice, the last counts.
"""

import logging
import threading
import time
from collections.abc import Callable
from functools import cache
from itertools import chain
from typing import Any, Final, Generic, TypeVar, cast

import msgspec
from msgspec import inspect

from bayesrace.errors import InputError
from bayesrace.messages.types import Message

__all__ = [
    "LARGEST_BYTES", "Decoder", "decode", "decode_json", "encode", "json_schema", "schema_version",
    "to_json",
]  # fmt: skip

M = TypeVar("M", bound=Message)

LARGEST_BYTES: Final = 1 << 17
"""Longer input is refused unread: no message is as long."""

_LOG_PERIOD_NS: Final = 1_000_000_000
"""Between two lines of a decoder in the log."""


def _plain(value: Any) -> Any:
    """NumPy's floats and texts as Python's; anything else is a programming error."""
    for kind in (float, int, str):
        if isinstance(value, kind):
            return kind(value)
    raise TypeError(f"a {type(value).__name__} cannot be part of a message")


_encode: Final = msgspec.msgpack.Encoder(enc_hook=_plain).encode
_encode_json: Final = msgspec.json.Encoder(enc_hook=_plain).encode
_decode_json: Final = msgspec.json.Decoder().decode


def encode(message: Message) -> bytes:
    """The message as a MessagePack map, fields in the order of the class after ``schema``."""
    return _encode(message)


_preparing: Final = threading.Lock()
"""msgspec 0.22 describes a class to itself at its first use. A thread that uses the class meanwhile
reads what is not there yet, and the process ends."""


@cache
def _reader(kind: type[Message]) -> Callable[[bytes], Any]:
    with _preparing:
        return msgspec.msgpack.Decoder(kind, strict=True).decode


def decode(kind: type[M], data: bytes) -> M:
    """The message of class ``kind`` in ``data``.

    Raises InputError for anything but one such message: other bytes, another schema version, a
    missing or unknown field, a value of another type, length or range.
    """
    if len(data) > LARGEST_BYTES:
        raise InputError(f"{kind.__name__}: {len(data)} bytes, at most {LARGEST_BYTES} allowed")
    try:
        return cast(M, _reader(kind)(data))
    except ValueError as error:
        raise _refusal(kind, error) from None


def _refusal(kind: type[Message], error: Exception) -> InputError:
    """What is wrong, in printable characters: it may name fields from outside."""
    reason = str(error) if isinstance(error, ValueError) else repr(error)
    reason = "".join(one if one.isprintable() else "?" for one in reason[:200])
    if reason.endswith("`$.schema`"):
        reason += (
            f"; this program reads schema version {schema_version(kind)}, use the same release on "
            "both sides"
        )
    return InputError(f"{kind.__name__}: {reason}")


def schema_version(kind: type[Message]) -> int:
    """The version of a class's fields."""
    return cast(int, kind.__struct_config__.tag)


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
            message = self._decoded(data)
        except InputError as error:
            self.refused += 1
            self.last_reason = str(error)
            if self._logger is not None:
                self.report(self._logger)
            return None
        self.accepted += 1
        return message

    def _decoded(self, data: bytes) -> M:
        return decode(self._kind, data)

    def report(self, logger: logging.Logger) -> None:
        """Log what was refused since the last report, unless that was just now."""
        now_ns, count = time.monotonic_ns(), self.refused - self._logged
        if count and now_ns >= self._next_log_ns:
            logger.warning("refused %d message(s), the last: %s", count, self.last_reason)
            self._logged, self._next_log_ns = self.refused, now_ns + _LOG_PERIOD_NS


@cache
def _named(kind: type[Message]) -> tuple[tuple[str, tuple[str, ...], bool], ...]:
    """Vectors whose numbers have names in JSON: field, names, whether it has rows of them."""
    described = cast(inspect.StructType, inspect.type_info(kind))
    return tuple(
        (field.name, field.type.extra["names"], cast(Any, field.type.type).min_length is None)
        for field in described.fields
        if isinstance(field.type, inspect.Metadata) and field.type.extra
    )


def to_json(message: Message) -> bytes:
    """The message in the form of :func:`json_schema`: the same fields, with names for the numbers
    of states and inputs; rows of them become columns. Floats keep their bits."""
    content = {"schema": schema_version(type(message)), **msgspec.structs.asdict(message)}
    for field, names, rows in _named(type(message)):
        numbers = content[field]
        columns = (numbers[i :: len(names)] for i in range(len(names))) if rows else numbers
        content[field] = dict(zip(names, columns, strict=True))
    return _encode_json(content)


def decode_json(kind: type[M], data: bytes) -> M:
    """The message of class ``kind`` whose JSON is ``data``, checked as :func:`decode` checks."""
    _reader(kind)
    try:
        content = _decode_json(data)
        for field, names, rows in _named(kind):
            columns = [content[field][name] for name in names]
            numbers = chain.from_iterable(zip(*columns, strict=True)) if rows else columns
            content[field] = list(numbers)
        return msgspec.convert(content, kind, strict=True)
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise _refusal(kind, error) from None


def json_schema(kind: type[Message]) -> dict[str, Any]:
    """JSON schema of a class of messages, in the subset that viewers such as Foxglove read:
    every value has one type, every object its properties."""
    known = msgspec.json.schema(kind)["$defs"]
    schema: dict[str, Any] = known[kind.__name__]
    schema["description"] = schema["description"].split("\n")[0]
    properties = schema["properties"]
    properties["schema"] = {"type": "integer", "const": schema_version(kind)}
    for one in properties.values():  # viewers read no references
        if reference := one.get("items", {}).get("$ref"):
            one["items"] = known[reference.rpartition("/")[2]]
    for field, names, rows in _named(kind):
        number, most = properties[field]["items"], properties[field]["maxItems"] // len(names)
        column = {"type": "array", "items": number, "maxItems": most}
        properties[field] = {
            "type": "object",
            "properties": dict.fromkeys(names, column if rows else number),
            "required": list(names),
            "additionalProperties": False,
        }
    return schema
