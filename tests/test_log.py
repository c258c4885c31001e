"""The log's promise: complete, typed, and readable up to the last second whatever happened."""

import errno
import json
import subprocess
import sys
import threading
import time
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.writer import CompressionType, Writer
from msgspec import structs

from bayesrace.columns import LogColumns
from bayesrace.errors import InputError
from bayesrace.log import LogReader, LogWriter, _unpacked
from bayesrace.messages import (
    EVENT,
    HEARTBEAT,
    STATE,
    TELEMETRY,
    Actuation,
    Message,
    State,
    Status,
    Telemetry,
    Truth,
    encode,
)
from bayesrace.recorder import Recorder
from bayesrace.transport import Endpoints, Inbox, Publisher, free_endpoint, open_session
from tests import driven
from tests import sample_messages as messages
from tests.driven import blank
from tests.programs import ROOT, until
from tests.test_messages import conforms

KEY, EVENT_KEY = "bayesrace/orca/state", "bayesrace/orca/event/plant"


def state(seq: int) -> State:
    return messages.state(seq, epoch=0, time_s=0.02 * seq, lockstep=True)


def write(path: Path, count: int = 50) -> None:
    writer = LogWriter(path, {"settings": {"track": "ethz"}})
    for seq in range(count):
        writer.write(KEY, encode(state(seq)), time.monotonic_ns())
    event = messages.event(run=1, kind="run_ended", text="done", data={"laps": 1})
    writer.write(EVENT_KEY, encode(event), time.monotonic_ns())
    writer.write(KEY, b"junk", time.monotonic_ns())
    writer.write("bayesrace/orca/unknown", b"junk", time.monotonic_ns())
    writer.add_metadata("manifest", {"scheme": "rk4"})
    writer.close()


def test_a_log_gives_back_typed_messages_and_metadata(tmp_path: Path) -> None:
    write(tmp_path / "log.mcap")
    log = LogReader(tmp_path / "log.mcap")
    entries = list(log.messages())
    assert [entry.message for entry in entries[:50]] == [state(seq) for seq in range(50)]
    assert entries[50].key == EVENT_KEY
    assert log.select(EVENT)[0].data == {"laps": 1}
    assert log.metadata() == {"settings": {"track": "ethz"}, "manifest": {"scheme": "rk4"}}
    assert not log.truncated
    assert len(log.select(STATE)) == 50
    assert log.refused == 1
    assert "State" in log.last_reason
    assert abs(entries[0].wall_ns - time.time_ns()) < 60e9


@pytest.mark.parametrize("lockstep", [True, False])
def test_log_time_is_car_time(tmp_path: Path, lockstep: bool) -> None:
    """On one line through all runs; in real time a run begins at its calendar time. A state that
    claims to be years away moves nothing."""

    def sample(run: int, time_s: float) -> State:
        return structs.replace(state(0), run=run, time_s=time_s, lockstep=lockstep)

    def decided(at_s: float) -> Actuation:
        return blank(Actuation, run=1, u=(0.0, 0.0), decided_at_s=at_s)

    second_s = 0.04 if lockstep else 60.0
    telemetry = blank(Telemetry, run=1)
    sent: list[tuple[str, Message, float, float]] = [  # with times of arrival and in the log [s]
        ("state", sample(1, 0.0), 0.0, 0.0),
        ("state", sample(1, 0.02), 0.001, 0.02),
        ("actuation", decided(0.0), 0.002, 0.0),  # overtaken by the next state
        ("telemetry", telemetry, 0.002, 0.0),
        ("actuation", decided(0.04), 0.003, 0.04),  # has overtaken its state
        ("shadow/new/actuation", decided(0.0), 0.003, 0.0),  # behind the controller
        ("shadow/new/telemetry", telemetry, 0.003, 0.0),
        ("state", sample(1, 0.04), 0.004, 0.04),
        ("telemetry", telemetry, 0.004, 0.04),
        ("state", sample(1, 1e9), 0.005, 0.04),
        ("truth", blank(Truth, run=1, x=(0.0,) * 7, u_applied=(0.0, 0.0)), 0.005, 0.04),
        ("state", sample(2, 0.0), 60.0, second_s),
        ("state", sample(2, 0.02), 60.001, second_s + 0.02),
    ]
    writer, now_ns = LogWriter(tmp_path / "log.mcap"), time.monotonic_ns()
    for name, message, arrival_s, _ in sent:
        writer.write(f"bayesrace/orca/{name}", encode(message), now_ns + round(1e9 * arrival_s))
    writer.close()
    entries = list(LogReader(tmp_path / "log.mcap").messages())
    begin_ns = entries[0].wall_ns
    for entry, (name, _, arrival_s, log_time_s) in zip(entries, sent, strict=True):
        assert entry.wall_ns - begin_ns == round(1e9 * arrival_s), name
        assert entry.log_time_ns - begin_ns == round(1e9 * log_time_s), name


