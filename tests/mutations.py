"""Bytes that are nearly messages, for fuzzing the decoders: valid ones with something changed.

Plain random bytes end at the first check. These keep most of a message's structure, so that damage
gets as far as the field that it is in. Everything follows from the seed.
"""

import math
import random
from collections.abc import Callable, Iterator
from typing import Any, Final

import msgpack
from msgspec import inspect

from bayesrace.gp.weights import encode_weights
from bayesrace.messages import SERVICES, TOPICS, Message, schema_version
from tests.test_gp_weights import BODY, make_weights, reseal

__all__ = ["KINDS", "FRAGMENTS", "MessageMutator", "WeightsMutator", "bombs", "values"]

KINDS: Final[tuple[type[Message], ...]] = tuple(
    dict.fromkeys(
        kind
        for kind in (
            *(topic.message for topic in TOPICS),
            *(service.request for service in SERVICES),
            *(service.answer for service in SERVICES),
        )
        if kind is not None
    )
)
"""Every message of the table."""


def _nested(head: bytes, depth: int) -> bytes:
    return head * depth + b"\xc0"


_FLOATS: Final = (
    math.nan, -math.nan, math.inf, -math.inf, 0.0, -0.0, 5e-324, 1e308, 1.0, -1.0, 1e3, 1e6, 1e9,
    math.nextafter(1e3, 2e3), math.nextafter(1e6, 2e6), math.nextafter(1e12, 2e12), 1e12, 1e15,
)  # fmt: skip
_INTEGERS: Final = (
    0, 1, -1, 127, 128, 255, 256, 501, 2**31, 2**32, 2**53, 2**63 - 1, 2**63, 2**64 - 1, -(2**31),
    -(2**31) - 1, -(2**63),
)  # fmt: skip
_TEXTS: Final = (
    "", "a", "plant", "controller", "driving", "go", "x" * 200, "x" * 201, "x" * 2000, "x" * 2001,
    "\0", "\x1b[2J", "é" * 200, "😀" * 200, "nan",
)  # fmt: skip

FRAGMENTS: Final[tuple[bytes, ...]] = (
    *map(msgpack.packb, (*_FLOATS, *_INTEGERS, *_TEXTS)),
    b"\xc0", b"\xc1", b"\xc2", b"\xc3",
    # a float of 32 bits, and its NaN; integers wider than they need be
    b"\xca\x3f\x80\x00\x00", b"\xca\x7f\xc0\x00\x00", b"\xcc\x01", b"\xcd\x00\x01",
    b"\xce" + bytes(4), b"\xcf" + bytes(7) + b"\x02", b"\xd0\x01", b"\xd1\xff\xff",
    b"\xd2" + bytes(4), b"\xd3" + bytes(8),
    # text that is no UTF-8: cut short, overlong, surrogates
    b"\xa1\xff", b"\xa2\xc3\x28", b"\xa2\xc0\xaf", b"\xa3\xed\xa0\x80", b"\xd9\x01\xe2",
    # binary, extensions, time stamps
    b"\xc4\x03abc", b"\xc6\x00\x00\x00\x00", b"\xd4\x05\x00", b"\xc7\x00\x01",
    b"\xd6\xff" + bytes(4), b"\xd7\xff" + b"\xff" * 8, b"\xc7\x0c\xff" + b"\xff" * 12,
    # arrays and maps: empty, of the wrong things, with a name twice, with odd names
    b"\x90", b"\x80", b"\x91\x90", b"\x92\xcb\x7f\xf8" + bytes(6) + b"\xc0", b"\x81\xa1a\x80",
    b"\x82\xa1a\x01\xa1a\x02", b"\x81\x01\x01", b"\x81\xc0\x01", b"\x81\x90\x01",
    b"\x81\xc4\x01a\x01", b"\x81\xa1a\xcb\x7f\xf0" + bytes(6),
    b"\x81\xcb\x7f\xf8" + bytes(6) + b"\x01",
    # lengths that nothing follows
    b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xdb\xff\xff\xff\xff",
    b"\xc6\xff\xff\xff\xff", b"\xc9\xff\xff\xff\xff\x01", b"\xdc\xff\xff", b"\xde\xff\xff",
    b"\xda\xff\xff",
    # depth
    _nested(b"\x91", 10), _nested(b"\x91", 520), _nested(b"\x81\xa1a", 10), _nested(b"\x91", 1100),
    _nested(b"\x81\xa1a", 600), _nested(b"\xdc\x00\x40", 300),
)  # fmt: skip
"""Values in msgpack, most of them acceptable nowhere or only in some field."""

