"""The monotonic clock, sleeping to an absolute deadline, and getting the process ready to keep it.

Wall-clock time is never used to measure: it jumps.
"""

import ctypes
import gc
import os
import signal
import sys
import time
from typing import Final

__all__ = ["die_with_parent", "pin_to_cpu", "quiet_garbage_collector", "sleep_until_ns"]

_PR_SET_PDEATHSIG: Final = 1


def sleep_until_ns(deadline_ns: int) -> None:
    """Sleep until ``time.monotonic_ns()`` reaches the deadline; at once if it has passed."""
    left_ns = deadline_ns - time.monotonic_ns()
    if left_ns > 0:
        time.sleep(left_ns * 1e-9)


def quiet_garbage_collector() -> None:
    """Keep the cyclic collector out of a loop: freeze what exists, collect nothing from here on.

    The loops make no reference cycles; between runs they call ``gc.collect()`` all the same.
    """
    gc.collect()
    gc.freeze()
    gc.disable()


def pin_to_cpu(cpu: int | None) -> str:
    """Bind the process to one CPU; returns why not, or "".

    Plant and controller in lockstep take turns: on one CPU each wakes the other without waking an
    idle CPU, which on virtual machines costs more than the message itself.
    """
    if cpu is None:
        return ""
    if not hasattr(os, "sched_setaffinity"):
        return "this system has no CPU affinity"
    try:
        os.sched_setaffinity(0, {cpu})
    except OSError as error:
        return f"cannot bind to CPU {cpu}: {error.strerror}"
    return ""


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