def appended(path: Path, data: bytes) -> None:
    with path.open("ab") as file:
        file.write(data)


def test_a_log_that_grows_byte_by_byte_gives_each_message_once(tmp_path: Path) -> None:
    """Its end, from within the last chunk to the last byte, seen once or at each byte. Nothing
    follows the end."""
    path, growing = tmp_path / "whole.mcap", tmp_path / "growing.mcap"
    writer = LogWriter(path)
    for seq in range(4):
        writer.write(KEY, encode(state(seq)), time.monotonic_ns())
        writer.flush()
        if seq == 2:
            begin = path.stat().st_size
    writer.close()
    whole = path.read_bytes()
    appended(growing, whole[:begin])
    patient, found = LogReader(growing), []

    def newer(reader: LogReader) -> tuple[list[int], bool]:
        return [entry.message.seq for entry in reader.newer()], reader.truncated

    for size in range(begin, len(whole)):
        cut = tmp_path / f"{size}.mcap"
        appended(cut, whole[:size])
        hasty = LogReader(cut)
        early, cut_off = newer(hasty)
        assert cut_off
        appended(cut, whole[size:])
        assert newer(hasty) == ([0, 1, 2, 3][len(early) :], False)
        more, cut_off = newer(patient)
        assert cut_off
        found += more
        assert found == early == list(range(len(early)))
        appended(growing, whole[size : size + 1])
    for _ in range(2):
        assert newer(patient) == ([], False)
    assert found == [0, 1, 2, 3]


def test_reading_from_the_beginning_does_not_change_what_is_new(tmp_path: Path) -> None:
    write(tmp_path / "log.mcap")
    reader = LogReader(tmp_path / "log.mcap")
    first = next(reader.newer((STATE,)))
    assert first.message.seq == 0
    assert len(reader.select(STATE)) == 50
    assert reader.refused == 1
    # The iteration was left after one message; the next one continues there.
    assert [entry.message.seq for entry in reader.newer((STATE,))] == list(range(1, 50))
    assert reader.refused == 1
    assert list(reader.newer((STATE,))) == []
    assert len(list(reader.messages((STATE,)))) == 50


