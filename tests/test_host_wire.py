"""Messages in C (controller/host/br_wire.c) against msgspec's: what one writes the other reads, and
what one refuses the other refuses."""

import random
import struct
import subprocess
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
import pytest
from msgspec.structs import replace

from bayesrace.codegen.build import HOST
from bayesrace.codegen.messages import TOPICS_IN_C
from bayesrace.errors import InputError
from bayesrace.messages import (
    ACTUATION,
    BRAKING,
    COMMAND,
    RULING_ERRORS,
    STATE,
    TELEMETRY,
    TRUTH,
    UPDATE,
    UPDATED,
    WEIGHTS,
    Actuation,
    BrakingPlan,
    Command,
    Message,
    Telemetry,
    Truth,
    Update,
    Updated,
    datagrams_in,
    framed,
    from_datagram,
    to_datagram,
)
from tests import sample_messages as messages
from tests.driven import blank
from tests.instruments import reading
from tests.native_programs import PROGRAMS, SANITIZERS, STRICT, gcc

Again = Callable[[Sequence[bytes]], list[bytes]]
LIMIT = 2**63 - 1


@pytest.fixture(scope="module")
def again(kinematic_artefact: Path, tmp_path_factory: pytest.TempPathFactory) -> Again:
    """Datagrams as C writes them again, under sanitizers; empty where it refuses one."""
    host, program = kinematic_artefact / HOST, tmp_path_factory.mktemp("wire") / "wire"
    links = [host / f"br_{part}.c" for part in ("transport", "serial", "seal", "hmac")]
    sources = (PROGRAMS / "wire.c", host / "br_wire.c", *links)
    gcc("-O1", *SANITIZERS, *STRICT, f"-I{host}", *sources, "-lm", "-o", program)

    def run(sent: Sequence[bytes]) -> list[bytes]:
        given = b"".join(map(framed, sent))
        done = subprocess.run([program], input=given, capture_output=True, check=True, timeout=120)
        return list(datagrams_in(done.stdout))

    return run


def samples() -> list[tuple[Any, Message]]:
    """Usual and extreme ones of all that C knows."""
    instruments = (
        reading("pose", -1.0, x=1.0, y=-2.5, psi=900.0, deviation=(1e-12, 1e6, 0.01)),
        reading("gyro", 0.02, omega=0.0, deviation=(0.02,)),
        reading("a" * 40, 1e9, vx=1e6, deviation=(0.02,)),
    )
    state = messages.state(epoch=LIMIT, run=LIMIT - 1, actuation_delays=(3.0, 0.01, -1.0) * 64)
    whole = blank(Telemetry)
    actuation = blank(Actuation, u=(0.5, -5.0), status=255)
    return [
        (STATE, messages.state()),
        (STATE, state),
        (STATE, replace(state, estimated=True, readings=instruments, lap=-(2**31), final=True)),
        (STATE, replace(state, estimated=True, readings=instruments[:1] * 16)),
        (ACTUATION, actuation),
        (ACTUATION, replace(actuation, weights_version="ü" * 100, u=(-1e3, 5e-324))),
        (COMMAND, Command(seq=1, source_time_ns=2, command="stop", text="a cone on the track")),
        (UPDATE, blank(Update, action="write", at=7, data=bytes(range(256)) * 4)),
        (UPDATED, blank(Updated, busy=True, data=b"", errors=(1e12,) * RULING_ERRORS)),
        (BRAKING, blank(BrakingPlan, step_s=0.02, d=(0.5, -0.1), delta=(0.0, 0.35))),
        (TELEMETRY, whole),
        (
            TELEMETRY,
            replace(
                whole,
                plan_x=(1e6,) * 3507,
                plan_u=(-0.0,) * 1000,
                tube_m=(0.5,) * 500,
                estimate=(0.1,) * 9,
                deviation=(1e-300,) * 9,
                sensor_fault="elsewhere",
                refused=(0, 1_000_000),
                prepared_refused=tuple(range(16)),
            ),
        ),
    ]


def test_what_is_written_in_python_is_read_in_c_and_back(again: Again) -> None:
    sent = samples()
    assert {topic for topic, _ in sent} == set(TOPICS_IN_C)
    back = again([to_datagram(*one) for one in sent])
    assert [from_datagram(one) for one in back] == sent