_HEADS: Final = (b"\xdd", b"\xdf", b"\xdb", b"\xc6", b"\xc9", b"\xc8", b"\xdc", b"\xde", b"\xda")

Segments = list[tuple[bytes, bytes]]
"""Name and value of each field as they are on the wire."""


def values(kind: type[Message], pick: random.Random) -> dict[str, Any]:
    """Valid values of a class's fields, by name, at their limits more often than by chance.

    AssertionError if a field has no limits: it would let NaN in, or texts without end.
    """
    described = inspect.type_info(kind)
    assert isinstance(described, inspect.StructType)
    return {field.name: _value(field.type, pick) for field in described.fields}


def _value(form: inspect.Type, pick: random.Random, row: int = 1) -> Any:
    match form:
        case inspect.Metadata(extra_json_schema={"enum": words}):
            return pick.choice(words)
        case inspect.Metadata(type=inner, extra=extra):
            return _value(inner, pick, len(extra["names"]) if extra else 1)
        case inspect.IntType(ge=int() as low, le=int() as high):
            return pick.choice((low, high, pick.randint(low, high)))
        case inspect.FloatType(ge=float() as low, le=float() as high):
            return pick.choice((low, high, max(low, -0.0), pick.uniform(low, high)))
        case inspect.BoolType():
            return pick.random() < 0.5
        case inspect.StrType(max_length=int() as most):
            return pick.choice(_TEXTS)[:most]
        case inspect.UnionType(types=kinds):
            return _value(pick.choice(kinds), pick)
        case inspect.DictType(value_type=content, max_length=int()):
            return {f"n{i}": _value(content, pick) for i in range(pick.randint(0, 7))}
        case inspect.VarTupleType(item_type=number, min_length=least, max_length=int()):
            count = least or row * pick.choice((0, 1, 3))
            return tuple(_value(number, pick) for _ in range(count))
    raise AssertionError(f"{form} without limits")


def _wide_map(count: int) -> bytes:
    return bytes([0x80 | count]) if count < 16 else b"\xde" + count.to_bytes(2, "big")


