"""Frames of fixed layout between the plant and the process that an FMU runs in.

One side asks, the other answers; a frame is kind and length (two 32-bit numbers) and a payload,
doubles or text. Buffers are made once. Reading never waits beyond the time it is given.
"""

import os
import select
import struct
import time
from typing import Final

__all__ = [
    "DOUBLE",
    "FAULT",
    "LOAD",
    "QUIT",
    "READY",
    "START",
    "STEP",
    "VALUES",
    "Channel",
    "Closed",
    "ProtocolError",
]

# Asked by the plant:
LOAD: Final = 1
"""JSON: what to load; answered by READY or FAULT."""
START: Final = 2
"""JSON: values to set; a new instance is initialised; answered by VALUES or FAULT."""
STEP: Final = 3
"""Doubles: step size, number of steps, rows of inputs; answered by VALUES or FAULT."""
QUIT: Final = 4
"""End in order."""
# Answered by the FMU's process:
READY: Final = 5
VALUES: Final = 6
"""Doubles: time, then the outputs."""
FAULT: Final = 7
"""UTF-8: what went wrong."""

DOUBLE: Final = 8
_HEAD: Final = struct.Struct("=II")
_MOST: Final = 1 << 20
"""Bytes of a frame; the largest carry start values."""


class Closed(ConnectionError):  # noqa: N818 - a state, as BlockingIOError
    """The other side is gone."""


class ProtocolError(ConnectionError):
    """What has arrived is no frame: something else writes to this descriptor."""


class Channel:
    """One end of a stream socket, by its file descriptor."""

    def __init__(self, descriptor: int, *, blocking: bool) -> None:
        self.descriptor = descriptor
        os.set_blocking(descriptor, blocking)
        self._frame = bytearray(1 << 16)
        self._view = memoryview(self._frame)
        self._have = 0

    def send(self, kind: int, payload: bytes | memoryview, deadline: float | None = None) -> None:
        """Send a frame; TimeoutError if it is not taken before ``deadline`` (time.monotonic)."""
        data = memoryview(_HEAD.pack(kind, len(payload)) + payload)
        while data:
            try:
                data = data[os.write(self.descriptor, data) :]
            except BlockingIOError:
                left_s = 1.0 if deadline is None else deadline - time.monotonic()
                if left_s <= 0:
                    raise TimeoutError from None
                select.select((), (self.descriptor,), (), left_s)
            except (BrokenPipeError, ConnectionResetError):
                raise Closed from None

    def poll(self) -> tuple[int, memoryview] | None:
        """A frame (kind, payload) if one has arrived; the payload is valid until the next call.

        A blocking channel waits for it. Raises Closed at the other side's end.
        """
        while True:
            if self._have >= _HEAD.size:
                kind, length = _HEAD.unpack_from(self._frame)
                need = _HEAD.size + length
                # Question and answer alternate: nothing of a next frame can be there already.
                if length > _MOST or self._have > need:
                    raise ProtocolError
                if self._have == need:
                    self._have = 0
                    return kind, self._view[_HEAD.size : need]
                if need > len(self._frame):
                    self._grow(need)
            try:
                count = os.readv(self.descriptor, [self._view[self._have :]])
            except BlockingIOError:
                return None
            except ConnectionResetError:
                raise Closed from None
            if count == 0:
                raise Closed
            self._have += count

    def _grow(self, size: int) -> None:
        larger = bytearray(size)
        larger[: self._have] = self._view[: self._have]
        self._frame, self._view = larger, memoryview(larger)
