"""A log of limited size: the newest parts stay, each can be read alone, all are one recording."""

import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from bayesrace.controller.assembly import PredictiveController
from bayesrace.controller.native_step import NativeStep
from bayesrace.errors import InputError
from bayesrace.log import LogReader, LogWriter
from bayesrace.log_parts import log_size, part_files
from bayesrace.log_rotation import RotatingLog
from bayesrace.messages import ACTUATION, EVENT, STATE, TELEMETRY, TRUTH, State, Topic, encode
from bayesrace.operation.analysis.laps import judge, judge_log, laps_in
from bayesrace.operation.closed_loop import ClosedLoop
from bayesrace.vehicles import Car
from tests import sample_messages as messages
from tests.command_line import Cli, refused
from tests.conftest import Circuit
from tests.test_log import EVENT_KEY, KEY

RACE_KEY = "bayesrace/orca/event/race"
LIMIT = 80_000


def state(seq: int) -> State:
    """One that compresses badly, as those of a car do."""
    x = tuple(np.random.default_rng(seq).normal(size=7).tolist())
    return messages.state(seq, epoch=0, time_s=0.02 * seq, lockstep=True, x=x)


def announce(log: RotatingLog, number: int) -> None:
    accepted = messages.event(seq=2 * number, source="controller", kind="weights_accepted", run=0)
    log.write("bayesrace/orca/event/controller", encode(accepted), time.monotonic_ns())
    run = messages.event(seq=number, source="race", kind="run", data={"run": number})
    log.write(RACE_KEY, encode(run), time.monotonic_ns())


@contextmanager
def rotating(path: Path, limit: int | None = LIMIT) -> Iterator[RotatingLog]:
    with closing(RotatingLog(path, {"drive": {"track": "ethz"}}, limit)) as log:
        yield log


def fill(log: RotatingLog, begin: int, end: int) -> None:
    for seq in range(begin, end):
        log.write(KEY, encode(state(seq)), time.monotonic_ns())
        if seq % 50 == 0:
            log.flush()


def sizes(path: Path) -> int:
    return sum(one.stat().st_size for one in part_files(path).values())


def test_the_newest_parts_stay_within_the_limit_and_are_read_as_one(tmp_path: Path) -> None:
    path, most = tmp_path / "run.mcap", 0
    with rotating(path) as log:
        announce(log, 1)
        for begin in range(0, 3000, 100):
            fill(log, begin, begin + 100)
            most = max(most, sizes(path))
        log.add_metadata("recorder", {"written": "3000"})
    assert LIMIT / 2 < most <= LIMIT
    assert log.deleted > 3
    assert not path.exists()
    reader = LogReader(path)
    seqs = [one.seq for one in reader.select(STATE)]
    assert seqs == list(range(seqs[0], 3000))
    assert len(seqs) > 200
    assert (reader.truncated, reader.refused) == (False, 0)
    assert reader.parts_gone == log.deleted == min(part_files(path))
    # What was announced in a part that is deleted is there, once.
    assert [one.kind for one in reader.select(EVENT)] == ["weights_accepted", "run"]
    assert {"drive", "recorder"} <= set(reader.metadata())


