"""Says while a session is open why its links do not stand, and ends a process that cannot work.

A process ends for what is wrong with its own certificate, which no waiting mends: Zenoh reads it
once. What is wrong at the other end is a line in the log, since someone may mend it there.
"""

import logging
import signal
import threading
import time
from collections.abc import Iterable
from types import FrameType
from typing import Any, Final

import zenoh

from bayesrace.transport.endpoints import Endpoints
from bayesrace.transport.links import unlinked
from bayesrace.transport.probe import Finding, expired, probe_all

__all__ = ["LinkWatch", "report"]

_log = logging.getLogger("bayesrace.links")

_FIRST_S: Final = 0.2
"""How long a session may take to link before it is asked why it has not."""
_PERIOD_S: Final = 1.0
_REMINDER_S: Final = 86400.0

_said: Final[dict[str, str]] = {}
"""What the log of this process says of an endpoint, which may be checked before its session."""
_interrupting: Final = threading.Lock()
"""Held once a watch ends the process, which may have several sessions with one certificate; until
the process, which has not ended, opens another one."""


def report(findings: Iterable[Finding]) -> None:
    """Logs what has not been said of these endpoints."""
    for finding in findings:
        if _said.get(finding.endpoint) != finding.text:
            _log.log(logging.ERROR if finding.lasting else logging.WARNING, finding.text)
        _said[finding.endpoint] = finding.text


def _only_ours(_number: int, _frame: FrameType | None) -> None:
    """Handler in a process that ignored SIGINT: the interrupts of others stay ignored."""
    if _interrupting.locked():
        raise KeyboardInterrupt


class LinkWatch:
    """Watches the links of a session, in a thread."""

    def __init__(self, session: Any, endpoints: Endpoints, explains: bool, grace_s: float) -> None:
        """``explains``: logs why there is no link. ``grace_s``: from the expiry of the certificate
        to the end of the process."""
        self._session, self._endpoints, self._credentials = (
            session,
            endpoints,
            endpoints.credentials,
        )
        self._explains, self._grace_s = explains, grace_s
        self.fault = ""
        """Why the process has to end, with the remedy; it gets a SIGINT in its main thread."""
        self._ends_process = threading.current_thread() is threading.main_thread()
        if self._ends_process and _interrupting.locked():
            _interrupting.release()
        before = signal.getsignal(signal.SIGINT)
        self._ignored = self._ends_process and before is signal.SIG_IGN
        if self._ignored:  # as in a background job of a script
            signal.signal(signal.SIGINT, _only_ours)
        self._missing: list[str] = []
        self._remind_s = 0.0
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="links", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends it."""
        self._over.set()
        self._thread.join()
        if self._ignored:
            signal.signal(signal.SIGINT, signal.SIG_IGN)

    def _watch(self) -> None:
        first, wait_s = True, _FIRST_S
        while not self._over.wait(self._until_expiry(wait_s)):
            wait_s = _PERIOD_S
            try:
                fault = self._expired() or (self._look(first) if self._explains else "")
            except zenoh.ZError:  # the session is closed
                return
            if fault:
                self._end(fault)
                return
            if self._credentials is None and not (self._explains and self._missing):
                return
            first = False

    def _until_expiry(self, wait_s: float) -> float:
        if self._credentials is None:
            return wait_s
        return min(wait_s, max(self._credentials.ends_s - time.time(), 0.0))

    def _expired(self) -> str:
        """That the certificate has expired, and its links with it; reminds of it in time."""
        credentials = self._credentials
        if credentials is None:
            return ""
        if time.time() >= credentials.ends_s:
            text = credentials.expired()
            if self._grace_s:
                _log.error("%s; this process ends in %g s", text, self._grace_s)
                self._over.wait(self._grace_s)
            return text
        if time.monotonic() >= self._remind_s and (warning := credentials.expires_soon()):
            _log.warning("%s", warning)
            self._remind_s = time.monotonic() + _REMINDER_S
        return ""

    def _look(self, first: bool) -> str:
        """Says what is wrong with the links; returns what ends the process."""
        # Zenoh may open a link again whose other end has an expired certificate.
        stale = expired(self._endpoints.connect)
        self._missing = list({*unlinked(self._session, self._endpoints), *stale})
        for endpoint in set(self._endpoints.connect) - set(self._missing):
            _said.pop(endpoint, None)
        found = probe_all(self._missing, self._credentials)
        if self._credentials is None:
            # Secured links have been tried before there was a session.
            lasting = [finding.text for finding in found if finding.lasting]
            if first and lasting:
                return "; ".join(lasting)
        report(found)
        return ""

    def _end(self, fault: str) -> None:
        if self._over.is_set():
            return
        self.fault = fault
        if not self._ends_process:
            _log.error("%s", fault)
        elif _interrupting.acquire(blocking=False):
            # Not to the process: another thread would get it, and the main one would sleep on.
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
