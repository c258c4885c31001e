"""Publishing: topics with the table's quality of service, and a process's heartbeat."""

import time
from collections.abc import Callable
from typing import Any, Final, Generic, Literal, TypeVar

import zenoh

from bayesrace.messages import HEARTBEAT, Message, Status, Topic, car_key, encode

__all__ = ["HEARTBEAT_S", "Heartbeat", "Publisher"]

M = TypeVar("M", bound=Message)

HEARTBEAT_S: Final = 0.1
"""Period of heartbeats."""
_PERIOD_NS: Final = round(HEARTBEAT_S * 1e9)


class Publisher(Generic[M]):
    """Sends one topic's messages with the table's quality of service, and numbers them."""

    def __init__(
        self, session: Any, topic: Topic[M], car: str, source: str = "", *, waits: bool = True
    ) -> None:
        """``waits`` False: never block in real time, whatever the table says: for control loops."""
        control = zenoh.CongestionControl
        settings = {
            "express": topic.qos.express,
            "priority": getattr(zenoh.Priority, topic.qos.priority.upper()),
            "reliability": zenoh.Reliability.RELIABLE,
        }
        key, declare = car_key(topic.key, car, source), session.declare_publisher
        self._lockstep = declare(key, congestion_control=control.BLOCK, **settings)
        realtime = control.BLOCK if topic.qos.realtime_blocks and waits else control.DROP
        self._realtime = declare(key, congestion_control=realtime, **settings)
        self.next_seq = 0
        """``seq`` that the next message must have."""
        self.sent_ns: int | None = None
        """Monotonic clock after the newest message was sent."""

    def put(self, message: M, *, lockstep: bool) -> None:
        """Send the message.

        In lockstep blocks rather than lose it; in real time drops it rather than block, unless the
        table says otherwise.
        """
        (self._lockstep if lockstep else self._realtime).put(encode(message))
        self.next_seq = message.seq + 1
        self.sent_ns = time.monotonic_ns()


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
