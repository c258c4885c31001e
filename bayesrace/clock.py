"""The clock that the loops of plant and controller live by: the system's monotonic one, or a
simulated one in its place (:mod:`bayesrace.operation.simulation`).

Call the functions through the module, ``clock.monotonic_ns()``: :func:`simulated` replaces them for
all threads of this process. Wall-clock time is never used to measure: it jumps.
"""

import ctypes
import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final, Protocol

__all__ = [
    "Clock", "monotonic", "monotonic_ns", "perf_counter_ns", "simulated", "sleep", "sleep_until_ns",
]  # fmt: skip

_CLOCK_MONOTONIC: Final = 1
_TIMER_ABSTIME: Final = 1


class _Timespec(ctypes.Structure):
    _fields_ = [("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long)]


def _find_nanosleep() -> Any:
    return ctypes.CDLL(None).clock_nanosleep if sys.platform.startswith("linux") else None


_nanosleep: Final = _find_nanosleep()


def _sleep_until_ns(deadline_ns: int) -> None:
    """Sleep until :func:`monotonic_ns` reaches the deadline; at once if it has passed.

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


monotonic_ns: Callable[[], int] = time.monotonic_ns
monotonic: Callable[[], float] = time.monotonic
perf_counter_ns: Callable[[], int] = time.perf_counter_ns
"""Of durations that are only reported."""
sleep: Callable[[float], None] = time.sleep
sleep_until_ns: Callable[[int], None] = _sleep_until_ns


class Clock(Protocol):
    """What can stand in for the system's."""

    def monotonic_ns(self) -> int:
        """Now [ns]."""

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Returns when it is that late; at once if it is already."""


@contextmanager
def simulated(by: Clock) -> Iterator[None]:
    """For the block all threads of this process live by that clock."""
    own = globals()
    replaced: dict[str, Callable[..., Any]] = {
        "monotonic_ns": by.monotonic_ns,
        "monotonic": lambda: by.monotonic_ns() * 1e-9,
        "perf_counter_ns": by.monotonic_ns,
        # rounded up: who waits for the rest of a time would never get there
        "sleep": lambda seconds: by.sleep_until_ns(by.monotonic_ns() + math.ceil(seconds * 1e9)),
        "sleep_until_ns": by.sleep_until_ns,
    }
    before = {name: own[name] for name in replaced}
    own.update(replaced)
    try:
        yield
    finally:
        own.update(before)
