"""The monotonic clock: sleeping to an absolute deadline, and ending with a parent process.

Wall-clock time is never used to measure: it jumps.
"""

import ctypes
import os
import signal
import sys
import time
from typing import Final

__all__ = ["die_with_parent", "sleep_until_ns"]

_PR_SET_PDEATHSIG: Final = 1


def sleep_until_ns(deadline_ns: int) -> None:
    """Sleep until ``time.monotonic_ns()`` reaches the deadline; at once if it has passed.

    From Python 3.11 on ``time.sleep`` is ``clock_nanosleep`` to an absolute time, so what lies
    between reading the clock and sleeping is not added.
    """
    left_ns = deadline_ns - time.monotonic_ns()
    if left_ns > 0:
        time.sleep(left_ns * 1e-9)


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
