"""Processes that run beside what is measured: a bare loop, and busy processes.

The bare loop does nothing but sleep to absolute deadlines, at the same rate and with the same
scheduling. Its errors come from the machine, not from the program. As for the controller, a release
is missed when nothing could be done before the next one: here, when the loop wakes after that.
"""

import json
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bayesrace.clock import die_with_parent, sleep_until_ns
from bayesrace.realtime import RealtimeSettings, prepare_thread
from operation.processes import child
from studies.latency.results import BareLoop
from studies.latency.series import Series

__all__ = ["bare_loop", "bare_result", "read_bare_loop", "running_beside"]

_FILE: Final = "bare_loop.npy"


@contextmanager
def running_beside(
    out: Path, load: int, realtime: RealtimeSettings, rate_hz: float, begin_ns: int, count: int
) -> Iterator[None]:
    """A bare loop of ``count`` periods from ``begin_ns`` on, and ``load`` busy processes; at the
    block's end the loop's wake-up errors are in the folder ``out``."""
    line, module = ["--parent-pid", str(os.getpid())], "studies.latency.beside"
    loop = {"path": str(out / _FILE), "realtime": realtime.model_dump(), "count": count}
    loop |= {"period_ns": round(1e9 / rate_hz), "begin_ns": begin_ns}
    with ExitStack() as stack:
        for _ in range(load):
            stack.enter_context(child(line, out / "load.log", module))
        log = out / "bare_loop.log"
        bare = stack.enter_context(child([*line, json.dumps(loop)], log, module))
        yield
        bare.wait(1.0)


def read_bare_loop(out: Path, rate_hz: float) -> tuple[Series, BareLoop] | None:
    """Wake-up errors by time, and the numbers of the report; None if the loop never woke."""
    try:
        late_ns = np.load(out / _FILE)
        (out / _FILE).unlink()
    except (OSError, ValueError):
        return None
    refused = (out / "bare_loop.log").read_text(errors="replace").splitlines()
    return bare_result(late_ns, round(1e9 / rate_hz), refused) if len(late_ns) else None


def bare_result(
    late_ns: NDArray[np.int64], period_ns: int, refused: list[str]
) -> tuple[Series, BareLoop]:
    """The same from how late the loop woke at each release that was not passed over."""
    passed, count = late_ns // period_ns, len(late_ns)
    released_s = (np.arange(count) + np.cumsum(passed) - passed) * (period_ns * 1e-9)
    woken_s = released_s + late_ns * 1e-9
    series = Series(released_s.astype(np.float64), late_ns.astype(np.float64))
    skipped = int(passed.sum())
    return series, BareLoop(
        **series.distribution().model_dump(),
        misses=int((passed > 0).sum()),
        skipped=skipped,
        ticks=count + skipped,
        mean_period_us=float(np.ptp(woken_s)) * 1e6 / (count - 1) if count > 1 else None,
        refused=refused,
    )


def bare_loop(
    count: int,
    period_ns: int,
    begin_ns: int,
    ended: Callable[[], bool] = lambda: False,
    clock: Callable[[], int] = time.monotonic_ns,
    sleep: Callable[[int], None] = sleep_until_ns,
) -> NDArray[np.int64]:
    """Sleeps from release to release, ``count`` of them from ``begin_ns`` on or until it has
    ``ended``; how late it woke at each that was not passed over [ns]."""
    late_ns = np.full(count, -1, dtype=np.int64)  # filled: no page is touched first in the loop
    release_ns, end_ns, woken = begin_ns, begin_ns + count * period_ns, 0
    while release_ns < end_ns and not ended():
        sleep(release_ns)
        late = clock() - release_ns
        if late >= 0:  # otherwise a signal has ended the sleep
            late_ns[woken] = late
            woken += 1
            release_ns += (late // period_ns + 1) * period_ns
    return late_ns[:woken]


def _run(path: str, realtime: Any, count: int, period_ns: int, begin_ns: int) -> None:
    """The bare loop as a process; SIGTERM ends it early, and it keeps what it has measured."""
    signals: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _frame: signals.append(number))
    sys.stdout.writelines(f"{one}\n" for one in prepare_thread(RealtimeSettings(**realtime)))
    np.save(path, bare_loop(count, period_ns, begin_ns, lambda: bool(signals)))


if __name__ == "__main__":
    die_with_parent(int(sys.argv[2]))
    if sys.argv[3:]:
        _run(**json.loads(sys.argv[3]))
    else:
        while True:
            pass
