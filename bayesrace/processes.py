"""Processes: how our own Python programs are started, end with their parent, and take signals.

A signal arrives as an item of a thread's queue, or as a Ctrl-C that is never lost, wherever it
strikes.
"""

import ctypes
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Final

__all__ = [
    "RUN_MODULE", "catching_signals", "deferred_interrupt", "die_with_parent",
    "interrupt", "interrupt_cause", "raise_if_interrupted", "remembering_interrupts",
]  # fmt: skip

RUN_MODULE: Final = (sys.executable, "-P", "-m")
"""Then the module and its arguments. -P: a file of the current folder that is called like a module
of ours, or of the standard library, is not imported."""

_PR_SET_PDEATHSIG: Final = 1

_pending = threading.Event()
_causes: Final[list[Exception]] = []


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


@contextmanager
def catching_signals(arrived: Callable[[int], None]) -> Iterator[None]:
    """SIGINT and SIGTERM only call ``arrived`` with their number; off the main thread, nothing.

    ``arrived`` runs in the signal handler, between any two instructions of the main thread: let it
    put the signal into a :class:`queue.SimpleQueue`, whose ``put`` may interrupt itself.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {
        one: signal.signal(one, lambda number, _frame: arrived(number))
        for one in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        # SIGINT last: from then on it raises, and nothing must be left undone.
        for number, handler in reversed(before.items()):
            signal.signal(number, handler)


@contextmanager
def remembering_interrupts() -> Iterator[None]:
    """For the block, SIGINT raises KeyboardInterrupt at once and is remembered as well.

    An exception that strikes in a weak reference's callback or below a foreign library's frames
    is swallowed there; :func:`raise_if_interrupted` raises it again. Nothing off the main thread.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def on_signal(_number: int, _frame: FrameType | None) -> None:
        _pending.set()
        raise KeyboardInterrupt

    def on_unraisable(unraisable: Any) -> None:
        if unraisable.exc_type is not KeyboardInterrupt:
            hook_before(unraisable)

    _pending.clear()
    _causes.clear()
    hook_before, sys.unraisablehook = sys.unraisablehook, on_unraisable
    before = signal.signal(signal.SIGINT, on_signal)
    try:
        yield
        raise_if_interrupted()
    finally:
        signal.signal(signal.SIGINT, before)
        sys.unraisablehook = hook_before
        # An interrupt in a string being executed (a dataclass being made) marks the interpreter
        # to end by SIGINT, caught or not; the next string executed takes the mark off again.
        exec("")  # noqa: S102


def interrupt(cause: Exception) -> None:
    """A SIGINT for the main thread, from another one, for that reason."""
    _causes.append(cause)
    # Not to the process: another thread would get it, and the main one would sleep on.
    signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)


def interrupt_cause() -> Exception | None:
    """Why the process has interrupted itself; None if it has not, so that a person has."""
    return _causes[0] if _causes else None


def raise_if_interrupted() -> None:
    """KeyboardInterrupt if one was remembered: call it between the parts of a long work."""
    if _pending.is_set():
        raise KeyboardInterrupt


@contextmanager
def deferred_interrupt() -> Iterator[None]:
    """For the block, SIGINT waits; then it is KeyboardInterrupt. Nothing off the main thread.

    For what takes seconds and must be whole, such as saving; and for calls into libraries that
    would make something else of it: CasADi turns it into a failed evaluation, and IPOPT into a
    problem without a solution.
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