class _Damage:
    """Damage that knows nothing of what the bytes mean."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        self._ways: tuple[Callable[[bytearray], None], ...] = (
            self._flip, self._flip, self._flip, self._overwrite, self._cut, self._drop,
            self._repeat, self._length, self._length,
        )  # fmt: skip

    def __call__(self, data: bytes, times: int) -> bytes:
        damaged = bytearray(data)
        for _ in range(times):
            if damaged:
                self.random.choice(self._ways)(damaged)
        return bytes(damaged)

    def _at(self, data: bytearray) -> int:
        return int(self.random.random() * len(data))

    def _flip(self, data: bytearray) -> None:
        data[self._at(data)] ^= 1 << self.random.getrandbits(3)

    def _overwrite(self, data: bytearray) -> None:
        at, fragment = self._at(data), self.random.choice(FRAGMENTS)
        data[at : at + len(fragment)] = fragment

    def _cut(self, data: bytearray) -> None:
        del data[self._at(data) :]

    def _drop(self, data: bytearray) -> None:
        at = self._at(data)
        del data[at : at + 1 + self.random.getrandbits(4)]

    def _repeat(self, data: bytearray) -> None:
        at = self._at(data)
        data[at:at] = data[at : at + 1 + self.random.getrandbits(5)]

    def _length(self, data: bytearray) -> None:
        """A head that promises more, or less, than there is."""
        at, bits = self._at(data), self.random.choice((4, 8, 16, 32))
        length = self.random.getrandbits(bits).to_bytes(4, "big")
        data[at : at + 1] = self.random.choice(_HEADS) + length


class MessageMutator:
    """An endless supply of valid and of damaged messages."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self._damage = _Damage(seed + 1)
        self._pool = {kind: [self._segments(kind) for _ in range(40)] for kind in KINDS}
        self._edits: tuple[Callable[[Segments], None], ...] = (
            self._replace, self._replace, self._replace_part, self._replace_part, self._remove,
            self._double, self._swap, self._rename, self._graft, self._widen, self._widen,
        )  # fmt: skip

    def __call__(self, kind: type[Message]) -> bytes:
        """Bytes that begin as a message of that kind."""
        chance = self._random.random
        pool = self._pool[kind]
        if chance() < 0.02:
            pool[int(chance() * len(pool))] = self._segments(kind)
        segments = self._random.choice(pool)
        way = chance()
        if way < 0.55:
            segments = segments[:]
            for _ in range(1 + (chance() < 0.3)):
                self._random.choice(self._edits)(segments)
            data = self._join(segments)
            return self._damage(data, 1) if way < 0.1 else data
        if way < 0.9:
            return self._damage(self._join(segments), 1 + self._random.getrandbits(1))
        if way < 0.98:
            return self._spliced(segments)
        return self._random.randbytes(self._random.getrandbits(7))

    def valid(self, kind: type[Message]) -> bytes:
        """A message of that kind."""
        return self._join(self._segments(kind))

    def with_each_fragment(self, kind: type[Message]) -> Iterator[bytes]:
        """A message of that kind with one field replaced: each field by each fragment."""
        for at in range(len(kind.__struct_fields__) + 1):
            for fragment in FRAGMENTS:
                segments = self._segments(kind)
                segments[at] = (segments[at][0], fragment)
                yield self._join(segments)

    def _scalar(self) -> Any:
        pick = self._random
        return pick.choice((True, pick.getrandbits(62), pick.uniform(-1e12, 1e12), "text"))

    def _segments(self, kind: type[Message]) -> Segments:
        content = {"schema": schema_version(kind), **values(kind, self._random)}
        return [(msgpack.packb(name), msgpack.packb(value)) for name, value in content.items()]

    def _join(self, segments: Segments) -> bytes:
        body = b"".join(part for segment in segments for part in segment)
        return _wide_map(len(segments)) + body

    def _spliced(self, segments: Segments) -> bytes:
        """The beginning of one message and the end of another."""
        one = self._join(segments)
        two = self._join(self._random.choice(self._pool[self._random.choice(KINDS)]))
        return (
            one[: self._damage.random.randrange(len(one))] + two[self._random.randrange(len(two)) :]
        )

    def _index(self, segments: Segments) -> int:
        return int(self._random.random() * len(segments))

    def _replace(self, segments: Segments) -> None:
        at = self._index(segments)
        segments[at] = (segments[at][0], self._random.choice(FRAGMENTS))

    def _replace_part(self, segments: Segments) -> None:
        """Something else within a vector or map, or for any field if there is none."""
        at = self._index(segments)
        for i in range(len(segments)):
            name, value = segments[(at + i) % len(segments)]
            if value[0] & 0xF0 == 0x80:
                name_1, name_2 = self._random.choice((b"\xa1a", b"\xa1b")), b"\xa1a"
                fragment = self._random.choice(FRAGMENTS)
                value = b"\x82" + name_1 + fragment + name_2 + msgpack.packb(self._scalar())
                segments[(at + i) % len(segments)] = (name, value)
                return
            if len(value) > 9 and value[0] & 0xF0 == 0x90 and value[1] == 0xCB:
                start = 1 + 9 * int(self._random.random() * (value[0] & 0x0F))
                value = value[:start] + self._random.choice(FRAGMENTS) + value[start + 9 :]
                segments[(at + i) % len(segments)] = (name, value)
                return
        self._replace(segments)

    def _remove(self, segments: Segments) -> None:
        del segments[self._index(segments)]

    def _double(self, segments: Segments) -> None:
        segments.append(segments[self._index(segments)])

    def _swap(self, segments: Segments) -> None:
        """Two values change places; one time in two, with their names, which is allowed."""
        one, two = self._index(segments), self._index(segments)
        (name_1, value_1), (name_2, value_2) = segments[one], segments[two]
        if self._random.random() < 0.5:
            name_1, name_2 = name_2, name_1
        segments[one], segments[two] = (name_1, value_2), (name_2, value_1)

    def _rename(self, segments: Segments) -> None:
        at = self._index(segments)
        segments[at] = (self._random.choice(FRAGMENTS), segments[at][1])

    def _graft(self, segments: Segments) -> None:
        """A field of another message, added or in place of one."""
        other = self._random.choice(self._pool[self._random.choice(KINDS)])
        field = self._random.choice(other)
        at = self._index(segments)
        segments[at : at + self._random.getrandbits(1)] = [field]

    def _widen(self, segments: Segments) -> None:
        """The same message in other bytes, as another encoder might write it."""
        at = self._index(segments)
        name, value = segments[at]
        if value[0] < 0x80:
            value = b"\xd3" + value.rjust(8, b"\0")
        elif 0xA0 <= value[0] < 0xC0:
            value = b"\xdb" + bytes([0, 0, 0, value[0] & 0x1F]) + value[1:]
        elif value[0] & 0xF0 == 0x90:
            value = b"\xdd" + bytes([0, 0, 0, value[0] & 0x0F]) + value[1:]
        else:
            name = b"\xdb" + bytes([0, 0, 0, name[0] & 0x1F]) + name[1:]
        segments[at] = (name, value)


