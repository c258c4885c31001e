"""What observers that stop reading cost: state to actuation, with and without them.

    python -m benchmarks.observers [--counts 1 5 50] [--seconds 20]

A learned car drives in real time over tcp. So many observers hear everything, then they are stopped
(SIGSTOP), as by Ctrl-Z; what is measured begins with that and lasts longer than the lease of their
links. Before each there is a stretch without any, with which it is compared.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
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
    given, rows = arguments(__doc__, counts=("1", "5", "50"), seconds=20.0), list[Row]()
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
        for number, count in enumerate(one for word in given.counts for one in (0, int(word))):
            with stopped(count, where):
                times_ms, gap = stretch(system, folder / f"{number}.mcap", given.seconds)
            row = {"observers": count, **percentiles(times_ms), "longest gap, periods": gap}
            rows.append(row)
        system.director.stop("measured")
    report(given, "state to actuation [ms], observers stopped", rows)


if __name__ == "__main__":
    main()
