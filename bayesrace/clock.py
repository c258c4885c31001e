"""The monotonic clock: sleeping to an absolute deadline, and ending with a parent process.

Wall-clock time is never used to measure: it jumps.
"""

import ctypes
import os
import signal
import sys
import time
from typing import Any, Final

__all__ = ["SUSPENDED_S", "die_with_parent", "sleep_until_ns", "suspension"]

SUSPENDED_S: Final = 1.0
"""A wait that ends so much later than it should: the process has not run."""

_PR_SET_PDEATHSIG: Final = 1
_CLOCK_MONOTONIC: Final = 1
_TIMER_ABSTIME: Final = 1


class _Timespec(ctypes.Structure):
    _fields_ = [("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long)]


def _find_nanosleep() -> Any:
    return ctypes.CDLL(None).clock_nanosleep if sys.platform.startswith("linux") else None


_nanosleep: Final = _find_nanosleep()


def sleep_until_ns(deadline_ns: int) -> None:
    """Sleep until ``time.monotonic_ns()`` reaches the deadline; at once if it has passed.

    Absolute where the system can (``clock_nanosleep``): a thread that is held up between reading
    the clock and sleeping wakes in time all the same. A signal ends the sleep, as it must.
    """
    if _nanosleep is not None:
        if deadline_ns > time.monotonic_ns():
            until = _Timespec(*divmod(deadline_ns, 1_000_000_000))
            _nanosleep(_CLOCK_MONOTONIC, _TIMER_ABSTIME, ctypes.byref(until), None)
        return
    left_ns = deadline_ns - time.monotonic_ns()
    if left_ns > 0:
        time.sleep(left_ns * 1e-9)


def suspension(seconds: float) -> str:
    """What to report of a process that has not run for so long."""
    return (
        f"this process did not run for {seconds:.0f} s: the machine was suspended, or its "
        "processes were stopped"
    )


def die_with_parent(pid: int | None) -> None:
    """Ask for SIGTERM when the parent ``pid`` dies, however it dies (Linux; elsewhere nothing).

    Call it first of all: a parent that died while this process was starting is noticed by its
    number. None does nothing.
    """
    if pid is None or not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    if os.getppid() != pid:  # it died before we asked
        os.kill(os.getpid(), signal.SIGTERM)
