"""The columns of a log hold what its messages hold, of one car or of all."""

import tracemalloc
from pathlib import Path

import numpy as np

from bayesrace.columns import LogColumns
from bayesrace.log import LogWriter
from bayesrace.messages import HEARTBEAT, STATE, TELEMETRY, Status, encode
from tests.driven import blank, state, telemetry


def test_columns_hold_the_fields_of_the_messages(tmp_path: Path) -> None:
    log, path = LogWriter(tmp_path / "log.mcap"), tmp_path / "log.mcap"
    x = np.arange(7.0)
    for seq in range(5):
        for car in ("red", "blue"):
            one = state(2**40, seq, x + seq, np.array([0.1, 0.2]))
            log.write(f"bayesrace/{car}/state", encode(one), 20 * seq)
    counts = {"overruns": 3, "share": 0.5}
    status = blank(Status, source="plant", phase="idle", counters=counts)
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
        log.write("bayesrace/red/telemetry", encode(telemetry(1, seq, 0)), seq)
    log.close()
    wanted = {TELEMETRY: "state_seq solve_us sensor_fault"}
    tracemalloc.start()
    found = LogColumns(path, wanted).read()[TELEMETRY]
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert found["state_seq"].tolist() == list(range(count))
    assert peak < 3 * found.nbytes + 2**23
    assert 5000 <= len(LogColumns(path, wanted, most=5000).read()[TELEMETRY]) < 10_000
