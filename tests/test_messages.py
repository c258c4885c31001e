"""The codec's promise: a message survives the wire unchanged, and nothing else gets through."""

import json
import logging
import math
import random
import subprocess
import sys
from typing import Any, Final

import msgpack
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from msgspec import inspect
from msgspec.structs import replace

from bayesrace.errors import InputError
from bayesrace.messages import (
    LARGEST_BYTES,
    RUN,
    SERVICES,
    STATUS,
    STOP,
    TOPICS,
    UPDATE,
    UPDATED,
    CarSample,
    Decoder,
    Event,
    Message,
    Reading,
    State,
    Telemetry,
    car_key,
    decode,
    decode_json,
    encode,
    json_schema,
    schema_version,
    to_json,
)
from tests.programs import ROOT

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

_TEXTS: Final = ("", "a", "go", "x" * 2001, "\0", "\x1b[2J", "é" * 200, "😀" * 200, "nan")
X0 = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 0.1)
STATE = State(
    seq=3,
    source_time_ns=10**9,
    epoch=8,
    run=1,
    time_s=0.5,
    x=X0,
    u_applied=(0.1, 0.2),
    lap=0,
    lockstep=True,
    actuation_delays=(2.0, 4e-4, 1e-3),
    final=False,
    estimated=True,
    readings=(Reading(instrument="pose", time_s=0.49, values={"x": (1.0, 1e-3)}),),
)
EVENT = Event(
    seq=0, source_time_ns=0, run=0, source="plant", kind="kind", text="text", data={"a": 1.0}
)


def values(kind: type[Message], pick: random.Random) -> dict[str, Any]:
    """Valid values of a class's fields, by name, at their limits more often than by chance.

    AssertionError if a field has no limits: it would let NaN in, or texts without end.
    """
    described = inspect.type_info(kind)
    assert isinstance(described, inspect.StructType)
    return {field.name: _value(field.type, pick) for field in described.fields}


def _value(form: inspect.Type, pick: random.Random, row: int = 1) -> Any:  # noqa: C901
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
        case inspect.DictType(
            key_type=inspect.Metadata(extra_json_schema={"enum": words}), value_type=content
        ):
            return {one: _value(content, pick) for one in pick.sample(words, 3)}
        case inspect.DictType(value_type=content, max_length=int()):
            return {f"n{i}": _value(content, pick) for i in range(pick.randint(0, 7))}
        case inspect.VarTupleType(item_type=number, min_length=least, max_length=int() as most):
            count = least or min(row * pick.choice((0, 1, 3)), most)
            return tuple(_value(number, pick) for _ in range(count))
        case inspect.TupleType(item_types=kinds):
            return tuple(_value(one, pick) for one in kinds)
        case inspect.StructType(cls=kind):
            return kind(**{one.name: _value(one.type, pick) for one in form.fields})
    raise AssertionError(f"{form} without limits")


@st.composite
def messages(draw: st.DrawFn) -> Message:
    kind = draw(st.sampled_from(KINDS))
    return kind(**values(kind, draw(st.randoms())))


@settings(deadline=None)
@given(messages())
def test_every_message_survives_the_wire(message: Message) -> None:
    data = encode(message)
    assert decode(type(message), data) == message
    # What msgspec writes is what msgpack would.
    fields = {name: getattr(message, name) for name in message.__struct_fields__}
    if readings := fields.get("readings"):
        names = Reading.__struct_fields__
        fields["readings"] = [{name: getattr(one, name) for name in names} for one in readings]
    assert data == msgpack.packb({"schema": schema_version(type(message)), **fields})


def test_numpys_floats_and_texts_are_written_as_pythons() -> None:
    """A control law or vehicle of one's own may return them."""
    odd = replace(STATE, time_s=np.float64(0.5), x=tuple(np.array(X0)))
    assert encode(odd) == encode(STATE)
    assert encode(EVENT) == encode(replace(EVENT, text=np.str_("text"), data={"a": np.float64(1)}))


@settings(deadline=None)
@given(st.sampled_from(KINDS), st.binary(max_size=300))
@example(State, b"")
@example(State, b"\xc1")
@example(Telemetry, b"\xdf\xff\xff\xff\xff")
@example(Telemetry, b"\x91" * 5000)
@example(Event, b"\xd6\xff\xff\xff\xff\xff")
def test_any_bytes_decode_or_are_refused(kind: type[Message], data: bytes) -> None:
    try:
        message = decode(kind, data)
    except InputError:
        return
    assert decode(kind, encode(message)) == message


