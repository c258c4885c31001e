"""Links of the controller without Python (controller/host): keys, serial lines."""

import hashlib
import hmac
import os
import random
import re
import socket
import struct
import subprocess
import threading
import time
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from bayesrace.codegen.build import HOST, NATIVE
from bayesrace.controller.remote import RemoteLink
from bayesrace.errors import InputError, RestartError
from bayesrace.messages import FrameReader, Seal, datagrams_in, framed, to_frame
from bayesrace.messages.serial_frames import _stuffed, _unstuffed
from tests.native_programs import PROGRAMS, SANITIZERS, STRICT, gcc
from tests.network.cars import free_port

HERE = NATIVE.parent / HOST
SECRET = bytes(range(100, 150))


def compiled(source: str, folder: Path) -> Path:
    """A program of tests/native around the links, under sanitizers."""
    links = [HERE / f"br_{part}.c" for part in ("transport", "serial", "seal", "hmac")]
    program = folder / source.removesuffix(".c")
    gcc("-O1", *SANITIZERS, *STRICT, f"-I{HERE}", PROGRAMS / source, *links, "-o", program)
    return program


@pytest.fixture(scope="module")
def echo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled("echo.c", tmp_path_factory.mktemp("echo"))


@pytest.fixture
def key(tmp_path: Path) -> Path:
    path = tmp_path / "key"
    path.write_bytes(SECRET)
    path.chmod(0o600)
    return path


