"""A recorder that cannot write any more does not touch the drive."""

import resource
from pathlib import Path

import pytest

from bayesrace.log import LogReader
from bayesrace.messages import STATE
from tests.programs import finish, start
from tests.test_drive_command import Waiting, course, ended, waiting

__all__ = ["course", "ended", "waiting"]

FULL = 600_000


def limited() -> None:
    """In place of a full disk: no file may be larger."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (FULL, FULL))


@pytest.mark.parametrize("options", [(), ("--max-log", "10MB")])
def test_a_full_disk_does_not_end_a_drive(
    tmp_path: Path, waiting: Waiting, options: tuple[str, ...]
) -> None:
    log = tmp_path / "drive.mcap"
    drive = start(
        "drive", *waiting.track, "--laps", "1000", "--max-time", "20", *options,
        *waiting.where, "--log", log,
        preexec_fn=limited,
    )  # fmt: skip
    waiting.ended.append(drive)
    done = finish(drive)
    assert done.returncode == 2
    assert f"cannot write the log {log}: File too large" in done.stderr
    assert "the run goes on without a log" in done.stderr
    assert "time limit of 20 s reached; not judged" in done.stderr, done.stderr
    assert LogReader(log).select(STATE)
