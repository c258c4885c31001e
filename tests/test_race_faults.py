"""A race that breaks off says why, leaves a log that can be read, and no process behind.

Each test starts a real race on a short track and spoils it in the middle of a lap.
"""

import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from bayesrace.errors import InputError
from bayesrace.log import LogReader
from bayesrace.messages import EVENT, STATE, Event, State
from tests.programs import finish, leftovers, peanut, run, start, started_by, until

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc")

ENOUGH = 60
"""States in the log after which a lap is in progress."""


def states_of(log: Path) -> list[State]:
    try:
        return LogReader(log).select(STATE)
    except InputError:  # not there yet
        return []


@dataclass
class Racing:
    """A race that is in the middle of a lap, of which there are more than anybody waits for."""

    out: Path
    process: subprocess.Popen[str]
    children: dict[str, int]
    spoilt_ns: int = 0

    def spoil(self, what: str, number: int) -> None:
        """Sends the signal to "race", its whole "group", or a child by its subcommand."""
        self.spoilt_ns = time.monotonic_ns()
        if what == "group":
            os.killpg(self.process.pid, number)
        else:
            os.kill({"race": self.process.pid, **self.children}[what], number)

    def end(self) -> tuple[int, str]:
        """Waits for it; exit code and what was said on stderr, which is one line or nothing."""
        done = finish(self.process)
        said = done.stderr.strip()
        assert "Traceback" not in said
        assert len(said.splitlines()) <= 1, said
        assert leftovers(self.process.pid) == {}
        return done.returncode, said

    def assert_log_explains(self, *, ended_by_plant: bool) -> Event | None:
        """The log is whole up to the last moment; the plant's last word, if it could say one."""
        reader = LogReader(self.out / "run.mcap")
        states = reader.select(STATE)
        assert len(states) >= ENOUGH
        assert reader.refused == 0
        numbers = [state.seq for state in states]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        # Five seconds for a busy machine; a file that is never flushed would be empty.
        assert states[-1].source_time_ns > self.spoilt_ns - 5_000_000_000
        ends = [event for event in reader.select(EVENT) if event.kind == "run_ended"]
        assert bool(ends) is ended_by_plant
        return ends[-1] if ends else None

    def assert_report_shows_it(self) -> None:
        """``bayesrace report`` works on what there is: the run that broke off is the last one."""
        done = run("report", self.out)
        assert done.returncode == 0, done.stderr
        laps = json.loads((self.out / "result.json").read_text())["laps"]
        assert f"{laps[-1]['controller']} failed: 0 of " in done.stdout
        assert laps[-1]["ended"]
        assert sum(lap["samples"] for lap in laps) >= ENOUGH
        assert (self.out / "report.html").stat().st_size > 10_000


def begin(folder: Path, *options: str, **how: Any) -> subprocess.Popen[str]:
    """Starts a race on a short track into the folder ``out``, without runs at the limit."""
    track = peanut(folder / "peanut.csv")
    tracks = ("--track", track, "--train-track", track, "--progress-drives", "0")
    return start("race", "--out", folder / "out", *tracks, *options, **how)


@pytest.fixture
def racing(tmp_path: Path) -> Iterator[Racing]:
    process, out = begin(tmp_path, "--laps", "100", start_new_session=True), tmp_path / "out"

    def driving() -> bool:
        assert process.poll() is None, process.communicate()
        return len(states_of(out / "run.mcap")) >= ENOUGH

    try:
        until(driving, "a lap in progress", every_s=0.3)
        yield Racing(out, process, started_by(process.pid))
    finally:
        if process.poll() is None:
            process.kill()
        process.communicate()
        for pid in leftovers(process.pid).values():
            os.kill(pid, signal.SIGKILL)


def test_a_race_is_two_more_processes(racing: Racing) -> None:
    """Ctrl-C at a terminal reaches every process in the foreground: the race ends all in order."""
    assert sorted(racing.children) == ["controller", "plant"]
    racing.spoil("group", signal.SIGINT)
    assert racing.end() == (130, "bayesrace: interrupted")
    racing.assert_log_explains(ended_by_plant=True)
    racing.assert_report_shows_it()


@pytest.mark.check
@pytest.mark.parametrize(
    ("what", "number", "code", "words", "ended_by_plant"),
    [
        ("race", signal.SIGINT, 130, "bayesrace: interrupted", True),
        ("plant", signal.SIGKILL, 1, "plant was killed by signal 9", False),
        ("plant", signal.SIGTERM, 1, "", True),
        ("controller", signal.SIGKILL, 1, "was killed by signal 9", True),
    ],
)
def test_a_process_that_ends_ends_the_race_and_is_named(
    racing: Racing, what: str, number: int, code: int, words: str, ended_by_plant: bool
) -> None:
    racing.spoil(what, number)
    found, said = racing.end()
    assert found == code
    assert words in said
    assert what in said
    end = racing.assert_log_explains(ended_by_plant=ended_by_plant)
    if what == "controller":
        assert "plant was killed" not in said
        assert end is not None
        assert end.data["reason"] == "controller_lost"
    racing.assert_report_shows_it()


@pytest.mark.check
def test_a_killed_race_takes_its_processes_along(racing: Racing) -> None:
    racing.spoil("race", signal.SIGKILL)
    code, said = racing.end()
    assert (code, said) == (-signal.SIGKILL, "")
    assert LogReader(racing.out / "run.mcap").select(STATE)
    racing.assert_report_shows_it()


@pytest.mark.check
def test_an_interrupt_before_the_first_lap(tmp_path: Path) -> None:
    process = begin(tmp_path)
    until(lambda: (tmp_path / "out" / "settings.json").exists(), "the race at work")
    process.send_signal(signal.SIGINT)
    done = finish(process)
    assert done.returncode == 130
    assert done.stderr.strip() == "bayesrace: interrupted"
    assert leftovers(process.pid) == {}


@pytest.mark.check
def test_a_full_disk_ends_the_race_at_once_and_the_file_is_named(tmp_path: Path) -> None:
    """Instead of a disk: no file may be larger."""
    limit = 1_500_000

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    process = begin(tmp_path, "--laps", "100", preexec_fn=limited)
    done = finish(process)
    assert done.returncode == 2
    log = tmp_path / "out" / "run.mcap"
    assert f"cannot write the log {log}: File too large" in done.stderr
    assert leftovers(process.pid) == {}
    assert states_of(log)


@pytest.mark.check
def test_a_pause_of_three_seconds_ends_nothing(tmp_path: Path) -> None:
    """A host that stalls, a laptop that is closed for a moment."""
    process, log = begin(tmp_path, "--laps", "1"), tmp_path / "out" / "run.mcap"
    for name in ("plant", "controller"):
        driven = len(states_of(log))
        until(lambda: len(states_of(log)) > driven + ENOUGH, "a lap", every_s=0.3)  # noqa: B023
        victim = started_by(process.pid)[name]
        os.kill(victim, signal.SIGSTOP)
        time.sleep(3.0)
        os.kill(victim, signal.SIGCONT)
    done = finish(process)
    assert done.returncode == 0, done.stderr
    laps = json.loads((tmp_path / "out" / "result.json").read_text())["laps"]
    assert len(laps) == 4