@contextmanager
def running(line: Sequence[object]) -> Iterator["subprocess.Popen[str]"]:
    with subprocess.Popen(list(map(str, line)), stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert process.stderr.readline() == "ready\n"
        try:
            yield process
        finally:
            process.terminate()


@dataclass
class Peer:
    """A socket that is connected to the program."""

    socket: socket.socket
    process: "subprocess.Popen[str]"

    def ask(self, data: bytes) -> bytes:
        self.socket.send(data)
        return self.socket.recv(1 << 16)

    def counts(self) -> str:
        self.process.terminate()
        assert self.process.stderr is not None
        return self.process.stderr.read()


@pytest.fixture(params=["udp", "unix"])
def peer(echo: Path, key: Path, tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Peer]:
    own: Any = ("127.0.0.1", 0)
    there: Any = ("127.0.0.1", free_port())
    family, link = socket.AF_INET, "udp:{}:{}".format(*there)
    if request.param == "unix":
        own, there = str(tmp_path / "own"), str(tmp_path / "host")
        family, link = socket.AF_UNIX, f"unix:{there}"
    with running([echo, link, key]) as process, socket.socket(family, socket.SOCK_DGRAM) as one:
        one.settimeout(20.0)
        one.bind(own)
        one.connect(there)
        yield Peer(one, process)


def sealed(way: bytes, data: bytes, counter: int, secret: bytes = SECRET) -> bytes:
    """As docs/host.md describes it."""
    body = data + struct.pack(">Q", counter)
    return body + hmac.digest(secret, way + body, hashlib.sha256)[:16]


def counter_of(data: bytes) -> int:
    return int(struct.unpack(">Q", data[-24:-16])[0])


def test_tags_are_those_of_python_and_of_rfc_4231(tmp_path: Path) -> None:
    program = compiled("hmac.c", tmp_path)
    vectors = [  # key, message, begin of the tag: cases 1, 2 and 6
        (b"\x0b" * 20, b"Hi There", "b0344c61d8db38535ca8afceaf0bf12b"),
        (b"Jefe", b"what do ya want for nothing?", "5bdcc146bf60754e6a042426089575c7"),
        (
            b"\xaa" * 131,
            b"Test Using Larger Than Block-Size Key - Hash Key First",
            "60e431591ee0b67f0d8a26aacbf5b77f",
        ),
    ]
    rng = random.Random(3)
    pairs = [(k, m) for k, m, _ in vectors]
    pairs += [(rng.randbytes(k), rng.randbytes(m)) for k in (0, 63, 64, 65) for m in range(200)]
    pairs += [(rng.randbytes(k), rng.randbytes(65000 + k)) for k in range(32, 36)]
    given = b"".join(framed(one) for pair in pairs for one in pair)
    done = subprocess.run([program], input=given, capture_output=True, check=True, timeout=60)
    tags = list(datagrams_in(done.stdout))
    assert tags == [hmac.digest(*pair, hashlib.sha256) for pair in pairs]
    assert [one[:16].hex() for one in tags[:3]] == [begin for *_, begin in vectors]


def test_the_program_takes_what_its_peer_has_sealed_and_nothing_else(peer: Peer) -> None:
    before_ns = time.time_ns()
    good = sealed(b">", b"state", before_ns)
    answer = peer.ask(good)
    assert answer == sealed(b"<", b"state", counter_of(answer))
    assert before_ns < counter_of(answer) < time.time_ns()
    next_ns = before_ns + 1
    whole = sealed(b">", b"state", next_ns)
    forged = [bytes([*whole[:k], whole[k] ^ 1 << k % 8, *whole[k + 1 :]]) for k in range(len(good))]
    forged += [whole[:cut] for cut in range(len(whole))]
    forged += [whole[1:], b"state"]
    forged += [sealed(b">", b"state", next_ns, bytes(50)), sealed(b"", b"state", next_ns)]
    forged += [answer, sealed(b"<", b"state", next_ns)]
    replayed = [good, sealed(b">", b"state", before_ns - 1), sealed(b">", b"state", 2**64 - 1)]
    for one in (*forged, *replayed):
        peer.socket.send(one)
    assert peer.ask(sealed(b">", b"", next_ns))[:-24] == b""  # no answer was before
    assert f"forged {len(forged)}, replayed {len(replayed)}, unsent 0" in peer.counts()


def test_what_was_sent_before_the_program_began_is_refused(peer: Peer) -> None:
    peer.socket.send(sealed(b">", b"of the last run", time.time_ns() - 60 * 10**9))
    assert peer.ask(sealed(b">", b"new", time.time_ns()))[:-24] == b"new"
    assert "replayed 1" in peer.counts()


def test_answers_are_above_what_they_answer_whatever_the_clocks_say(peer: Peer) -> None:
    """So an end whose clock is ahead can refuse all from before its own start."""
    ahead = time.time_ns() + 3600 * 10**9
    counters = [counter_of(peer.ask(sealed(b">", b"", ahead + k))) for k in range(3)]
    assert counters == sorted(set(counters))
    assert counters[0] > ahead


def test_the_end_in_python_refuses_the_same() -> None:
    seal, before_ns = Seal(SECRET), time.time_ns()
    sent = [seal.sealed(b"state") for _ in range(1000)]
    assert all(one == sealed(b">", b"state", counter_of(one)) for one in sent)
    counters = list(map(counter_of, sent))
    assert counters == sorted(set(counters))
    good = sealed(b"<", b"answer", before_ns + 10**9)
    assert seal.opened(good) == b"answer"
    assert seal.opened(good) is None
    old = Seal(SECRET)
    assert old.opened(sealed(b"<", b"answer", before_ns - 1)) is None
    assert (old.replayed, seal.replayed, seal.forged) == (1, 1, 0)
    later = sealed(b"<", b"answer", before_ns + 2 * 10**9)
    forged = [later[:cut] for cut in range(len(later))]
    forged += [bytes([*later[:k], later[k] ^ 4, *later[k + 1 :]]) for k in range(len(later))]
    forged += [seal.sealed(b"answer"), sealed(b"<", b"answer", before_ns + 2 * 10**9, bytes(50))]
    assert [seal.opened(one) for one in forged] == [None] * len(forged)
    assert (seal.forged, seal.replayed) == (len(forged), 1)
    assert counter_of(seal.sealed(b"")) > counter_of(good)


def test_a_link_with_a_key_hears_the_program_alone(echo: Path, key: Path) -> None:
    link_name = f"udp:127.0.0.1:{free_port()}"
    with running([echo, link_name, key]):
        for seal, answer in ((Seal.read(key), b"state"), (None, None), (Seal(bytes(32)), None)):
            link = RemoteLink(link_name, seal=seal)
            link.send(b"state")
            assert link.receive(20.0 if answer else 0.3) == answer
            link.close()


def test_a_link_counts_what_it_refuses(tmp_path: Path, key: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as host:
        host.bind(str(tmp_path / "host"))
        link = RemoteLink(f"unix:{tmp_path / 'host'}", str(tmp_path / "own"), Seal.read(key))
        good = sealed(b"<", b"answer", time.time_ns())
        for one in (b"answer", good, good):
            host.sendto(one, str(tmp_path / "own"))
        assert [link.receive(0.1) for _ in range(4)] == [None, b"answer", None, None]
        assert link.counters() == {"unsent": 0, "forged": 1, "replayed": 1}
        link.close()


@pytest.mark.parametrize(
    ("size", "mode", "says"),
    [
        (31, 0o600, "a key has 32 to 4096 bytes"),
        (4097, 0o600, "a key has 32 to 4096 bytes"),
        (32, 0o644, "chmod 600"),
        (32, 0o640, "chmod 600"),
        (None, 0o600, "No such file"),
    ],
)
def test_a_key_that_is_none_is_named(
    echo: Path, tmp_path: Path, size: int | None, mode: int, says: str
) -> None:
    path = tmp_path / "key"
    if size is not None:
        path.write_bytes(bytes(size))
        path.chmod(mode)
    line = [str(echo), "stdio", str(path)]
    done = subprocess.run(
        line, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False
    )
    assert (done.returncode, str(path) in done.stderr, says in done.stderr) == (1, True, True)
    with pytest.raises(InputError, match=f"{path}.*{says}|{says}.*{path}"):
        Seal.read(path)


@dataclass
class Line:
    """The other end of a serial line to the program, with what comes from there."""

    master: int
    process: "subprocess.Popen[str]"

    def send(self, data: bytes) -> None:
        """Whole, while :meth:`receive` is called by another thread."""
        while data:
            data = data[os.write(self.master, data[:2000]) :]

    def receive(self, size: int) -> bytes:
        received = b""
        while len(received) < size:
            received += os.read(self.master, 1 << 16)
        return received

    def exchange(self, sent: bytes, size: int) -> bytes:
        sender = threading.Thread(target=self.send, args=(sent,))
        sender.start()
        received = self.receive(size)
        sender.join()
        return received

    def said(self) -> str:
        """At the end of the line."""
        os.close(self.master)
        assert self.process.stderr is not None
        said = self.process.stderr.read()
        assert self.process.wait(20) == 0
        return said


@pytest.fixture
def line(echo: Path) -> Iterator[Line]:
    master, slave = os.openpty()
    with running([echo, f"serial:{os.ttyname(slave)}:115200"]) as process:
        os.close(slave)
        yield Line(master, process)


def various(count: int) -> list[bytes]:
    """Datagrams, also of zeros alone and without any, of lengths around a block's."""
    rng = random.Random(6)
    lengths = [0, 1, 2, *range(245, 260), 507, 508, 509, 1000, 20000]
    some = [bytes(k) for k in lengths] + [rng.randbytes(k).replace(b"\0", b"x") for k in lengths]
    for _ in range(count - len(some)):
        data = rng.randbytes(rng.randrange(700))
        some.append(data.replace(data[:1], b"\0") if rng.random() < 0.5 else data)
    return some


@pytest.mark.parametrize(
    ("data", "stuffed"),
    [
        ("", "01"),
        ("00", "0101"),
        ("0000", "010101"),
        ("110000", "02110101"),
        ("11220033", "0311220233"),
        ("11223344", "0511223344"),
        ("01" * 254, "ff" + "01" * 254),
        ("01" * 254 + "00", "ff" + "01" * 254 + "0101"),
        ("00" + "01" * 254, "01ff" + "01" * 254),
        ("01" * 255, "ff" + "01" * 254 + "0201"),
    ],
)
def test_frames_are_stuffed_as_published(data: str, stuffed: str) -> None:
    """By the examples of COBS; at the end of a whole block another 01 means the same."""
    assert _unstuffed(bytes.fromhex(stuffed)).hex() == data
    assert _stuffed(bytes.fromhex(data)).hex() in (stuffed, stuffed + "01")


def test_what_is_stuffed_is_the_same_again() -> None:
    for data in various(2000):
        stuffed = _stuffed(data)
        assert 0 not in stuffed
        assert len(stuffed) <= len(data) + 1 + len(data) // 254
        assert _unstuffed(stuffed) == data


def test_frames_in_c_are_those_in_python_in_both_directions(line: Line) -> None:
    sent = various(300)
    expected = b"".join(map(to_frame, sent))
    got = b"".join(line.exchange(to_frame(one), len(to_frame(one))) for one in sent)
    assert got == expected
    assert "bad 0" in line.said()
    reader = FrameReader()
    pieces = [expected[at : at + 97] for at in range(0, len(expected), 97)]
    assert [one for piece in pieces for one in reader.take(piece)] == sent


def test_a_whole_block_at_the_end_is_read_without_its_last_byte(line: Line) -> None:
    data = next(
        one for k in range(1, 256)
        if 0 not in zlib.crc32(one := bytes([k]) * 250).to_bytes(4, "big")
    )  # fmt: skip
    whole = to_frame(data)
    assert whole.endswith(b"\1\0")
    assert line.exchange(whole[:-2] + b"\0", len(whole)) == whole
    assert FrameReader().take(whole[:-2] + b"\0") == [data]


def test_noise_damages_no_frame_but_its_own(line: Line) -> None:
    """Bytes between frames, frames that are cut off, too long, or have other bytes.

    Each answer is awaited, since a line that nobody reads for a while loses some of them.
    """
    rng, sent, stream, got = random.Random(7), [], b"", b""
    for k in range(300):
        data = rng.randbytes(rng.randrange(1, 400))
        whole = to_frame(data)
        at = rng.randrange(1, len(whole) - 1)
        noise = (
            rng.randbytes(rng.randrange(300)),
            whole[:at],
            whole[at:],
            whole[:at] + bytes([whole[at] ^ 1 << rng.randrange(8)]) + whole[at + 1 :],
            b"\xff" * 70_000 if k % 100 == 4 else b"",
        )[k % 5]
        sent.append(data[::-1])
        stream += noise + to_frame(sent[-1])
        got += line.exchange(noise + to_frame(sent[-1]), len(to_frame(sent[-1])))
    reader = FrameReader()
    expected = reader.take(stream)
    assert expected == sent
    assert got == b"".join(map(to_frame, sent))
    assert f"bad {reader.bad}," in line.said()
    assert 200 < reader.bad < 600


def test_a_line_that_nobody_reads_holds_nothing_up_and_no_frame_is_cut(line: Line) -> None:
    """What is short is left out last."""
    sent = [bytes([k % 256]) * (4000 if k % 2 else 40) for k in range(150)]
    for one in sent:
        line.send(to_frame(one))
    time.sleep(0.2)
    reader, got = FrameReader(), list[bytes]()
    while not got or got[-1] != b"last":
        got += reader.take(os.read(line.master, 1 << 16))
        if len(got) > 70 and b"last" not in got:
            line.send(to_frame(b"last"))
    got = [one for one in got if one != b"last"]
    assert reader.bad == 0
    assert [one for one in got if len(one) == 40] == sent[::2]
    assert len(got) < len(sent)
    assert f"unsent {len(sent) - len(got)}" in line.said()


def test_a_link_speaks_by_a_serial_line_until_it_is_unplugged(key: Path) -> None:
    master, slave = os.openpty()
    link = RemoteLink(f"serial:{os.ttyname(slave)}", seal=Seal.read(key))
    os.close(slave)
    link.send(b"state")
    (sent,) = FrameReader().take(os.read(master, 1 << 16))
    assert sent == sealed(b">", b"state", counter_of(sent))
    answers = [sealed(b"<", data, counter_of(sent) + k) for k, data in enumerate((b"1", b"2"), 1)]
    os.write(master, b"noise" + to_frame(answers[0]) + to_frame(answers[1]) + to_frame(answers[0]))
    assert [link.receive(1.0) for _ in range(3)] == [b"1", b"2", None]
    assert link.receive(0.01) is None
    assert link.counters() == {"unsent": 0, "bad_frames": 1, "forged": 0, "replayed": 1}
    for _ in range(3000):  # nobody reads
        link.send(bytes(100))
    assert int(str(link.counters()["unsent"])) > 0
    os.close(master)
    with pytest.raises(RestartError, match="plugged in"):
        link.receive(1.0)
    link.close()


@pytest.mark.parametrize(
    ("where", "says"),
    [
        ("/dev/null", "/dev/null.*Inappropriate ioctl"),
        ("/nowhere:9600", "rate of these: 115200, 230400"),
        ("/nowhere:1.0:921600", "/nowhere:1.0.*No such file"),
        ("/nowhere:1.0", "/nowhere:1.0.*No such file"),
        ("", "No such file"),
    ],
)
def test_a_serial_line_that_is_none_is_named(echo: Path, where: str, says: str) -> None:
    done = subprocess.run(
        [str(echo), f"serial:{where}"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert re.search(says, done.stderr)
    with pytest.raises(InputError, match=says):
        RemoteLink(f"serial:{where}")
