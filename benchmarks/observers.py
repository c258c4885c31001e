"""What observers cost: state to actuation, with and without them.

    python -m benchmarks.observers [--counts 1 5 50] [--pages 5] [--seconds 20]

A learned car drives in real time over tcp. So many observers hear everything, then they are stopped
(SIGSTOP), as by Ctrl-Z; what is measured begins with that and lasts longer than the lease of their
links. Or so many pages are open at 'bayesrace view --live'; who takes their messages does nothing
with them, as a browser on another machine. Before each there is a stretch without any, with which
it is compared.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.configuration import Configuration
from bayesrace.log import LogReader
from bayesrace.messages import STATE
from bayesrace.operation.run_plan import RunPlan, run_request
from bayesrace.operation.system import System, started_system
from bayesrace.recorder import Recorder
from bayesrace.tracks import DEFAULT_RACE_TRACK
from bayesrace.transport import free_endpoint
from bayesrace.vehicles import DEFAULT_CAR
from benchmarks.harness import Row, arguments, percentiles, prepared, report


@contextmanager
def stopped(count: int, where: tuple[str, ...]) -> Iterator[None]:
    """That many observers, which have been stopped; none for 0."""
    if not count:
        yield
        return
    line = [sys.executable, "-m", "tests.network.bystander", str(count), "-", *where]
    with subprocess.Popen(line, stdout=subprocess.PIPE) as process:
        try:
            if process.stdout is not None:
                process.stdout.readline()
            os.kill(process.pid, signal.SIGSTOP)
            yield
        finally:
            process.kill()


_PAGES = """
import sys, threading
from websockets.sync.client import connect
def look():
    for message in connect(sys.argv[2].replace("http", "ws") + "updates", max_size=None): pass
for _ in range(int(sys.argv[1])): threading.Thread(target=look).start()
"""


@contextmanager
def viewed(count: int, where: tuple[str, ...]) -> Iterator[None]:
    """That many pages of a live view; none for 0."""
    if not count:
        yield
        return
    view = [sys.executable, "-m", "bayesrace.operation.cli", "view", "--live", "--port", "0"]
    view += [word for one in where for word in ("--endpoint", one)]
    with TemporaryDirectory() as empty, ExitStack() as stack:
        serving = stack.enter_context(subprocess.Popen(view, stdout=subprocess.PIPE, cwd=empty))
        stack.callback(serving.kill)
        address = serving.stdout.readline().decode().split()[0] if serving.stdout else ""
        pages = [sys.executable, "-c", _PAGES, str(count), address]
        stack.callback(stack.enter_context(subprocess.Popen(pages)).kill)
        time.sleep(5)  # until the viewer has found the car, and the pages show it
        yield


def stretch(system: System, file: Path, seconds: float) -> tuple[Floats, int]:
    """Times from a state to its actuation's arrival [ms], and the longest gap in periods."""
    with Recorder(system.session, DEFAULT_CAR, file):
        time.sleep(seconds)
    states = LogReader(file).select(STATE)
    rows = np.concatenate([np.reshape(one.actuation_delays, (-1, 3)) for one in states])
    answered = np.array([len(one.actuation_delays) > 0 for one in states])
    gaps = np.diff(np.flatnonzero(np.concatenate(([True], answered, [True]))))
    return rows[:, 1] * 1e3, int(gaps.max()) - 1


def main() -> None:
    """Drives without end, with more and more observers."""
    rows: list[Row]
    given, rows = arguments(__doc__, counts=("1", "5", "50"), pages=("5",), seconds=20.0), []
    made, where = prepared(DEFAULT_RACE_TRACK), (free_endpoint(), free_endpoint())
    with (
        TemporaryDirectory() as name,
        started_system(
            DEFAULT_CAR, folder := Path(name), configuration=Configuration().plain(*where)
        ) as system,
        system.controller(made.arguments),
    ):
        plan = RunPlan(1, "", 0, 1e5, lockstep=False)
        system.director.start(run_request(made.first.track, plan))
        tried = [(stopped, int(word)) for word in given.counts]
        tried += [(viewed, int(word)) for word in given.pages]
        for number, (kind, most) in enumerate(tried):
            for count in (0, most):
                with kind(count, where):
                    log = folder / f"{number}-{count}.mcap"
                    times_ms, gap = stretch(system, log, given.seconds)
                row = {"observers": f"{count} {'pages' if kind is viewed else 'stopped'}"}
                rows.append({**row, **percentiles(times_ms), "longest gap, periods": gap})
        system.director.stop("measured")
    report(given, "state to actuation [ms], with observers", rows)


if __name__ == "__main__":
    main()