def test_of_datagrams_that_are_damaged_both_refuse_the_same(again: Again) -> None:
    """One byte, or several, are others, or the end is missing."""
    rng = random.Random(5)
    damaged = []
    for _ in range(6000):
        topic, message = rng.choice(samples()[:10])
        data = bytearray(to_datagram(topic, message))
        for _ in range(rng.choice((1, 1, 2, 5))):
            at = rng.randrange(len(data))
            data[at] = rng.choice((0, 1, 0x7F, 0xC0, 0xC2, 0xCB, 0xFF, rng.randrange(256)))
        cut = rng.randrange(len(data)) if rng.random() < 0.1 else len(data)
        damaged.append(bytes(data[:cut]))
    compare(again, damaged)


def compare(again: Again, data: Sequence[bytes]) -> None:
    read = 0
    for one, back in zip(data, again(data), strict=True):
        try:
            expected = from_datagram(one)
        except InputError:
            assert back == b"", one
            continue
        if not back:  # what only Python reads
            assert unusual(one), one
            continue
        assert from_datagram(back) == expected
        read += 1
    assert read > len(data) / 20


def unusual(data: bytes) -> bool:
    """Python takes the last of two fields of a name, and texts with a byte 0."""
    _, payload = msgspec.msgpack.decode(data, type=tuple[str, msgspec.Raw])
    head, content = bytes(payload)[0], msgspec.msgpack.decode(payload)
    fields = head & 15 if head < 0x90 else struct.unpack_from(">H", payload, 1)[0]
    return len(content) != fields or any("\0" in text for text in texts_in(content))


def texts_in(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for one in value.values() if isinstance(value, dict) else value:
            yield from texts_in(one)


def test_of_states_both_want_every_field_once_and_no_other(again: Again) -> None:
    _, state = samples()[2]
    message = msgspec.msgpack.decode(to_datagram(STATE, state))[1]
    fields = [one for one in message if one != "schema"]
    changed = [{k: v for k, v in message.items() if k != name} for name in fields]
    changed += [message | {name: None} for name in fields]
    changed += [message | {name: "text"} for name in fields]
    changed += [message | {"other": 1}, message | {"schema": 2}, message | {"x": [0.0] * 6}]
    values = message["readings"][0]["values"]
    for wrong in ({}, {"z": [1.0, 1.0]}, values | {"x": [1.0]}, values | {"x": [1.0, 0.0]}):
        readings = [message["readings"][0] | {"values": wrong}]
        changed.append(message | {"readings": readings})
    data = [msgspec.msgpack.encode(["state", one]) for one in changed]
    for one in data:
        with pytest.raises(InputError):
            from_datagram(one)
    assert set(again(data)) == {b""}
    del message["schema"]  # msgspec takes the version for granted then
    assert again([msgspec.msgpack.encode(["state", message])]) == [b""]


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xc1",
        b"\x92",
        b"\x92\xa5state",
        b"\x92\xa5state\x80",
        b"\x93\xa5state\x80\xc0",
        b"\x92\xdb\xff\xff\xff\xffstate\x80",
        b"\x92\xa5state\xdf\xff\xff\xff\xff",
        b"\x92\xa5state" + b"\x91" * 5000,
        to_datagram(TRUTH, blank(Truth, x=(0.0,) * 7, u_applied=(0.0, 0.0))),
        to_datagram(STATE, messages.state()) + b"\0",
        msgspec.msgpack.encode([COMMAND.name, {}]),
        msgspec.msgpack.encode([WEIGHTS.name, {}]),
        msgspec.msgpack.encode(["x" * 31, {}]),
        msgspec.msgpack.encode(["x" * 32, {}]),
    ],
    ids=range(15),
)
def test_what_is_no_message_of_its_topics_is_refused(again: Again, data: bytes) -> None:
    assert again([data, to_datagram(STATE, messages.state())])[0] == b""


def test_a_stream_that_is_cut_off_is_named() -> None:
    with pytest.raises(InputError, match="cut off"):
        list(datagrams_in(framed(b"whole") + framed(b"cut")[:-1]))
    with pytest.raises(InputError, match="cut off"):
        list(datagrams_in(b"\0\0"))


def test_numbers_that_are_written_otherwise_are_read_alike(again: Again) -> None:
    """A whole number where a real one belongs, in any width; fields in another order."""
    content = msgspec.msgpack.decode(to_datagram(STATE, messages.state()))
    message = dict(reversed(list(content[1].items())))
    message["x"] = [1, -1, 127, 128, 65536, -40000, 0]
    message["u_applied"] = [0.5, 3]
    data = msgspec.msgpack.encode(["state", message])
    narrow = data.replace(struct.pack(">Bd", 0xCB, 0.5), struct.pack(">Bf", 0xCA, 0.5))
    for one in (data, narrow):
        (back,) = again([one])
        assert from_datagram(back) == from_datagram(data)
    assert narrow != data
