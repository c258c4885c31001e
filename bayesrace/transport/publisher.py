"""Topics with the table's quality of service, and a process's heartbeat."""

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, Generic, Literal, TypeVar

import zenoh

from bayesrace import clock
from bayesrace.defaults import HEARTBEAT_VARIABLE
from bayesrace.errors import InputError
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
        self._declared = car_key(topic.key, car, source), settings
        self._control = control.BLOCK if topic.qos.realtime_blocks and waits else control.DROP
        self.bind(session)
        self.next_seq = 0
        """``seq`` that the next message must have."""
        self.sent_ns: int | None = None
        """Monotonic clock after the newest message was sent."""

    def bind(self, session: Any) -> None:
        """Send over this session from now on."""
        (key, settings), declare = self._declared, session.declare_publisher
        block = zenoh.CongestionControl.BLOCK
        self._lockstep = declare(key, congestion_control=block, **settings)
        self._realtime = declare(key, congestion_control=self._control, **settings)

    def put(self, message: M, *, lockstep: bool) -> None:
        """Send the message.

        In lockstep blocks rather than lose it; in real time drops it rather than block, unless the
        table says otherwise.
        """
        (self._lockstep if lockstep else self._realtime).put(encode(message))
        self.next_seq = message.seq + 1
        self.sent_ns = clock.monotonic_ns()


class Heartbeat:
    """Publishes the status when it is due; call :meth:`beat` as often as convenient.

    Renews the time of the file that ``BAYESRACE_HEARTBEAT`` names, if it names one, as well: for
    health checks that have no certificate. InputError if there can be no such file.
    """

    def __init__(self, session: Any, car: str, source: Literal["plant", "controller"]) -> None:
        self._publisher = Publisher(session, HEARTBEAT, car, source)
        self._due_ns = 0
        self.bind = self._publisher.bind
        name = os.environ.get(HEARTBEAT_VARIABLE)
        try:
            self._file = Path(name).open("ab") if name else None  # noqa: SIM115 (while it runs)
        except OSError as error:
            raise InputError(
                f"{HEARTBEAT_VARIABLE}={name}: {error.strerror}; name a file that can be written"
            ) from None

    def beat(self, status: Callable[[int], Status]) -> None:
        """Publish ``status(seq)`` if it is due."""
        now_ns = clock.monotonic_ns()
        if now_ns < self._due_ns:
            return
        # On a grid, so that a loop's jitter does not slow it; a new grid after a stall.
        self._due_ns = max(self._due_ns + _PERIOD_NS, now_ns + _PERIOD_NS // 2)
        self._publisher.put(status(self._publisher.next_seq), lockstep=False)
        if self._file is not None:
            with suppress(OSError):  # a health check may fail, but not the control loop for it
                os.utime(self._file.fileno())
