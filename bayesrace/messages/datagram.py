"""Messages as datagrams: an array of a topic's name and the message.

So speak the controller in C (controller/host/br_wire.h) and what is connected to it. In a stream
each datagram follows its length (u32, big-endian).
"""

import struct
from collections.abc import Iterator
from typing import Any, Final

import msgspec

from bayesrace.errors import InputError
from bayesrace.messages.codec import LARGEST_BYTES, decode, encode
from bayesrace.messages.link import UPDATE, UPDATED, LinkTopic
from bayesrace.messages.table import SERVICES, TOPICS, Service, Topic
from bayesrace.messages.types import Message

__all__ = ["datagrams_in", "framed", "from_datagram", "head_of", "message_of", "to_datagram"]

Named = Topic[Any] | Service[Any, Any] | LinkTopic

_PAIR: Final = b"\x92"
_LENGTH: Final = struct.Struct(">I")
_ROWS: Final[tuple[Named, ...]] = (*SERVICES, *TOPICS, UPDATE, UPDATED)
_NAMED: Final = {one.name: one for one in _ROWS}
_read: Final = msgspec.msgpack.Decoder(tuple[str, msgspec.Raw]).decode


def message_of(named: Named) -> type[Message]:
    """The class of a topic's messages, or of a service's requests."""
    kind = named.request if isinstance(named, Service) else named.message
    if kind is None:
        raise InputError(f"'{named.name}' is a file, no message")
    return kind


def head_of(named: Named) -> bytes:
    """What a datagram of a topic or service begins with, before the message's bytes."""
    return _PAIR + msgspec.msgpack.encode(named.name)


def to_datagram(topic: Named, message: Message) -> bytes:
    """The datagram of a topic's message, or of a service's request."""
    return head_of(topic) + encode(message)


def from_datagram(data: bytes) -> tuple[Named, Message]:
    """Topic or service, and message, of a datagram; InputError for anything else."""
    try:
        name, payload = _read(data)
        topic = _NAMED[name]
    except (ValueError, KeyError, RecursionError) as error:
        raise InputError(f"no datagram of a topic: {error}") from None
    return topic, decode(message_of(topic), bytes(payload))


def framed(data: bytes) -> bytes:
    """A datagram as part of a stream."""
    return _LENGTH.pack(len(data)) + data


def datagrams_in(stream: bytes) -> Iterator[bytes]:
    """The datagrams of a whole stream; InputError if the last one is cut off."""
    at = 0
    while at < len(stream):
        begin = at + _LENGTH.size
        length = _LENGTH.unpack_from(stream, at)[0] if begin <= len(stream) else LARGEST_BYTES + 1
        at = begin + length
        if at > len(stream):
            raise InputError("the stream of datagrams is cut off")
        yield stream[begin:at]
