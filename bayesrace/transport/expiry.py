"""Ends a process when its certificate expires: Zenoh reads it once, so waiting does not help."""

import logging
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Final

from bayesrace.errors import InputError
from bayesrace.transport.credentials import Credentials

__all__ = ["ending_on_expiry"]

_log = logging.getLogger("bayesrace.links")

_PERIOD_S: Final = 1.0
"""Longest time between two looks at the calendar, which somebody may set."""
_REMINDER_S: Final = 86400.0

_interrupting: Final = threading.Lock()
"""Held once an expiry interrupts the process, which may have several sessions with one certificate;
until the process, which has not ended, opens another session."""


@contextmanager
def ending_on_expiry(credentials: Credentials, grace_s: float) -> Iterator[None]:
    """For the block, the expiry of the certificate interrupts the main thread ``grace_s`` later.

    The end of the block raises InputError with the reason then. Started in another thread, it only
    logs the reason. The log warns of the expiry each day for two weeks before.
    """
    in_main = threading.current_thread() is threading.main_thread()
    if in_main and _interrupting.locked():
        _interrupting.release()
    over, expired = threading.Event(), threading.Event()

    def watch() -> None:
        if not _outlasted(credentials, grace_s, over):
            return
        expired.set()
        if not in_main:
            _log.error("%s", credentials.expired())
        elif _interrupting.acquire(blocking=False):
            # Not to the process: another thread would get it, and the main one would sleep on.
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)

    thread = threading.Thread(target=watch, name="expiry", daemon=True)
    try:
        with _interruptible():
            thread.start()
            try:
                yield
            finally:
                over.set()
                thread.join()
    except (InputError, KeyboardInterrupt) as error:
        if expired.is_set():
            raise InputError(credentials.expired()) from error
        raise
    if expired.is_set():
        raise InputError(credentials.expired())


def _outlasted(credentials: Credentials, grace_s: float, over: threading.Event) -> bool:
    """Waits for the expiry and the time after it; False if the block is over before."""
    remind_s = 0.0
    while (left_s := credentials.ends_s - time.time()) > 0:
        if time.monotonic() >= remind_s and (warning := credentials.expires_soon()):
            _log.warning("%s", warning)
            remind_s = time.monotonic() + _REMINDER_S
        if over.wait(min(left_s, _PERIOD_S)):
            return False
    if grace_s:
        _log.error("%s; this process ends in %g s", credentials.expired(), grace_s)
    return not over.wait(grace_s)


@contextmanager
def _interruptible() -> Iterator[None]:
    """For the block, SIGINT of this module counts in a process that ignores it, too."""
    in_main = threading.current_thread() is threading.main_thread()
    if not in_main or signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        yield
        return
    signal.signal(signal.SIGINT, _only_ours)  # as in a background job of a script
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _only_ours(_number: int, _frame: FrameType | None) -> None:
    """Handler in a process that ignored SIGINT: the interrupts of others stay ignored."""
    if _interrupting.locked():
        raise KeyboardInterrupt