@settings(max_examples=300, deadline=None)
@given(messages(), st.data())
def test_damaged_messages_decode_to_something_valid_or_are_refused(
    message: Message, data: st.DataObject
) -> None:
    """Bits flipped, parts cut: what still decodes is itself a valid, finite message."""
    damaged = bytearray(encode(message))
    for _ in range(data.draw(st.integers(1, 3))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] ^= data.draw(st.integers(1, 255))
    damaged = damaged[: data.draw(st.integers(0, len(damaged)))]
    try:
        survivor = decode(type(message), bytes(damaged))
    except InputError:
        return
    assert decode(type(message), encode(survivor)) == survivor


def test_every_kind_of_message_is_in_the_table() -> None:
    kinds = {k.__name__ for base in (Message, CarSample) for k in base.__subclasses__()}
    of_links = {one.message.__name__ for one in (UPDATE, UPDATED)}
    assert {k.__name__ for k in KINDS} == kinds - {"CarSample"} - of_links


def largest(form: inspect.Type, valid: Any) -> Any:
    """The value that takes most bytes; ``valid`` where the size is not in the type."""
    match form:
        case inspect.Metadata(type=inner):
            return largest(inner, valid)
        case inspect.StrType(max_length=int() as most):
            return "😀" * most
        case inspect.IntType():
            return valid if type(valid) is int else 1
        case inspect.StructType(cls=kind):
            return kind(**{one.name: largest(one.type, 0.0) for one in form.fields})
        case inspect.DictType(key_type=inspect.Metadata(extra_json_schema={"enum": words})):
            return dict.fromkeys(words, (1.0, 1.0))
        case inspect.DictType(key_type=key, value_type=inspect.StrType() as one, max_length=most):
            return {f"{i:02}{largest(key, '')[2:]}": largest(one, "") for i in range(most or 0)}
        case inspect.DictType():
            return {f"{i:04}": 2**63 - 1 for i in range(190)} | {
                str(i): "😀" * 2000 for i in range(9)
            }
        case inspect.VarTupleType(item_type=one, max_length=int() as most):
            return (largest(one, 1.0),) * most
    return valid


@pytest.mark.parametrize("kind", KINDS)
def test_the_largest_message_passes_and_what_is_larger_is_not_read(kind: type[Message]) -> None:
    described, valid = inspect.type_info(kind), values(kind, random.Random(0))
    assert isinstance(described, inspect.StructType)
    message = kind(**{one.name: largest(one.type, valid[one.name]) for one in described.fields})
    assert decode(kind, encode(message)) == message
    with pytest.raises(InputError, match=f"{LARGEST_BYTES + 1} bytes, at most {LARGEST_BYTES}"):
        decode(kind, bytes(LARGEST_BYTES + 1))


