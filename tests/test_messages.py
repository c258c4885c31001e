"""The codec's promise: a message survives the wire unchanged, and nothing else gets through."""

import json
import logging
import math
from typing import Annotated, Any, get_type_hints

import msgpack
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from bayesrace.errors import InputError
from bayesrace.messages import (
    RUN,
    SERVICES,
    STATUS,
    STOP,
    TOPICS,
    CarSample,
    Decoder,
    Event,
    Message,
    State,
    Telemetry,
    car_key,
    decode,
    decode_json,
    encode,
    json_schema,
    to_json,
)
from bayesrace.messages.codec import checked, largest_bytes, peek_seq, schema_version
from bayesrace.messages.rules import (
    Choice,
    Flag,
    Integer,
    Real,
    Scalars,
    Text,
    Vector,
    meta,
    rules_of,
)
from tests.mutations import KINDS

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
)

EVENT = Event(
    seq=0, source_time_ns=0, run=0, source="plant", kind="kind", text="text", data={"a": 1.0}
)

_text = st.text(st.characters(codec="utf-8"), max_size=30)
_scalar = st.one_of(
    st.booleans(), st.integers(-(2**63) + 1, 2**63 - 1), st.floats(-1e12, 1e12), _text
)


def values(rule: Any) -> st.SearchStrategy[Any]:
    """Every value that a rule accepts, more or less."""
    match rule:
        case Integer():
            return st.integers(rule.low, rule.high)
        case Real():
            return st.floats(rule.low, rule.high)
        case Flag():
            return st.booleans()
        case Text():
            return _text
        case Choice():
            return st.sampled_from(rule.words)
        case Scalars():
            return st.dictionaries(_text, _scalar, max_size=5)
        case Vector():
            numbers = st.floats(-rule.limit, rule.limit)
            rows = st.just(1) if rule.rows is None else st.integers(0, 4)
            return rows.flatmap(lambda n: st.tuples(*[numbers] * (n * rule.length)))
    raise AssertionError(rule)


@st.composite
def messages(draw: st.DrawFn) -> Message:
    kind = draw(st.sampled_from(KINDS))
    return kind(**{name: draw(values(rule)) for name, rule in rules_of(kind).items()})


@settings(deadline=None)
@given(messages())
def test_every_message_survives_the_wire(message: Message) -> None:
    data = encode(message)
    assert decode(type(message), data) == message
    assert peek_seq(data) == message.seq
    # msgspec writes what msgpack would, and the checks of other encoders' messages let it pass.
    fields = {name: getattr(message, name) for name in message.__struct_fields__}
    content = {"schema": schema_version(type(message)), **fields}
    assert data == msgpack.packb(content)
    assert checked(type(message), msgpack.unpackb(data)) == message


def test_numpys_floats_and_texts_are_written_as_pythons() -> None:
    """A control law or vehicle of one's own may return them."""
    x = tuple(np.array(X0))
    odd = replace(STATE, time_s=np.float64(0.5), x=x)
    assert encode(odd) == encode(STATE)
    assert encode(EVENT) == encode(replace(EVENT, text=np.str_("text"), data={"a": np.float64(1)}))


def test_a_field_without_a_complete_rule_is_named() -> None:
    class Bare(Message, frozen=True, kw_only=True):
        number: Annotated[float, Real(0.0, 1.0)]

    class Lopsided(Message, frozen=True, kw_only=True):
        numbers: Annotated[tuple[Annotated[float, meta(Real(0.0, 1.0))], ...], meta(Vector(2))]

    with pytest.raises(TypeError, match=r"Bare\.number has no rule"):
        largest_bytes(Bare)
    with pytest.raises(TypeError, match=r"Lopsided\.numbers: annotate its numbers"):
        largest_bytes(Lopsided)


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


def largest(rule: Any) -> Any:
    """The acceptable value that takes most bytes."""
    match rule:
        case Text():
            return "😀" * rule.longest
        case Choice():
            return max(rule.words, key=len)
        case Scalars():
            entries: dict[str, Any] = {f"{i:04}": 2**63 - 1 for i in range(rule.most)}
            return entries | {f"{i:04}": "😀" * 1920 for i in range(10)}
        case Vector():
            return (rule.limit,) * rule.most
        case Flag():
            return True
    return rule.high


