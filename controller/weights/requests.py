"""Requests about weights, from their arrival in the transport's thread to their answer."""

import time
from collections.abc import Mapping
from queue import Empty, Full, Queue
from typing import Any, Final, NamedTuple

from bayesrace.messages import ROLLBACK, WEIGHTS, Reply, Scalar
from bayesrace.transport import Request, declare_service

__all__ = ["ENDS", "NOT_NOW", "PendingRequest", "UpdateRefusedError", "RequestQueue"]

_MOST: Final = 32
"""Requests that wait; each may hold a file."""
_RETURN_S: Final = 2.0
"""Of a service's time: the way here and back, on a machine that stalls."""
_STORE_S: Final = 5.0
"""Of a service's time: for the store, after the adoption."""

ENDS: Final = "the controller ends"
NOT_NOW: Final[Mapping[str, Scalar]] = {"again": True}
"""Data of a refusal whose reason passes: the same request may be accepted later."""


class UpdateRefusedError(Exception):
    """A request is refused; the message is the reason."""

    def __init__(self, text: str, data: Mapping[str, Scalar] = NOT_NOW) -> None:
        super().__init__(text)
        self.data = data


class PendingRequest(NamedTuple):
    """A request that has not been answered; times by the monotonic clock."""

    request: Request
    arrived_s: float

    @property
    def answer_s(self) -> float:
        """When the answer has to be sent."""
        return self.arrived_s + self.request.service.timeout_s - _RETURN_S

    @property
    def due_s(self) -> float:
        """Deadline of verdict and adoption; the store has the time from then to ``answer_s``."""
        return self.answer_s - _STORE_S

    def reply(self, accepted: bool, text: str, data: Mapping[str, Scalar] = NOT_NOW) -> None:
        """Answers, once."""
        self.request.answer(Reply(0, time.monotonic_ns(), accepted, text[:2000], dict(data)))


class RequestQueue:
    """Requests in the order of their arrival; for one thread that serves them."""

    def __init__(self, session: Any, name: str, most_bytes: int) -> None:
        """Receives as long as this object lives; ``most_bytes``: see :class:`Request`."""
        self._pending: Queue[PendingRequest] = Queue(_MOST)
        self._closed = False
        self._declared = [
            declare_service(session, service, name, self._arrive, most_bytes)
            for service in (WEIGHTS, ROLLBACK)
        ]

    def get(self, patience_s: float) -> PendingRequest | None:
        """The next request; None if none arrives in time."""
        try:
            return self._pending.get(timeout=patience_s)
        except Empty:
            return None

    def __len__(self) -> int:
        return self._pending.qsize()

    def close(self) -> None:
        """Refuses what waits, and from now on whatever arrives."""
        self._closed = True
        while (pending := self.get(0.0)) is not None:
            pending.reply(False, ENDS)

    def _arrive(self, request: Request) -> None:
        """In the transport's thread."""
        pending = PendingRequest(request, time.monotonic())
        try:
            self._pending.put_nowait(pending)
        except Full:
            pending.reply(False, f"{_MOST} requests wait already: try later")
        if self._closed:  # looked at after the put, so that no request is left behind
            self.close()
