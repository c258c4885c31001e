"""Publishing a process's status at 10 Hz from within its loop."""

import time
from collections.abc import Callable
from typing import Any, Final, Literal

from bayesrace.messages import HEARTBEAT, Status
from bayesrace.transport.session import Publisher

__all__ = ["HEARTBEAT_S", "Heartbeat"]

HEARTBEAT_S: Final = 0.1
"""Period of heartbeats."""

_PERIOD_NS: Final = round(HEARTBEAT_S * 1e9)


class Heartbeat:
    """Publishes the status when it is due; call :meth:`beat` as often as convenient."""

    def __init__(self, session: Any, car: str, source: Literal["plant", "controller"]) -> None:
        self._publisher = Publisher(session, HEARTBEAT, car, source)
        self._due_ns = 0

    def beat(self, status: Callable[[int], Status]) -> None:
        """Publish ``status(seq)`` if it is due."""
        now_ns = time.monotonic_ns()
        if now_ns < self._due_ns:
            return
        # On a grid, so that a loop's jitter does not slow it; a new grid after a stall.
        self._due_ns = max(self._due_ns + _PERIOD_NS, now_ns + _PERIOD_NS // 2)
        self._publisher.put(status(self._publisher.next_seq), lockstep=False)