def test_every_kind_of_message_is_in_the_table() -> None:
    kinds = {k.__name__ for base in (Message, CarSample) for k in base.__subclasses__()}
    assert {k.__name__ for k in KINDS} == kinds - {"CarSample"}


@pytest.mark.parametrize("kind", KINDS)
def test_the_largest_message_passes_and_what_is_larger_is_not_read(kind: type[Message]) -> None:
    message = kind(**{name: largest(rule) for name, rule in rules_of(kind).items()})
    data = encode(message)
    assert decode(kind, data) == message
    assert len(data) <= largest_bytes(kind) <= 1 << 17
    junk = bytes(largest_bytes(kind) + 1)
    with pytest.raises(InputError, match=f"{len(junk)} bytes, at most {len(junk) - 1} allowed"):
        decode(kind, junk)


def _changed(**changes: Any) -> bytes:
    content = msgpack.unpackb(encode(STATE))
    content.update(changes)
    packed: bytes = msgpack.packb({k: v for k, v in content.items() if v is not Ellipsis})
    return packed


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"x": [math.nan] * 7}, "State.x"),
        ({"x": [math.inf] + [0.0] * 6}, "State.x"),
        ({"x": [0.0] * 6}, "State.x: 6 numbers are not 7"),
        ({"x": [0] * 7}, "State.x"),
        ({"x": "1234567"}, "State.x: '1234567' is not an array"),
        ({"seq": -1}, "State.seq"),
        ({"seq": True}, "State.seq: True is not an integer"),
        ({"seq": 2**63}, "State.seq"),
        ({"time_s": 1}, "State.time_s: 1 is not a float"),
        ({"time_s": math.nan}, "State.time_s"),
        ({"lockstep": 1}, "State.lockstep"),
        ({"schema": 1, "answers": ()}, "schema version 1, this program reads 2"),
        ({"schema": 1.0}, "schema version"),
        ({"extra": 1}, "missing or unknown fields: 'extra'"),
        ({"lap": ...}, "missing or unknown fields: 'lap'"),
    ],
)
def test_a_refusal_names_the_field_and_the_fault(changes: dict[str, Any], names: str) -> None:
    with pytest.raises(InputError, match=names.replace(".", r"\.")):
        decode(State, _changed(**changes))


def test_trailing_bytes_and_repeated_names_are_refused() -> None:
    data = encode(STATE)
    with pytest.raises(InputError, match="extra data"):
        decode(State, data + b"\x00")
    repeated = bytes([data[0] + 1]) + data[1:] + b"\xa3seq\x07"
    with pytest.raises(InputError, match="twice"):
        decode(State, repeated)


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
    assert "not a m" in silent.last_reason


@pytest.mark.parametrize(
    ("entries", "fault"),
    [
        ({"a": math.nan}, "'a' is not a flag, .* a float within"),
        ({"a\x1b[2J": -math.inf}, r"'a\\x1b\[2J' is not a flag"),
        ({"a": 2**64 - 1}, "'a' is not a flag, an integer of 64 bits"),
        ({"a": {"b": 1}}, "'a' is not a flag, .* text"),
        ({"a": [1]}, "max_array_len"),
        ({"a": "x" * 2001}, "'a' is not a flag, .* text"),
        ({"x" * 101: 1}, "at most 100 characters"),
        ({f"n{i}": "x" * 2000 for i in range(11)}, "22023 characters, at most 20000"),
        ({f"n{i}": 1 for i in range(201)}, "at most 200 entries|max_map_len"),
    ],
)
def test_a_map_holds_few_finite_scalars(entries: dict[str, Any], fault: str) -> None:
    """The name in the refusal is quoted: it comes from outside and may end on a terminal."""
    with pytest.raises(InputError, match=fault):
        decode(Event, encode(replace(EVENT, data=entries)))


