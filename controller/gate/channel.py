"""Messages between a controller and its gatekeeper over a socket pair: a map, and some bytes."""

import json
import socket
import struct
from contextlib import suppress
from typing import Any, Final

__all__ = ["Channel", "Message"]

_HEAD: Final = struct.Struct("<II")

Message = tuple[dict[str, Any], bytes]
"""A map with its ``kind``, and bytes."""


class Channel:
    """One end. Both ends are the same program, started by one another: nothing here is hostile."""

    def __init__(self, end: socket.socket) -> None:
        self._end = end

    def fileno(self) -> int:
        """For ``poll``."""
        return self._end.fileno()

    def send(self, kind: str, payload: bytes = b"", **fields: Any) -> bool:
        """False if the other end is gone."""
        head = json.dumps({"kind": kind, **fields}).encode()
        try:
            self._end.sendall(_HEAD.pack(len(head), len(payload)) + head + payload)
        except OSError:
            return False
        return True

    def receive(self) -> Message | None:
        """The next message; None if the other end is gone."""
        sizes = self._exactly(_HEAD.size)
        if sizes is None:
            return None
        head_size, size = _HEAD.unpack(sizes)
        head, payload = self._exactly(head_size), self._exactly(size)
        return None if head is None or payload is None else (json.loads(head), payload)

    def shut(self) -> None:
        """Nothing comes or goes any more, after half a message."""
        with suppress(OSError):
            self._end.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """The other end sees it."""
        self._end.close()

    def _exactly(self, size: int) -> bytes | None:
        data = bytearray(size)
        view, count = memoryview(data), 0
        while count < size:
            try:
                got = self._end.recv_into(view[count:])
            except OSError:
                return None
            if not got:
                return None
            count += got
        return bytes(data)