def _changed(message: Message, **changes: Any) -> bytes:
    content = msgpack.unpackb(encode(message)) | changes
    packed: bytes = msgpack.packb({k: v for k, v in content.items() if v is not Ellipsis})
    return packed


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"x": [math.nan] * 7}, "`float` >= -1000000.0 - at `$.x[0]`"),
        ({"x": [0.0, math.inf] + [0.0] * 5}, "`float` <= 1000000.0 - at `$.x[1]`"),
        ({"x": [0.0] * 6}, "`array` of length >= 7 - at `$.x`"),
        ({"x": "1234567"}, "`array`, got `str` - at `$.x`"),
        ({"actuation_delays": [0.0] * 4}, "actuation_delays: not whole rows of 3"),
        ({"actuation_delays": [0.0] * 195}, "`array` of length <= 192"),
        ({"seq": -1}, "`int` >= 0 - at `$.seq`"),
        ({"seq": True}, "`int`, got `bool` - at `$.seq`"),
        ({"seq": 1.0}, "`int`, got `float` - at `$.seq`"),
        ({"seq": 2**63}, "`int` <= 9223372036854775807 - at `$.seq`"),
        ({"time_s": math.nan}, "`float` >= 0.0 - at `$.time_s`"),
        ({"time_s": True}, "`float`, got `bool` - at `$.time_s`"),
        ({"lockstep": 1}, "`bool`, got `int` - at `$.lockstep`"),
        ({"schema": 1, "answers": ()}, "this program reads schema version 3, use the same release"),
        ({"schema": 1.0}, "schema version"),
        ({"extra\x1b[2J": 1}, "unknown field `extra?[2J`"),
        ({"lap": ...}, "missing required field `lap`"),
        ({"source": "nobody"}, "matching regex '^(?:plant|controller|race|recorder)"),
        ({"source": "plant\n"}, "matching regex"),
        ({"text": "x" * 2001}, "`str` of length <= 2000 - at `$.text`"),
        ({"data": {"a": math.nan}}, "`float` >= -1000000000000.0 - at `$.data[...]`"),
        ({"data": {"a\x1b[2J": -math.inf}}, "at `$.data[...]`"),
        ({"data": {"a": 2**64 - 1}}, "`int` <= 9223372036854775807 - at `$.data[...]`"),
        ({"data": {"a": {"b": 1}}}, "`bool | int | float | str`, got `object`"),
        ({"data": {"a": [1]}}, "`bool | int | float | str`, got `array`"),
        ({"data": {"a": "x" * 2001}}, "`str` of length <= 2000 - at `$.data[...]`"),
        ({"data": {"x" * 101: 1}}, "`str` of length <= 100 - at `key` in `$.data`"),
        ({"data": {f"n{i}": 1 for i in range(201)}}, "`object` of length <= 200 - at `$.data`"),
        ({"data": {f"n{i}": "x" * 2000 for i in range(100)}}, "bytes, at most 131072 allowed"),
    ],
)
def test_a_refusal_names_the_field_and_the_fault(changes: dict[str, Any], fault: str) -> None:
    """In printable characters: it may end on a terminal."""
    message = EVENT if changes.keys() & {"source", "text", "data"} else STATE
    with pytest.raises(InputError) as refusal:
        decode(type(message), _changed(message, **changes))
    assert str(refusal.value).startswith(type(message).__name__)
    assert fault in str(refusal.value)
    assert str(refusal.value).isprintable()


def test_bytes_after_a_message_are_refused() -> None:
    with pytest.raises(InputError, match="trailing characters"):
        decode(State, encode(STATE) + b"\x00")


def test_the_decoder_counts_drops_and_logs_at_a_limited_rate(
    caplog: pytest.LogCaptureFixture,
) -> None:
    decoder = Decoder(State, logging.getLogger("test"))
    with caplog.at_level(logging.WARNING):
        assert [decoder(b"junk") for _ in range(100)] == [None] * 100
    assert decoder(encode(STATE)) == STATE
    assert (decoder.refused, decoder.accepted) == (100, 1)
    assert len(caplog.records) == 1
    silent = Decoder(State)
    assert silent(b"junk") is None
    assert "State: Expected `object`" in silent.last_reason


def test_keys_take_a_plain_car_name_only() -> None:
    assert car_key(STATUS.key, "orca-2", "plant") == "bayesrace/orca-2/plant/status"
    for bad in ("", "a/b", "*", "a b", "$x", "x" * 41):
        with pytest.raises(InputError, match="car name"):
            car_key(RUN.key, bad)


def test_keys_of_the_table_are_distinct() -> None:
    keys = [topic.key for topic in TOPICS] + [service.key for service in SERVICES]
    assert len(set(keys)) == len(keys)
    assert STOP.request is not None


def conforms(value: Any, schema: dict[str, Any]) -> bool:
    """Whether a value read by json has the type, properties and lengths that the schema states."""
    match schema["type"]:
        case "object" if schema["properties"]:
            names, needed = schema["properties"], set(schema.get("required", ()))
            return needed <= value.keys() <= names.keys() and all(
                conforms(one, names[name]) for name, one in value.items()
            )
        case "object":
            scalars = all(type(one) in (bool, int, float, str) for one in value.values())
            return scalars and len(value) <= schema["maxProperties"]
        case "array":
            least, most = schema.get("minItems", 0), schema["maxItems"]
            return least <= len(value) <= most and all(conforms(v, schema["items"]) for v in value)
        case "integer" if "const" in schema:
            return bool(value == schema["const"])
        case "integer" | "number" as name:
            right = type(value) is {"integer": int, "number": float}[name]
            return right and schema["minimum"] <= value <= schema["maximum"]
        case "boolean":
            return type(value) is bool
        case "string":
            short = type(value) is str and len(value) <= schema.get("maxLength", 100)
            return short and value in schema.get("enum", [value])
    raise AssertionError(f"viewers such as Foxglove know no type {schema['type']}")


