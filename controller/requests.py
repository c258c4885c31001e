"""Requests about weights, from their arrival in the transport's thread until they are served."""

import os
import threading
import time
from collections import deque
from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import Any, Final, NamedTuple

from bayesrace.messages import Reply, Scalar, Service
from bayesrace.transport import Request, declare_service

__all__ = ["ENDS", "NOT_NOW", "RequestQueue", "Waiting", "reply"]

_MOST: Final = 32
"""That wait; each may hold a file."""

NOT_NOW: Final[Mapping[str, Scalar]] = {"again": True}
"""Data of a refusal whose reason passes: the same request may be accepted later."""

_RETURN_S: Final = 2.0
"""Of a service's time: the way here and back, on a machine that stalls."""

ENDS: Final = "the controller ends"
"""Why nothing is done any more."""


def reply(request: Request, accepted: bool, text: str, data: Mapping[str, Scalar]) -> None:
    """Answers a request, once."""
    request.answer(Reply(0, time.monotonic_ns(), accepted, text[:2000], dict(data)))


def _turn_away(request: Request, text: str) -> None:
    """Answers a request that is not looked at."""
    if request.service.answer is None:
        request.answer_raw(b"")
    else:
        reply(request, False, text, NOT_NOW)


class Waiting(NamedTuple):
    """A request that has arrived."""

    request: Request
    answer_s: float
    """When it must have been answered, by the monotonic clock."""


class RequestQueue:
    """First come, first served; ``poll`` on it wakes when something has arrived."""

    def __init__(
        self, session: Any, name: str, services: Iterable[Service[Any, Any]], most_bytes: int
    ) -> None:
        """Serves them from now on, as long as this lives; ``most_bytes``: see :class:`Request`."""
        self._waiting: deque[Waiting] = deque()
        self._lock = threading.Lock()
        """Of ``_closed``: nobody may write to a descriptor that is somebody else's by now."""
        self._closed = False
        self._woken, self._wake = os.pipe()
        os.set_blocking(self._woken, False)
        os.set_blocking(self._wake, False)
        self._declared = [
            declare_service(session, service, name, self._arrive, most_bytes)
            for service in services
        ]

    def fileno(self) -> int:
        """For ``poll``."""
        return self._woken

    def wake(self) -> None:
        """Whoever waits; from any thread."""
        with self._lock:
            self._wake_up()

    def hear(self) -> None:
        """Takes note of having been woken."""
        with suppress(BlockingIOError):
            os.read(self._woken, 4096)

    def __len__(self) -> int:
        """How many wait."""
        return len(self._waiting)

    def pop(self) -> Waiting | None:
        """The one that has waited longest."""
        return self._waiting.popleft() if self._waiting else None

    def put_back(self, waiting: Waiting) -> None:
        """It stays the next."""
        self._waiting.appendleft(waiting)

    def close(self) -> None:
        """Turns away what waits, and from now on whatever arrives; not to be polled any more."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            os.close(self._woken)
            os.close(self._wake)
        while (waiting := self.pop()) is not None:
            _turn_away(waiting.request, ENDS)

    def _arrive(self, request: Request) -> None:
        """In the transport's thread."""
        with self._lock:
            why_not = ENDS if self._closed else ""
            if len(self._waiting) >= _MOST:
                why_not = why_not or f"{_MOST} requests wait already: try later"
            if not why_not:
                answer_s = time.monotonic() + request.service.timeout_s - _RETURN_S
                self._waiting.append(Waiting(request, answer_s))
                self._wake_up()
        if why_not:
            _turn_away(request, why_not)

    def _wake_up(self) -> None:
        """With the lock."""
        if not self._closed:
            with suppress(BlockingIOError):  # full of wake-ups
                os.write(self._wake, b"\0")
