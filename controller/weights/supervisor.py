"""Keeps a validator running: starts it, notices that it ended or hangs, starts the next one."""

import os
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any, Final

import msgpack

from bayesrace.interpreter import RUN_MODULE
from controller.weights.states import SharedStates

__all__ = ["Supervisor"]

_START_S: Final = 15.0
"""Until it is ready."""
_RESTART_S: Final = 1.0
_LONGEST_PAUSE_S: Final = 30.0
"""From an end to the next start; doubled from ``_RESTART_S`` for each process that ends before it
is ready, as one that cannot start must not keep a CPU busy beside the control loop."""
_TRANSFER_S: Final = 5
_BUFFER_BYTES: Final = 1 << 20
"""For one message: a stopped process reads nothing, and a file fills the connection."""

Message = Mapping[str, Any]


class Supervisor:
    """One validator after the other; for one thread, which calls :meth:`look` again and again."""

    def __init__(
        self, states: SharedStates, hang_s: float, context: Callable[[], Message],
        lost: Callable[[str], None], clock_s: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        """``context`` makes the first message. ``lost`` is called with the reason when there is no
        validator any more. One without a heartbeat for ``hang_s`` is replaced."""
        self._states, self._hang_s, self._context, self._lost = states, hang_s, context, lost
        self._clock_s, self._pause_s = clock_s, _RESTART_S
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: Connection | None = None
        self._due_s = clock_s()
        """When the next one is to be started, or must be ready."""
        self.ready = False
        self.trouble = ""
        """Why there is none; empty while one works, and before the first was lost."""
        self.starts = 0

    def look(self) -> None:
        """Starts or ends a validator, if it is time to."""
        now_s = self._clock_s()
        if self.ready and now_s > self._states.heartbeat_s + self._hang_s:
            self.lose(f"hung, without a heartbeat for {self._hang_s:g} s")
        elif self.ready or now_s < self._due_s:
            return
        elif self._connection is not None:
            self.lose(f"was not ready within {_START_S:g} s")
        else:
            try:
                self._connection = self._start()
            except OSError as error:
                self.lose(f"cannot be started: {error.strerror or error}")
                return
            self.starts, self._due_s = self.starts + 1, now_s + _START_S
            self.send(self._context())

    def send(self, message: Message) -> None:
        """Sends, if there is a validator."""
        if self._connection is not None:
            try:
                self._connection.send_bytes(msgpack.packb(message))
            except OSError:
                self.lose("ended, or hung")

    def receive(self) -> Message | None:
        """The next message, if one has arrived."""
        if self._connection is None:
            return None
        try:
            if not self._connection.poll():
                return None
            message: Message = msgpack.unpackb(self._connection.recv_bytes())
        except (OSError, EOFError):
            self.lose("ended (killed, or by a fault)")
            return None
        if message["kind"] == "ready":
            self.ready, self._pause_s, self.trouble = True, _RESTART_S, ""
        return message

    def lose(self, what: str) -> None:
        """Ends it, reports ``what`` has happened, and has the next one started after a pause."""
        self.close()
        self._pause_s = _RESTART_S if self.ready else min(2 * self._pause_s, _LONGEST_PAUSE_S)
        self._due_s, self.ready = self._clock_s() + self._pause_s, False
        self.trouble = (
            f"the validator {what}: weights in use stay, and are not watched until it runs again"
        )
        self._lost(self.trouble)

    def close(self) -> None:
        """Ends it, and waits for the end a little."""
        if self._connection is not None:
            self._connection.close()
        if self._process is not None:
            for end in (self._process.poll, self._process.kill):
                end()
                with suppress(subprocess.TimeoutExpired):
                    self._process.wait(1.0)
        self._connection = self._process = None

    def _start(self) -> Connection:
        """OSError if the system does not start it."""
        path = os.pathsep.join(os.path.abspath(entry) for entry in sys.path if entry)  # noqa: PTH100
        own, other = socket.socketpair()
        with own, other:
            descriptors = other.fileno(), self._states.fd
            self._process = subprocess.Popen(
                [*RUN_MODULE, "controller.weights.validator", *map(str, descriptors)],
                env={**os.environ, "PYTHONPATH": path},
                pass_fds=descriptors,
                process_group=0,  # Ctrl-C at the terminal is the controller's matter
            )
            for option in (socket.SO_SNDTIMEO, socket.SO_RCVTIMEO):
                own.setsockopt(socket.SOL_SOCKET, option, struct.pack("ll", _TRANSFER_S, 0))
            # A verdict fits, so that both sides never wait for each other to read.
            other.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFER_BYTES)
            return Connection(own.detach())