@settings(deadline=None)
@given(messages())
def test_every_message_survives_json_to_the_bit_and_is_as_its_schema_says(message: Message) -> None:
    kind, text = type(message), to_json(message)
    read = decode_json(kind, text)
    assert read == message
    assert encode(read) == encode(message)  # -0.0 is not 0.0
    assert conforms(json.loads(text), json_schema(kind))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b'"schema":3', b'"schema":1'), (b'"schema":3', b'"schema":3.0'),
        (b'"final":false', b'"final":0'), (b'"lap":0', b'"lap":false'), (b'"lap":0', b'"lap":0.5'),
        (b'"time_s":0.5', b'"time_s":"0.5"'), (b'"time_s":0.5', b'"time_s":true'),
        (b'"time_s":0.5', b'"time_s":NaN'), (b'"psi":3.0', b'"psi":null'), (b'"psi":3.0,', b''),
        (b'"arrival_s":[0.0004]', b'"arrival_s":[]'), (b'"lap":0', b'"lap":0,"more":0'),
    ],
)  # fmt: skip
def test_json_is_refused_unless_it_is_a_message(old: bytes, new: bytes) -> None:
    text = to_json(STATE)
    assert text.count(old) == 1
    with pytest.raises(InputError, match="State"):
        decode_json(State, text.replace(old, new))


def test_json_names_the_numbers_of_states_and_inputs() -> None:
    text = to_json(STATE)
    content = json.loads(text)
    names = ("x", "y", "psi", "vx", "vy", "omega", "delta")
    assert content["x"] == dict(zip(names, X0, strict=True))
    assert content["u_applied"] == {"d": 0.1, "delta_rate": 0.2}
    assert content["actuation_delays"] == {
        "state_seq": [2.0],
        "arrival_s": [4e-4],
        "acting_s": [1e-3],
    }
    whole = text.replace(b'"time_s":0.5', b'"time_s":2').replace(b'"psi":3.0', b'"psi":3')
    assert decode_json(State, whole) == replace(STATE, time_s=2.0)


@settings(deadline=None)
@given(st.sampled_from(KINDS), st.binary(max_size=100) | st.text(max_size=100).map(str.encode))
@example(Telemetry, b"[" * 5000)
@example(Telemetry, b'{"schema":2')
def test_any_bytes_are_refused_as_json(kind: type[Message], data: bytes) -> None:
    with pytest.raises(InputError):
        decode_json(kind, data)


def test_telemetry_of_earlier_releases_is_read() -> None:
    """It has no fields for replays: these say that they were not reported."""
    later = ("states", "late_s", "refused", "prepared_s", "prepared_refused")
    new = Telemetry(**values(Telemetry, random.Random(1)))
    fields = {
        name: value for name, value in msgpack.unpackb(encode(new)).items() if name not in later
    }
    old = decode(Telemetry, msgpack.packb(fields))
    assert [getattr(old, name) for name in later] == [-1, 0.0, (), -1.0, ()]
    assert old.plan_x == new.plan_x


FIRST_USE = """
import sys
import threading
from types import new_class
from bayesrace.messages import State, decode, decode_json, encode, to_json
from tests.test_messages import STATE as MESSAGE

sys.setswitchinterval(1e-6)
given = encode(MESSAGE), to_json(MESSAGE)
for number in range(150):
    fresh = new_class(f"Fresh{number}", (State,), {"frozen": True, "kw_only": True})
    begin = threading.Barrier(4)
    def use(read, data):
        begin.wait()
        read(fresh, data)
    threads = [threading.Thread(target=use, args=one)
               for one in zip((decode, decode_json) * 2, given * 2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
"""


def test_a_class_may_be_used_first_by_several_threads_at_once() -> None:
    """Each of them would describe it to msgspec, whose other users crash meanwhile."""
    done = subprocess.run([sys.executable, "-c", FIRST_USE], cwd=ROOT, capture_output=True)
    assert (done.returncode, done.stderr) == (0, b"")
