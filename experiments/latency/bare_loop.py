"""A loop that does nothing but sleep to absolute deadlines, to tell the machine's stalls.

It runs in a process of its own beside what is measured, at the same rate and with the same
scheduling, from before the time observed until its end. What it suffers is not the program's doing.
A release is missed, as the controller's is, when nothing could be done before the next one; here
that is when the loop wakes only after it.
"""

import argparse
import json
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

from hdrh.histogram import HdrHistogram

from bayesrace.clock import die_with_parent, sleep_until_ns
from bayesrace.errors import InputError
from bayesrace.realtime import RealtimeSettings, prepare_thread
from experiments.latency.histograms import distribution, new_histogram
from experiments.latency.results import BareLoop

__all__ = ["BareRun", "arguments", "read_bare_run", "run_bare_loop"]


@dataclass
class BareRun:
    """What the loop has seen."""

    histogram: Any = field(default_factory=new_histogram)
    """Wake-up errors [ns]."""
    misses: int = 0
    skipped: int = 0
    first_ns: int | None = None
    last_ns: int | None = None
    refused: list[str] = field(default_factory=list)

    @property
    def ticks(self) -> int:
        """Releases, those passed over included."""
        return int(self.histogram.get_total_count()) + self.skipped

    def result(self) -> BareLoop | None:
        """In numbers; None if it never woke."""
        found = distribution(self.histogram)
        if found is None:
            return None
        return BareLoop(
            **found.model_dump(),
            misses=self.misses,
            skipped=self.skipped,
            ticks=self.ticks,
            mean_period_us=self._mean_period_us(),
            refused=self.refused,
        )

    def _mean_period_us(self) -> float | None:
        periods = self.histogram.get_total_count() - 1
        if periods < 1 or self.first_ns is None or self.last_ns is None:
            return None
        return (self.last_ns - self.first_ns) * 1e-3 / float(periods)


def run_bare_loop(
    period_ns: int,
    begin_ns: int,
    end_ns: int,
    run: BareRun,
    clock: Callable[[], int] = time.monotonic_ns,
    sleep: Callable[[int], None] = sleep_until_ns,
) -> None:
    """Sleeps from release to release until ``end_ns``; counts those from ``begin_ns`` on."""
    release_ns = clock() + period_ns
    while release_ns < end_ns:
        sleep(release_ns)
        now_ns = clock()
        late_ns = now_ns - release_ns
        passed = late_ns // period_ns
        if release_ns >= begin_ns:
            run.histogram.record_value(late_ns)
            run.misses += passed > 0
            run.skipped += passed
            run.first_ns = run.first_ns or now_ns
            run.last_ns = now_ns
        release_ns += (passed + 1) * period_ns


def arguments(
    rate_hz: float, begin_ns: int, end_ns: int, realtime: RealtimeSettings, parent_pid: int
) -> list[str]:
    """Command line of this module as a process."""
    values = ["--rate", repr(rate_hz), "--begin-ns", str(begin_ns), "--end-ns", str(end_ns)]
    values += ["--parent-pid", str(parent_pid), "--realtime", realtime.model_dump_json()]
    return values


def read_bare_run(output: Path) -> BareRun:
    """What the process has written at its end; InputError with its words if it did not."""
    text = output.read_text(errors="replace").strip()
    try:
        content = json.loads(text.splitlines()[-1])
        run = BareRun(HdrHistogram.decode(content.pop("histogram")), **content)
    except (IndexError, TypeError, ValueError, KeyError):
        raise InputError(f"the bare loop did not end well: {text[-300:] or 'no word'}") from None
    return run


def main() -> None:
    """The process; SIGTERM ends it early, with what there is."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rate", type=float, required=True, help="[Hz]")
    parser.add_argument("--begin-ns", type=int, required=True, help="count from here on")
    parser.add_argument("--end-ns", type=int, required=True, help="monotonic clock")
    parser.add_argument("--realtime", default="{}", help="scheduling options, JSON")
    parser.add_argument("--parent-pid", type=int, default=None, help="end with this parent")
    given = parser.parse_args()
    die_with_parent(given.parent_pid)
    run = BareRun()
    run.refused = prepare_thread(RealtimeSettings.model_validate_json(given.realtime))
    with _ends_on_signal():
        run_bare_loop(round(1e9 / given.rate), given.begin_ns, given.end_ns, run)
    json.dump({**vars(run), "histogram": run.histogram.encode().decode()}, sys.stdout)
    sys.stdout.write("\n")


class _EndedError(Exception):
    """A signal arrived."""


@contextmanager
def _ends_on_signal() -> Iterator[None]:
    def on_signal(_number: int, _frame: FrameType | None) -> None:
        raise _EndedError

    signal.signal(signal.SIGTERM, on_signal)
    try:
        yield
    except _EndedError:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)


if __name__ == "__main__":
    main()
