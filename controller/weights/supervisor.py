"""Keeps a validator running: starts it, notices that it ended or hangs, starts the next one."""

import os
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any, Final

import msgpack

from bayesrace.interpreter import RUN_MODULE

__all__ = ["Supervisor"]

_START_S: Final = 15.0
"""Until it is ready."""
_RESTART_S: Final = 1.0
_RETRY_S: Final = 15.0
"""From the end of a validator that worked to the next start, and of one that was never ready: what
cannot start must not keep a CPU busy beside the control loop."""
_TRANSFER_S: Final = 2
"""For one message: a stopped process reads nothing, and a file fills the connection."""

Message = Mapping[str, Any]


class Supervisor:
    """One validator after the other; for one thread, which calls :meth:`receive` again and again.

    Messages alternate: a validator answers each one, and sends one of its own when it has started.
    """

    def __init__(
        self, arguments: Sequence[str], hang_s: float, lost: Callable[[str], None],
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        """``arguments``: the validator's, after the socket. ``lost`` is called with the reason when
        there is no validator any more. One that does not answer for ``hang_s`` is replaced."""
        self._arguments, self._hang_s, self._lost = arguments, hang_s, lost
        self._clock_s = clock_s
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: Connection | None = None
        self._since_s, self._pause_s = clock_s(), 0.0
        """Time of the newest start, end or message; pause from an end to the next start."""
        self.ready = self.idle = False
        """A validator works; it has answered, and may be sent a message."""
        self.trouble = ""
        """Why there is none; empty while one works, and before the first was lost."""
        self.starts = 0

    @property
    def age_s(self) -> float:
        """Time since the newest start, end or message."""
        return self._clock_s() - self._since_s

    def receive(self) -> Message | None:
        """The message that has arrived, if any; starts or ends a validator, if it is time to."""
        if self._connection is None:
            if self.age_s >= self._pause_s:
                self._begin()
            return None
        try:
            if self._connection.poll():
                message: Message = msgpack.unpackb(self._connection.recv_bytes(), use_list=False)
                self._since_s, self.ready, self.idle = self._clock_s(), True, True
                self.trouble = ""
                return message
        except (OSError, EOFError):
            self.lose("ended (killed, or by a fault)")
            return None
        if self.ready and not self.idle and self.age_s > self._hang_s:
            self.lose(f"hung, without an answer for {self._hang_s:g} s")
        elif not self.ready and self.age_s > _START_S:
            self.lose(f"was not ready within {_START_S:g} s")
        return None

    def send(self, message: Message) -> None:
        """To an idle validator."""
        if self._connection is not None:
            self._since_s, self.idle = self._clock_s(), False
            try:
                self._connection.send_bytes(msgpack.packb(message))
            except OSError:
                self.lose("ended, or hung")

    def lose(self, what: str) -> None:
        """Ends it, reports ``what`` has happened, and has the next one started after a pause."""
        self.close()
        self._pause_s = _RESTART_S if self.ready else _RETRY_S
        self._since_s, self.ready, self.idle = self._clock_s(), False, False
        self.trouble = (
            f"the validator {what}: weights in use stay, and are not watched until it runs again"
        )
        self._lost(self.trouble)

    def close(self) -> None:
        """Ends it; it has nothing to finish."""
        if self._connection is not None:
            self._connection.close()
        if self._process is not None:
            self._process.kill()
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(1.0)
        self._connection = self._process = None

    def _begin(self) -> None:
        self._since_s = self._clock_s()
        try:
            self._connection = self._start()
            self.starts += 1
        except OSError as error:
            self.lose(f"cannot be started: {error.strerror or error}")

    def _start(self) -> Connection:
        """OSError if the system does not start it."""
        path = os.pathsep.join(os.path.abspath(entry) for entry in sys.path if entry)  # noqa: PTH100
        own, other = socket.socketpair()
        with own, other:
            self._process = subprocess.Popen(
                [
                    *RUN_MODULE,
                    "controller.weights.validator",
                    str(other.fileno()),
                    *self._arguments,
                ],
                env={**os.environ, "PYTHONPATH": path},
                pass_fds=[other.fileno()],
                process_group=0,  # Ctrl-C at the terminal is the controller's matter
            )
            for option in (socket.SO_SNDTIMEO, socket.SO_RCVTIMEO):
                own.setsockopt(socket.SOL_SOCKET, option, struct.pack("ll", _TRANSFER_S, 0))
            return Connection(own.detach())
