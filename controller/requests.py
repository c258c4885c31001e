"""Requests about weights, from their arrival in the transport's thread until they are served."""

import os
import time
from collections import deque
from collections.abc import Iterable, Mapping
from contextlib import suppress
from typing import Any, Final

from bayesrace.messages import Reply, Scalar, Service
from bayesrace.transport import Request, declare_service

__all__ = ["RequestQueue", "reply"]

_MOST: Final = 32
"""That wait; each may hold a file."""


def reply(request: Request, accepted: bool, text: str, data: Mapping[str, Scalar]) -> None:
    """Answers a request, once."""
    request.answer(Reply(0, time.monotonic_ns(), accepted, text[:2000], dict(data)))


class RequestQueue:
    """First come, first served; ``poll`` on it wakes when something has arrived."""

    def __init__(
        self, session: Any, name: str, services: Iterable[Service[Any, Any]], most_bytes: int
    ) -> None:
        """Serves them from now on, as long as this lives; ``most_bytes``: see :class:`Request`."""
        self._waiting: deque[Request] = deque()
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
        with suppress(BlockingIOError):  # full of wake-ups
            os.write(self._wake, b"\0")

    def hear(self) -> None:
        """Takes note of having been woken."""
        with suppress(BlockingIOError):
            os.read(self._woken, 4096)

    def pop(self) -> Request | None:
        """The one that has waited longest."""
        return self._waiting.popleft() if self._waiting else None

    def put_back(self, request: Request) -> None:
        """It stays the next."""
        self._waiting.appendleft(request)

    def _arrive(self, request: Request) -> None:
        """In the transport's thread."""
        if len(self._waiting) >= _MOST:
            reply(request, False, f"{_MOST} requests wait already: try later", {})
            return
        self._waiting.append(request)
        self.wake()
