"""The decoders' promise under fire: anything is decoded to something valid or is an InputError.

Here are other values in every place, and what asks for memory; test_messages.py and
test_gp_weights.py have damaged bytes.
"""

import json
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bayesrace.errors import InputError
from bayesrace.gp.weights import decode_weights, encode_weights
from bayesrace.messages import (
    LARGEST_BYTES,
    Message,
    decode,
    decode_json,
    encode,
    json_schema,
    to_json,
)
from tests.test_gp_weights import BODY, make_weights, reseal
from tests.test_messages import KINDS, conforms, messages

SCHEMAS = {kind: json_schema(kind) for kind in KINDS}


def check_message(kind: type[Message], data: bytes) -> str:
    """Decodes; what is wrong with the result, or InputError."""
    message = decode(kind, data)
    text = to_json(message)
    if not conforms(json.loads(text), SCHEMAS[kind]):
        return f"not as its schema says: {text[:500]!r}"
    both = decode(kind, encode(message)), decode_json(kind, text)
    return "" if both == (message, message) else "another message after encoding it again"


def check_weights(data: bytes) -> str:
    """Decodes; what is wrong with the result, or InputError."""
    weights = decode_weights(data)
    for output in weights.outputs:
        scalars = output.signal_variance, output.noise_variance, output.y_mean, output.y_scale
        numbers = np.concatenate(
            [output.length_scales, output.inputs.ravel(), output.alpha, scalars]
        )
        if not np.isfinite(numbers).all() or output.inputs.shape != (output.count, 6):
            return "numbers that are not finite, or too few"
    again = decode_weights(encode_weights(weights))
    return "" if again == weights else "others after encoding them again"


scalars = st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text()
names = st.text(max_size=3)
anything = st.recursive(
    scalars | st.binary() | st.just(msgpack.ExtType(1, b"x")),
    lambda part: st.lists(part, max_size=3) | st.dictionaries(names, part, max_size=3),
    max_leaves=8,
)


def places(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Each map or list within, with each of its keys or indices."""
    for key in list(tree) if isinstance(tree, dict) else range(len(tree)):
        yield tree, key
        if isinstance(tree[key], dict | list):
            yield from places(tree[key])


def edit(tree: Any, data: st.DataObject) -> bytes:
    """Packed with something else, or nothing, in one to three places."""
    for _ in range(data.draw(st.integers(1, 3))):
        container, key = data.draw(st.sampled_from(list(places(tree))))
        if data.draw(st.booleans()) or isinstance(container, list):
            container[key] = data.draw(anything)
        else:
            container[data.draw(st.text(max_size=5))] = container.pop(key)
    packed: bytes = msgpack.packb(tree)
    return packed


@settings(max_examples=1500, deadline=None)
@given(message=messages(), data=st.data())
def test_messages_with_other_values_are_valid_or_refused(
    message: Message, data: st.DataObject
) -> None:
    with suppress(InputError):
        assert check_message(type(message), edit(msgpack.unpackb(encode(message)), data)) == ""


@settings(max_examples=500, deadline=None)
@given(count=st.integers(0, 3), data=st.data())
def test_weights_with_other_values_are_valid_or_refused(count: int, data: st.DataObject) -> None:
    """Under a checksum that fits."""
    good = encode_weights(make_weights(count))
    body = edit(msgpack.unpackb(good[BODY:]), data)
    with suppress(InputError):
        assert check_weights(reseal(good[:BODY] + body)) == ""


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


def peak_bytes(decoder: Callable[[bytes], object], data: bytes) -> int:
    """Python memory that refusing these bytes takes."""
    tracemalloc.start()
    try:
        with pytest.raises(InputError):
            decoder(data)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("name", bombs(100))
def test_what_promises_more_than_it_holds_costs_no_memory(name: str) -> None:
    """Nonsense as long as a message may be, read; and far longer, which is not read at all."""
    whole, twice = bombs(LARGEST_BYTES)[name], bombs(2 * LARGEST_BYTES)[name]
    for kind in KINDS:
        assert peak_bytes(partial(decode, kind), whole) < 2 * LARGEST_BYTES
        assert peak_bytes(partial(decode, kind), twice) < 10_000


@pytest.mark.parametrize("name", bombs(100))
def test_weights_that_promise_more_than_they_hold_cost_little_memory(name: str) -> None:
    """A checksum is no protection: an attacker who makes the bytes makes it too."""
    size = 4_000_000
    data = reseal(encode_weights(make_weights())[:BODY] + bombs(size)[name])
    assert peak_bytes(decode_weights, data) < 5 * size
