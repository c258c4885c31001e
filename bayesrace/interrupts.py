"""Ctrl-C at a moment when it can be dealt with."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["deferred_interrupt"]


@contextmanager
def deferred_interrupt() -> Iterator[None]:
    """For the block, SIGINT waits; then it is KeyboardInterrupt. Nothing off the main thread.

    For calls of a few seconds into libraries that would make something else of it: CasADi turns it
    into a failed evaluation, and IPOPT into a problem without a solution.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    arrived: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _frame: arrived.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if arrived:
        raise KeyboardInterrupt