def test_each_part_can_be_opened_alone_by_any_tool(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with rotating(path) as log:
        announce(log, 1)
        fill(log, 0, 1000)
        announce(log, 2)
        fill(log, 1000, 2000)
    ends: list[int] = []
    for file in part_files(path).values():
        alone = LogReader(file)
        assert alone.metadata()["drive"] == {"track": "ethz"}
        assert alone.select(EVENT)[-1].data == {"run": 2}
        assert alone.select(STATE)
        with file.open("rb") as stream:
            summary = make_reader(stream).get_summary()
        assert summary is not None
        assert summary.statistics is not None
        ends += [summary.statistics.message_start_time, summary.statistics.message_end_time]
    assert ends == sorted(ends)


def test_a_reader_that_follows_misses_and_repeats_nothing(tmp_path: Path) -> None:
    path, found = tmp_path / "run.mcap", list[int]()
    events: list[str] = []
    with rotating(path) as log:
        announce(log, 1)
        log.flush()
        reader = LogReader(path)
        for begin in range(0, 1500, 75):
            fill(log, begin, begin + 75)
            for entry in reader.newer():
                if isinstance(entry.message, State):
                    found.append(entry.message.seq)
                else:
                    events.append(entry.message.kind)
    found += [one.message.seq for one in reader.newer((STATE,))]
    assert found == list(range(1500))
    assert events == ["weights_accepted", "run"]
    assert log.deleted > 1


def test_a_number_of_a_channel_is_another_key_in_the_next_part(tmp_path: Path) -> None:
    """It stays so where reading goes on."""
    path = tmp_path / "run.mcap"
    with rotating(path) as log:
        fill(log, 0, 1)
        reader = LogReader(path)
        while log.path == path:
            log.write(KEY, encode(state(1)), time.monotonic_ns())
            log.flush()
        log.write("bayesrace/orca/unknown", b"junk", time.monotonic_ns())
        log.flush()
        assert list(reader.newer())
        log.write("bayesrace/orca/unknown", b"junk", time.monotonic_ns())
        log.flush()
        assert not list(reader.newer())
    assert reader.refused == 0


def test_a_reader_that_falls_behind_goes_on_with_what_is_left(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with rotating(path) as log:
        fill(log, 0, 60)
        log.flush()
        reader = LogReader(path)
        before = [one.message.seq for one in reader.newer((STATE,))]
        announce(log, 7)
        fill(log, 60, 1500)
    after = [one.message for one in reader.newer((STATE, EVENT))]
    seqs = [one.seq for one in after if isinstance(one, State)]
    assert before == list(range(60))
    assert seqs == list(range(seqs[0], 1500))
    assert {"run": 7} in [one.data for one in after if not isinstance(one, State)]


def test_a_recording_cut_off_in_its_last_part(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    log = RotatingLog(path, None, LIMIT)
    fill(log, 0, 1001)  # its last chunk is flushed; it is never finished
    reader = LogReader(path)
    assert reader.select(STATE)[-1].seq == 1000
    assert reader.truncated


def test_a_new_recording_replaces_the_parts_of_the_one_before(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with rotating(path) as log:
        fill(log, 0, 1500)
    old = set(part_files(path).values())
    with rotating(path, None) as log:
        fill(log, 0, 10)
    assert part_files(path) == {0: path}
    assert len(old) > 3
    assert len(LogReader(path).select(STATE)) == 10


def test_files_of_others_with_such_names_are_neither_read_nor_replaced(tmp_path: Path) -> None:
    path, other = tmp_path / "run.mcap", tmp_path / "run.1.mcap"
    with closing(LogWriter(other)) as writer:
        writer.write(EVENT_KEY, encode(messages.event()), 0)
    with rotating(path, None) as log:
        fill(log, 0, 10)
    assert LogReader(path).channels() == {KEY}
    with pytest.raises(InputError, match=r"run\.1\.mcap is no part of .*run\.mcap .*move it"):
        RotatingLog(path, None, LIMIT)
    assert LogReader(other).select(EVENT)


def test_parts_of_two_recordings_are_not_mixed(tmp_path: Path) -> None:
    one, two = tmp_path / "one.mcap", tmp_path / "two.mcap"
    for path in (one, two):
        with rotating(path) as log:
            fill(log, 0, 60 if path == one else 1500)
    last = max(part_files(two))
    (tmp_path / f"two.{last}.mcap").rename(tmp_path / f"one.{last}.mcap")
    assert [state.seq for state in LogReader(one).select(STATE)] == list(range(60))


@pytest.mark.parametrize(
    ("text", "size"), [("500MB", 500_000_000), ("2GB", 2_000_000_000), ("1 GiB", 1 << 30)]
)
def test_sizes(text: str, size: int) -> None:
    assert log_size(text) == size


@pytest.mark.parametrize("text", ["", "much", "5MB", "-1GB", "1e3", "500MW"])
def test_what_is_no_size_is_refused(cli: Cli, text: str) -> None:
    refused(cli("drive", "--max-log", text), "--max-log", "500MB")


def test_a_run_whose_beginning_is_deleted_is_judged_by_what_is_left(
    native: NativeStep, circuit: Circuit, car: Car, tmp_path: Path
) -> None:
    """Laps before are counted, as the plant has counted them; none is timed in part."""
    whole, limited, laps = tmp_path / "whole.mcap", tmp_path / "limited.mcap", 12
    with closing(LogWriter(whole)) as log:
        controller = PredictiveController(native)
        ClosedLoop(car, circuit.track, circuit.line, controller, log=log).drive(laps)
    copied: list[Topic[Any]] = [STATE, TRUTH, ACTUATION, TELEMETRY, EVENT]
    with rotating(limited, whole.stat().st_size // 2) as shorter:
        for number, entry in enumerate(LogReader(whole).messages(copied)):
            shorter.write(entry.key, encode(entry.message), number)
            if number % 200 == 0:
                shorter.flush()
    every, kept = (laps_in(path, 1, circuit.track) for path in (whole, limited))
    assert shorter.deleted > 0
    assert every.laps.before == 0
    assert 2 <= len(kept.laps.times_s) < laps - 1
    assert kept.laps.count == every.laps.count == laps
    assert kept.laps.times_s == every.laps.times_s[-len(kept.laps.times_s) :]
    on_track = np.minimum(kept.off_track_m, 0.0)  # the line of this circuit leaves it
    verdict = judge(*kept._replace(off_track_m=on_track), laps)
    assert verdict.passed
    assert f"{kept.laps.before} laps before these are not in the log any more" in verdict.text
    assert f"{laps} of {laps + 1} laps" in judge_log(limited, 1, circuit.track, laps + 1).text