class WeightsMutator:
    """Damaged weights files, nearly all with a checksum that fits."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self._damage = _Damage(seed + 1)
        self._good = [encode_weights(make_weights(count)) for count in (0, 1, 3)]

    def __call__(self) -> bytes:
        """Bytes that begin as a weights file."""
        good = self._random.choice(self._good)
        way = self._random.random()
        if way < 0.05:
            return self._damage(good, 1)
        body = good[BODY:]
        if way < 0.6:
            tree = msgpack.unpackb(body)
            self._edit(tree)
            body = msgpack.packb(tree)
        if way > 0.5:
            body = self._damage(body, 1 + self._random.getrandbits(1))
        return reseal(good[:BODY] + body)

    def _edit(self, tree: Any) -> None:
        """Another value somewhere in the tree."""
        while True:
            keys = list(tree) if isinstance(tree, dict) else list(range(len(tree)))
            if not keys:
                return
            key = self._random.choice(keys)
            below = tree[key]
            if isinstance(below, dict | list) and self._random.random() < 0.9:
                tree = below
                continue
            way = self._random.random()
            if way < 0.1:
                del tree[key]
            elif way < 0.2 and isinstance(tree, dict):
                tree[self._random.choice((*_TEXTS, 0, b"x", None))] = below
            else:
                tree[key] = self._value()
            return

    def _value(self) -> Any:
        pick = self._random
        deep: Any = []
        for _ in range(30):
            deep = [deep]
        numbers = {"shape": [pick.getrandbits(2), 6], "f64le": pick.randbytes(48)}
        others: tuple[Any, ...] = (
            None,
            True,
            b"",
            b"\xff" * 48,
            msgpack.ExtType(1, b"x"),
            [],
            {},
            [1],
            deep,
            numbers,
        )
        return pick.choice((*others, *_FLOATS, *_INTEGERS[:-5], *_TEXTS))


def bombs(size: int) -> dict[str, bytes]:
    """Inputs of ``size`` bytes that ask for much more memory or time than that, by name."""
    fits = size.to_bytes(4, "big")
    names = b"".join(b"\xa6%06x\xc0" % i for i in range(size // 8))
    inputs = {
        "arrays in arrays": b"\x91" * size,
        "maps in maps": b"\x81\xa1a" * (size // 3),
        "arrays that promise as many items as there are bytes": (b"\xdd" + fits) * (size // 5),
        "maps that promise as many items as there are bytes": (b"\xdf" + fits + b"\xa0")
        * (size // 6),
        "an array of empty arrays": b"\xdd" + (size - 5).to_bytes(4, "big") + b"\x90" * size,
        "an array of empty maps": b"\xdd" + (size - 5).to_bytes(4, "big") + b"\x80" * size,
        "a map of many names": b"\xdf" + (size // 8).to_bytes(4, "big") + names,
        "a text without end": b"\xdb\xff\xff\xff\xff" + b"a" * size,
        "a text": b"\xdb" + (size - 5).to_bytes(4, "big") + b"a" * size,
        "binary without end": b"\xc6\xff\xff\xff\xff" + bytes(size),
        "an extension": b"\xc9" + (size - 6).to_bytes(4, "big") + bytes(size),
    }
    return {name: data[:size].ljust(size, b"\xc0") for name, data in inputs.items()}