def test_a_damaged_chunk_can_be_tried_any_number_of_times(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only what has been unpacked counts towards the most that a log may unpack to."""
    monkeypatch.setattr("bayesrace.log._MOST_UNPACKED", 1 << 15)
    monkeypatch.setattr("bayesrace.log._RATIO", 0)
    path = tmp_path / "log.mcap"
    write(path)
    whole = path.read_bytes()
    at = whole.index(b"\x28\xb5\x2f\xfd") + 40  # within the chunk, behind the magic of zstd
    path.write_bytes(whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :])
    reader = LogReader(path)
    for _ in range(10):
        assert list(reader.newer()) == []
        assert reader.truncated
    path.write_bytes(whole)
    assert [entry.message.seq for entry in reader.newer((STATE,))] == list(range(50))


def test_other_mcap_tools_read_json_with_schemas_and_an_index(tmp_path: Path) -> None:
    """With the mcap package alone: what viewers such as Foxglove need, they find. It plays as fast
    as the car drove."""
    write(tmp_path / "log.mcap")
    with (tmp_path / "log.mcap").open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        first = {c.topic: (s, c, m) for s, c, m in reversed(list(reader.iter_messages()))}
        late = [m.sequence for _, _, m in reader.iter_messages([KEY], reverse=True)]
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == 53
    played_ns = summary.statistics.message_end_time - summary.statistics.message_start_time
    assert played_ns == 49 * 20_000_000
    assert summary.chunk_indexes
    assert {index.compression for index in summary.chunk_indexes} == {"zstd"}
    assert late[1:4] == [49, 48, 47]
    encodings = {(c.topic, c.message_encoding) for c in summary.channels.values()}
    unknown = "bayesrace/orca/unknown"
    assert encodings == {(KEY, "json"), (EVENT_KEY, "json"), (KEY, "msgpack"), (unknown, "msgpack")}
    for key, title in ((KEY, "State"), (EVENT_KEY, "Event")):
        schema, channel, message = first[key]
        assert channel.message_encoding == "json"
        assert schema is not None
        assert (schema.name, schema.encoding) == (title, "jsonschema")
        assert conforms(json.loads(message.data), json.loads(schema.data))
    assert json.loads(first[KEY][2].data)["x"] == dict.fromkeys(
        ("x", "y", "psi", "vx", "vy", "omega", "delta"), 0.0
    )


def test_a_log_cut_anywhere_gives_all_that_was_flushed(tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    writer, flushed = LogWriter(log, {"settings": {"track": "ethz"}}), [log.stat().st_size]
    for seq in range(20):
        writer.write(KEY, encode(state(seq)), time.monotonic_ns())
        writer.flush()
        flushed.append(log.stat().st_size)
    writer.close()
    whole = log.read_bytes()
    cut = tmp_path / "cut.mcap"
    for size in [*range(8, len(whole), 97), *flushed, len(whole) - 1]:
        cut.write_bytes(whole[:size])
        reader = LogReader(cut)
        count = sum(size >= end for end in flushed[1:])
        # A chunk is followed by its index, which the reader does not need.
        assert len(states := reader.select(STATE)) in (count, count + 1)
        assert states == [state(seq) for seq in range(len(states))]
        assert reader.truncated
        assert reader.metadata() == ({"settings": {"track": "ethz"}} if size >= flushed[0] else {})


def test_what_is_no_log_is_named(tmp_path: Path) -> None:
    (tmp_path / "x.mcap").write_bytes(b"something else entirely")
    with pytest.raises(InputError, match=r"x\.mcap is not an MCAP log"):
        LogReader(tmp_path / "x.mcap").select(STATE)
    with pytest.raises(InputError, match="no log at"):
        LogReader(tmp_path / "absent.mcap")
    with pytest.raises(InputError, match="cannot write the log"):
        LogWriter(tmp_path / "absent" / "x.mcap")


@pytest.mark.parametrize("compression", list(CompressionType))
def test_logs_that_other_tools_have_compressed_are_read(
    tmp_path: Path, compression: CompressionType
) -> None:
    write(tmp_path / "plain.mcap", 20)
    with (tmp_path / "log.mcap").open("wb") as file:
        writer = Writer(file, compression=compression)
        writer.start()
        channel = writer.register_channel("bayesrace/orca/state", "msgpack", 0)
        for seq in range(20):
            writer.add_message(channel, seq, encode(state(seq)), seq)
        writer.finish()
    log = LogReader(tmp_path / "log.mcap")
    assert log.select(STATE) == [state(seq) for seq in range(20)]
    assert not log.truncated


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_a_log_that_unpacks_to_gigabytes_is_refused_at_little_cost(
    tmp_path: Path, compression: CompressionType
) -> None:
    with (tmp_path / "bomb.mcap").open("wb") as file:
        writer = Writer(file, compression=compression, chunk_size=1 << 26)
        writer.start()
        channel = writer.register_channel("bayesrace/orca/state", "msgpack", 0)
        for k in range(6):
            writer.add_message(channel, k, bytes(1 << 26), k)
        writer.finish()
    assert (tmp_path / "bomb.mcap").stat().st_size < 1 << 22
    with pytest.raises(InputError, match=r"bomb\.mcap would unpack to many times its size"):
        LogReader(tmp_path / "bomb.mcap").select(STATE)


def test_a_chunk_that_lies_about_its_size_ends_the_log(tmp_path: Path) -> None:
    data = zstandard.ZstdCompressor().compress(bytes(1 << 28))
    chunk = Chunk("zstd", data, 0, 0, 0, 1000)
    with pytest.raises(ValueError, match="another length"):
        _unpacked(chunk)


@contextmanager
def recorded(path: Path) -> Iterator[tuple[Any, Publisher[State], Recorder]]:
    """A recorder that hears another session and its publisher of states."""
    endpoint = free_endpoint()
    with (
        open_session(Endpoints(listen=(endpoint,))) as other,
        open_session(Endpoints(connect=(endpoint,))) as session,
        Recorder(session, "orca", path) as recorder,
    ):
        publisher = Publisher(other, STATE, "orca")

        def connected() -> int:
            publisher.put(state(0), lockstep=True)
            return recorder.counters.written

        until(connected, "the recorder hears the other")
        yield other, publisher, recorder


def test_keys_without_end_do_not_fill_the_log(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with recorded(path) as (other, publisher, recorder):
        for k in range(1000):
            other.put(f"bayesrace/orca/nonsense/{k}", b"x")
        publisher.put(state(1), lockstep=True)
        until(lambda: recorder.counters.unrecorded, "keys beyond measure")
        recorder.drain()
        assert recorder.failed == ""
        assert recorder.counters.unrecorded > 700
    assert LogReader(path).select(STATE)[-1] == state(1)
    assert int(LogReader(path).metadata()["recorder"]["unrecorded"]) > 700


def test_a_log_that_is_deleted_is_a_failure(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with open_session(Endpoints(listen=(free_endpoint(),))) as session:
        recorder = Recorder(session, "orca", path)
        path.unlink()
        until(lambda: recorder.failed, "the recorder notices")
        with pytest.raises(InputError, match=r"log\.mcap: it has been deleted"):
            recorder.close()


def test_heartbeats_do_not_keep_a_recorder_from_settling(tmp_path: Path) -> None:
    stop = threading.Event()
    with recorded(tmp_path / "log.mcap") as (other, _, recorder):
        publisher = Publisher(other, HEARTBEAT, "orca", "plant")

        def beats() -> None:
            while not stop.wait(0.02):
                publisher.put(messages.status(seq=publisher.next_seq), lockstep=False)

        beating = threading.Thread(target=beats)
        beating.start()
        begin_s = time.monotonic()
        recorder.drain(at_most_s=20.0)
        waited_s = time.monotonic() - begin_s
        stop.set()
        beating.join()
    assert waited_s < 15.0
    assert len(LogReader(tmp_path / "log.mcap").select(HEARTBEAT)) > 2


def test_a_log_that_cannot_be_written_is_an_event(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    path = tmp_path / "log.mcap"
    with recorded(path) as (other, publisher, recorder):
        inbox = Inbox(other, "orca")
        inbox.subscribe(EVENT)

        probe = encode(messages.event(source="race"))

        def heard() -> object:
            recorder._session.put("bayesrace/orca/event/race", probe)
            return inbox.get(0.1)

        until(heard, "the other hears events of here")
        monkeypatch.setattr(LogWriter, "write", full)
        publisher.put(state(0), lockstep=True)
        until(lambda: recorder.failed, "the failure")
        while (item := inbox.get(20.0)) is not None and item.value.source == "race":
            pass
        assert item is not None
        event = item.value
        assert (event.source, event.kind) == ("recorder", "recorder_failed")
        assert f"cannot write the log {path}: No space left on device" in event.text
        with pytest.raises(InputError, match="No space left"):
            recorder.close()


def test_the_recorder_writes_everything_and_counts_gaps(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with recorded(path) as (_, publisher, recorder):
        # Lost ones, a late one, forged ones, a restart.
        sent = [*range(1, 2000), 2005, 2006, 2003, 10**10, 2007, 10**10, 0, 1, 2]
        for seq in sent:
            publisher.put(state(seq), lockstep=True)
        until(lambda: recorder.counters.written > len(sent), "all has come")
    assert recorder.counters.missing == 4
    assert recorder.gaps == [f"{KEY}: 5 missing before 2005"]
    states = LogReader(path).select(STATE)
    assert len(states) == recorder.counters.written
    assert [one.seq for one in states[-len(sent) :]] == sent
    assert {one.seq for one in states[: -len(sent)]} == {0}


WRITER = """
import sys, time
from pathlib import Path
from bayesrace.recorder import Recorder
from bayesrace.messages import STATE
from bayesrace.transport import Endpoints, Publisher, free_endpoint, open_session
from tests import sample_messages as messages
endpoint = free_endpoint()
with open_session(Endpoints(listen=(endpoint,))) as plant:
    with open_session(Endpoints(connect=(endpoint,))) as session:
        Recorder(session, "orca", Path(sys.argv[1]))
        publisher = Publisher(plant, STATE, "orca")
        for seq in range(10**6):
            publisher.put(messages.state(seq), lockstep=True)
            time.sleep(0.005)
"""


def test_a_killed_recorder_leaves_all_but_the_last_moment(tmp_path: Path) -> None:
    """While it records, the file already holds what came before, and goes on doing so."""
    path = tmp_path / "log.mcap"

    def newest() -> int:
        return max((one.seq for one in LogReader(path).select(STATE)), default=-1)

    process = subprocess.Popen([sys.executable, "-c", WRITER, str(path)], cwd=ROOT)
    try:
        until(path.exists, "a log")
        until(lambda: newest() >= 0, "messages in it")
        reached = newest()
        until(lambda: newest() > reached, "more of them")
        readable = newest()
    finally:
        process.kill()
        process.wait()
    log = LogReader(path)
    states = log.select(STATE)
    assert log.truncated
    assert states[-1].seq >= readable
    seqs = [s.seq for s in states]
    assert seqs == list(range(seqs[0], seqs[-1] + 1))


def test_columns_hold_the_fields_of_the_messages(tmp_path: Path) -> None:
    log, path = LogWriter(tmp_path / "log.mcap"), tmp_path / "log.mcap"
    x = np.arange(7.0)
    for seq in range(5):
        for car in ("red", "blue"):
            one = driven.state(2**40, seq, x + seq, np.array([0.1, 0.2]))
            log.write(f"bayesrace/{car}/state", encode(one), 20 * seq)
    counts = {"overruns": 3, "share": 0.5}
    status = blank(Status, source="plant", phase="idle", counters=counts, seen={})
    log.write("bayesrace/red/status/plant", encode(status), 100)
    log.close()
    beats = "source counters.overruns counters.share counters.other"
    columns = LogColumns(path, {STATE: "seq run x lockstep", HEARTBEAT: beats}, "red").read()
    states = columns[STATE]
    assert states["seq"].tolist() == list(range(5))
    assert set(states["run"]) == {2**40}
    assert np.array_equal(states["x"], x + np.arange(5.0)[:, None])
    assert states["lockstep"].all()
    assert np.diff(states["wall_ns"]).tolist() == [20] * 4
    assert np.diff(states["n"]).tolist() == [2] * 4
    assert columns[HEARTBEAT][beats.split()].tolist() == [("plant", 3, 0, 0)]
    assert len(LogColumns(path, {STATE: "seq"}).read()[STATE]) == 10


def test_a_long_log_takes_the_memory_of_its_columns(tmp_path: Path) -> None:
    """And reading ends after the most messages that are wanted."""
    log, path, count = LogWriter(tmp_path / "log.mcap"), tmp_path / "log.mcap", 20_000
    for seq in range(count):
        log.write("bayesrace/red/telemetry", encode(driven.telemetry(1, seq, 0)), seq)
    log.close()
    wanted = {TELEMETRY: "state_seq solve_us sensor_fault"}
    tracemalloc.start()
    found = LogColumns(path, wanted).read()[TELEMETRY]
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert found["state_seq"].tolist() == list(range(count))
    assert peak < 3 * found.nbytes + 2**23
    assert 5000 <= len(LogColumns(path, wanted, most=5000).read()[TELEMETRY]) < 10_000
