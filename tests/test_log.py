"""The log's promise: complete, typed, and readable up to the last second whatever happened."""

import subprocess
import sys
import time
from pathlib import Path

import pytest
from mcap.reader import make_reader

from bayesrace.errors import InputError
from bayesrace.log import LogReader, LogWriter, Recorder
from bayesrace.messages import EVENT, STATE, Event, State, encode
from bayesrace.transport import Endpoints, Publisher, free_endpoint, open_session
from tests.programs import ROOT, until

KEY = "bayesrace/orca/state"


def state(seq: int) -> State:
    return State(seq, 0, 0, 1, 0.02 * seq, (0.0,) * 7, (0.0, 0.0), 0, True, (), False)


def write(path: Path, count: int = 50) -> None:
    writer = LogWriter(path, {"settings": {"track": "ethz"}})
    for seq in range(count):
        writer.write(KEY, encode(state(seq)), time.monotonic_ns(), seq)
    event = Event(0, 0, 1, "plant", "run_ended", "done", {"laps": 1})
    writer.write("bayesrace/orca/event/plant", encode(event), time.monotonic_ns())
    writer.write(KEY, b"junk", time.monotonic_ns())
    writer.write("bayesrace/orca/unknown", b"junk", time.monotonic_ns())
    writer.add_metadata("manifest", {"scheme": "rk4"})
    writer.close()


def test_a_log_gives_back_typed_messages_and_metadata(tmp_path: Path) -> None:
    write(tmp_path / "log.mcap")
    log = LogReader(tmp_path / "log.mcap")
    entries = list(log.messages())
    assert [entry.message for entry in entries[:50]] == [state(seq) for seq in range(50)]
    assert entries[50].key == "bayesrace/orca/event/plant"
    assert log.select(EVENT)[0].data == {"laps": 1}
    assert log.metadata() == {"settings": {"track": "ethz"}, "manifest": {"scheme": "rk4"}}
    assert not log.truncated
    assert len(log.select(STATE)) == 50
    assert log.refused == 1
    assert "State" in log.last_reason
    assert abs(entries[0].log_time_ns - time.time_ns()) < 60e9


def test_other_mcap_tools_can_read_it(tmp_path: Path) -> None:
    write(tmp_path / "log.mcap")
    with (tmp_path / "log.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == 53
    assert {s.name: s.encoding for s in summary.schemas.values()} == {
        "State": "jsonschema",
        "Event": "jsonschema",
    }
    assert {c.message_encoding for c in summary.channels.values()} == {"msgpack"}


def test_a_log_cut_anywhere_gives_all_whole_messages(tmp_path: Path) -> None:
    write(tmp_path / "log.mcap", 20)
    whole = (tmp_path / "log.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    seen = 0
    for size in [*range(8, len(whole), 97), len(whole) - 1]:
        cut.write_bytes(whole[:size])
        log = LogReader(cut)
        states = log.select(STATE)
        assert states == [state(seq) for seq in range(len(states))]
        assert len(states) >= seen
        assert log.truncated
        seen = len(states)
    assert seen == 20


def test_what_is_no_log_is_named(tmp_path: Path) -> None:
    (tmp_path / "x.mcap").write_bytes(b"something else entirely")
    with pytest.raises(InputError, match=r"x\.mcap is not an MCAP log"):
        LogReader(tmp_path / "x.mcap").select(STATE)
    with pytest.raises(InputError, match="no log at"):
        LogReader(tmp_path / "absent.mcap")
    with pytest.raises(InputError, match="cannot write the log"):
        LogWriter(tmp_path / "absent" / "x.mcap")


def test_the_recorder_writes_everything_and_counts_gaps(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    path = tmp_path / "log.mcap"
    with (
        open_session(Endpoints(listen=(endpoint,))) as plant,
        open_session(Endpoints(connect=(endpoint,))) as session,
        Recorder(session, "orca", path, {"settings": {"seed": "1"}}) as recorder,
    ):
        publisher = Publisher(plant, STATE, "orca")
        counters = recorder.counters

        def connected() -> int:
            publisher.put(state(0), lockstep=True)
            return counters.written

        until(connected, "the recorder hears the plant")
        sent = [*range(1, 2000), 2005, 2006, 2003, 0, 1, 2]
        for seq in sent:
            publisher.put(state(seq), lockstep=True)
        # Each 0 but the very first is a restart.
        until(lambda: counters.written - counters.restarts >= len(sent), "all has come")
    assert (counters.missing, counters.disordered) == (5, 1)
    assert recorder.gaps == [f"{KEY}: 2000 to 2004 missing"]
    assert counters.restarts >= 1
    states = LogReader(path).select(STATE)
    assert len(states) == counters.written
    assert [one.seq for one in states[-len(sent) :]] == sent
    assert {one.seq for one in states[: -len(sent)]} == {0}


WRITER = """
import sys, time
from pathlib import Path
from bayesrace.log import Recorder
from bayesrace.messages import STATE, State
from bayesrace.transport import Endpoints, Publisher, free_endpoint, open_session
endpoint = free_endpoint()
with open_session(Endpoints(listen=(endpoint,))) as plant:
    with open_session(Endpoints(connect=(endpoint,))) as session:
        Recorder(session, "orca", Path(sys.argv[1]))
        publisher = Publisher(plant, STATE, "orca")
        for seq in range(10**6):
            state = State(seq, 0, 0, 1, 0.0, (0.0,) * 7, (0.0, 0.0), 0, True, (), False)
            publisher.put(state, lockstep=True)
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