def test_maps_in_messages_are_read_only() -> None:
    read = decode(Event, encode(EVENT))
    with pytest.raises(TypeError):
        read.data["a"] = 2  # type: ignore[index]


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
            names = schema["properties"]
            return value.keys() == names.keys() == set(schema["required"]) and all(
                conforms(value[name], names[name]) for name in names
            )
        case "object":
            return all(type(one) in (bool, int, float, str) for one in value.values())
        case "array":
            least, most = schema.get("minItems", 0), schema["maxItems"]
            return least <= len(value) <= most and all(conforms(v, schema["items"]) for v in value)
        case "integer" if "const" in schema:
            return bool(value == schema["const"])
        case "integer" | "number":
            return type(value) in (int, float) and schema["minimum"] <= value <= schema["maximum"]
        case "boolean":
            return type(value) is bool
        case "string":
            return type(value) is str and value in schema.get("enum", [value])
    raise AssertionError(f"viewers such as Foxglove know no type {schema['type']}")


@settings(deadline=None)
@given(messages())
def test_every_message_survives_json_to_the_bit_and_is_as_its_schema_says(message: Message) -> None:
    kind, text = type(message), to_json(type(message), encode(message))
    assert text is not None
    read = decode_json(kind, text)
    assert read == message
    assert encode(read) == encode(message)  # -0.0 is not 0.0
    assert conforms(json.loads(text), json_schema(kind))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b'"schema":2,', b""), (b'"schema":2', b'"schema":1'), (b'"schema":2', b'"schema":2.0'),
        (b'"final":false', b'"final":0'), (b'"lap":0', b'"lap":false'), (b'"lap":0', b'"lap":0.5'),
        (b'"time_s":0.5', b'"time_s":"0.5"'), (b'"time_s":0.5', b'"time_s":true'),
        (b'"arrival_s":[0.0004]', b'"arrival_s":[]'), (b'"lap":0', b'"lap":0,"more":0'),
    ],
)  # fmt: skip
def test_json_is_refused_unless_it_is_exactly_a_message(old: bytes, new: bytes) -> None:
    text = to_json(State, encode(STATE))
    assert text is not None
    assert text.count(old) == 1
    with pytest.raises(InputError, match="State"):
        decode_json(State, text.replace(old, new))


def test_json_names_the_numbers_of_states_and_inputs() -> None:
    text = to_json(State, encode(STATE))
    assert text is not None
    content = json.loads(text)
    assert content["x"] == dict(
        zip(("x", "y", "psi", "vx", "vy", "omega", "delta"), X0, strict=True)
    )
    assert content["u_applied"] == {"d": 0.1, "delta_rate": 0.2}
    assert content["actuation_delays"] == {
        "state_seq": [2.0],
        "arrival_s": [4e-4],
        "acting_s": [1e-3],
    }
    whole = text.replace(b'"time_s":0.5', b'"time_s":2').replace(b'"psi":3.0', b'"psi":3')
    assert decode_json(State, whole) == replace(STATE, time_s=2.0)


def test_what_is_not_finite_is_recorded_and_refused() -> None:
    text = to_json(State, _changed(time_s=math.nan, u_applied=[0.0, -math.inf]))
    assert text is not None
    assert b'"time_s":"NaN"' in text
    assert b'"delta_rate":"-Infinity"' in text
    with pytest.raises(InputError, match=r"State\.time_s: .NaN. is not a float"):
        decode_json(State, text)


@pytest.mark.parametrize("changes", [{"x": [0.0] * 6}, {"x": 7}, {"extra": 1}, {"lap": ...}])
def test_what_has_no_form_in_json_is_no_message(changes: dict[str, Any]) -> None:
    assert to_json(State, _changed(**changes)) is None


@settings(deadline=None)
@given(st.sampled_from(KINDS), st.binary(max_size=100) | st.text(max_size=100).map(str.encode))
@example(Telemetry, b"[" * 5000)
@example(Telemetry, b'{"schema":2')
def test_any_bytes_become_json_or_are_refused(kind: type[Message], data: bytes) -> None:
    to_json(kind, data)
    with pytest.raises(InputError):
        decode_json(kind, data)


@pytest.mark.parametrize("kind", KINDS)
def test_the_published_schema_names_exactly_the_fields_on_the_wire(kind: type[Message]) -> None:
    schema = json_schema(kind)
    hints = set(get_type_hints(kind))
    assert set(schema["properties"]) == set(schema["required"]) == hints | {"schema"}
