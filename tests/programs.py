"""The command line as its users have it: programs of their own, found again in /proc.

What a race starts carries the race's process number in its arguments (``--parent-pid``), so that
an orphan can be recognised whatever became of the race.
"""

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from bayesrace.tracks import Track, write_track

__all__ = [
    "COMMAND",
    "PATIENCE_S",
    "ROOT",
    "Race",
    "campaign_scheduler",
    "environment",
    "finish",
    "leftovers",
    "peanut",
    "run",
    "start",
    "started_by",
    "until",
]

ROOT: Final = Path(__file__).resolve().parents[1]
COMMAND: Final = (sys.executable, "-m", "bayesrace.operation.cli")
PATIENCE_S: Final = 240.0
"""For what takes seconds on an idle machine; the tests' machine is not idle."""


def environment() -> dict[str, str]:
    """A wide terminal without colours, so that no cell of a table is wrapped."""
    return {**os.environ, "COLUMNS": "200", "NO_COLOR": "1", "TERM": "dumb"}


def start(*arguments: str | Path, **popen: Any) -> subprocess.Popen[str]:
    """Starts ``bayesrace`` with these arguments, in the checkout, outputs captured as text."""
    options: dict[str, Any] = {
        "stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE,
        "cwd": ROOT, "env": environment(), **popen,
    }  # fmt: skip
    return subprocess.Popen([*COMMAND, *map(str, arguments)], text=True, **options)


def run(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Runs ``bayesrace`` to its end, whatever the exit code."""
    return finish(start(*arguments))


def finish(process: subprocess.Popen[str]) -> subprocess.CompletedProcess[str]:
    """Waits for the end and collects the outputs; kills what does not end."""
    try:
        out, err = process.communicate(timeout=PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        raise
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


def until(
    true: Callable[[], object], what: str, seconds: float = PATIENCE_S, every_s: float = 0.02
) -> None:
    """Waits until the condition holds; an AssertionError naming it if it never does.

    ``every_s``: longer for a condition that takes the processor from what it waits for.
    """
    deadline = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < deadline, f"not within {seconds:g} s: {what}"
        time.sleep(every_s)


def _arguments(pid: str) -> list[str]:
    try:
        return (Path("/proc") / pid / "cmdline").read_bytes().decode().split("\0")
    except OSError:  # it has just ended
        return []


def started_by(race: int) -> dict[str, int]:
    """Subcommand to process number of what that race started and still runs."""
    found = {}
    for entry in Path("/proc").glob("[0-9]*"):
        words = _arguments(entry.name)
        if "--parent-pid" in words and words[words.index("--parent-pid") + 1] == str(race):
            found[words[words.index("bayesrace.operation.cli") + 1]] = int(entry.name)
    return found


def leftovers(race: int, seconds: float = 20.0) -> dict[str, int]:
    """What still runs of a race that is over, after a while to end."""
    deadline = time.monotonic() + seconds
    while (alive := started_by(race)) and time.monotonic() < deadline:
        time.sleep(0.05)
    return alive


@contextmanager
def campaign_scheduler(folder: Path) -> Iterator[tuple[str, Path]]:
    """Address and key of a scheduler for campaigns, which makes the key in the folder."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address, key = f"tls://127.0.0.1:{port}", folder / "campaign.pem"
    output = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    process = start("campaign-scheduler", "--key", key, "--listen", address, **output)

    def listens() -> bool:
        with suppress(OSError), socket.create_connection(("127.0.0.1", port)):
            return True
        return False

    try:
        until(listens, "the scheduler")
        yield address, key
    finally:
        process.terminate()
        process.wait()


def peanut(path: Path) -> Path:
    """Writes a circuit of 6.4 m: the shortest race."""
    angle = np.linspace(0, 2 * np.pi, 160, endpoint=False)
    radius = 0.8 + 0.32 * np.cos(2 * angle)
    points = np.column_stack([1.15 * radius * np.cos(angle), radius * np.sin(angle)])
    write_track(path, Track.from_points("peanut", points, 0.16, 0.18))
    return path


@dataclass
class Race:
    """A race that ran to its end."""

    out: Path
    pid: int
    process: subprocess.CompletedProcess[str]

    @classmethod
    def running(cls, out: Path, *arguments: str | Path, **variables: str) -> Callable[[], "Race"]:
        """Starts a race, with these variables in its environment; call the result to wait. It
        drives no bayesrace-limit unless that is asked for."""
        process = start(
            "race",
            "--out",
            out,
            "--progress-drives",
            "0",
            *arguments,
            env={**environment(), **variables},
        )

        def wait() -> Race:
            done = finish(process)
            assert done.returncode == 0, done.stderr
            return cls(out, process.pid, done)

        return wait

    @property
    def result(self) -> dict[str, Any]:
        """Content of result.json."""
        content: dict[str, Any] = json.loads((self.out / "result.json").read_text())
        return content

    def lap(self, controller: str) -> dict[str, Any]:
        """That controller's entry."""
        found: dict[str, Any] = next(
            lap for lap in self.result["laps"] if lap["controller"] == controller
        )
        return found
