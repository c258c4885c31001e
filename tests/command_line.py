"""The command line in the tests' own process, which is faster than a process of its own."""

import logging
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import pytest

from bayesrace.operation.cli import main
from bayesrace.raceline import write_raceline
from bayesrace.raceline.line import RaceLine
from bayesrace.tracks import Track, write_track

__all__ = ["Cli", "Outcome", "cli", "course_files", "refused"]


@dataclass(frozen=True)
class Outcome:
    """Exit code and what was printed."""

    code: int
    out: str
    err: str


Cli = Callable[..., Outcome]


@pytest.fixture
def cli(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], tmp_path: Path) -> Cli:
    """Calls the program's entry point in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("NO_COLOR", "1")
    monkeypatch.setattr(logging, "basicConfig", lambda **_: None)

    def call(*arguments: str | Path) -> Outcome:
        monkeypatch.setattr(sys, "argv", ["bayesrace", *map(str, arguments)])
        capfd.readouterr()
        with pytest.raises(SystemExit) as end, patch.dict(os.environ):  # --config sets a variable
            main()
        code = end.value.code
        assert code is None or isinstance(code, int)
        return Outcome(code or 0, *capfd.readouterr())

    return call


def refused(outcome: Outcome, *words: str, code: int = 2) -> None:
    """Bad input: one line on stderr that names the thing and the remedy, and this exit code."""
    assert outcome.code == code, outcome.err
    assert outcome.err.startswith("bayesrace: ")
    assert len(outcome.err.strip().splitlines()) == 1, outcome.err
    assert "Traceback" not in outcome.err + outcome.out
    for word in words:
        assert word in outcome.err, outcome.err


def course_files(folder: Path, track: Track, line: RaceLine) -> tuple[str | Path, ...]:
    """Writes track and line; the options that name them."""
    files = folder / "track.csv", folder / "line.csv"
    write_track(files[0], track)
    write_raceline(files[1], line)
    return "--track", files[0], "--raceline", files[1]
