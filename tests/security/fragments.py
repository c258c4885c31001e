"""The other end of a link that speaks Zenoh's protocol by itself, for what Zenoh never sends:
messages in fragments of which the last is missing."""

import os
import socket
import ssl
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from bayesrace.transport.endpoints import address_of

__all__ = ["CHANNELS", "FRAGMENT_BYTES", "RawLink"]

CHANNELS: Final = tuple((priority, reliable) for priority in range(8) for reliable in (0, 1))
"""A link puts messages together in each of these by itself."""
FRAGMENT_BYTES: Final = 49_000
"""What fits into a batch of a link by TCP."""
_VERSION: Final = 9
_INIT, _OPEN, _FRAGMENT = 0x01, 0x02, 0x06
_ACK, _SIZES, _SECONDS, _MORE, _RELIABLE, _EXTENDED = 0x20, 0x40, 0x40, 0x40, 0x20, 0x80
_CLIENT: Final = 0x02
_QOS, _QOS_VALUE = 0x01, 0x31


def _number(value: int) -> bytes:
    """Seven bits a byte, the lowest first."""
    written = b""
    while value > 0x7F:
        written += bytes([value & 0x7F | 0x80])
        value >>= 7
    return written + bytes([value])


class RawLink:
    """A link with priorities, of a certificate's folder or plain."""

    def __init__(self, endpoint: str, folder: Path | None) -> None:
        to = address_of(endpoint)
        self._socket = socket.create_connection((to.host, to.port))
        if folder is not None:
            context = ssl.create_default_context(cafile=str(folder / "ca.pem"))
            context.load_cert_chain(folder / "certificate.pem", folder / "key.pem")
            self._socket = context.wrap_socket(self._socket, server_hostname=to.host)
        name = bytes([_CLIENT | 15 << 4]) + os.urandom(16)
        self._send(
            bytes([_INIT | _SIZES | _EXTENDED, _VERSION]) + name + b"\x0a\xff\xff" + bytes([_QOS])
        )
        answer = self._receive()
        assert answer[0] & 0x3F == _INIT | _ACK
        place = 3 + (answer[2] >> 4) + 1 + (3 if answer[0] & _SIZES else 0)
        length = answer[place] & 0x7F
        if answer[place] & 0x80:
            place += 1
            length |= answer[place] << 7
        cookie = answer[place + 1 : place + 1 + length]
        lease_s = _number(60)
        self._send(bytes([_OPEN | _SECONDS]) + lease_s + _number(0) + _number(len(cookie)) + cookie)
        assert self._receive()[0] & 0x3F == _OPEN | _ACK

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: object, trace: TracebackType | None
    ) -> None:
        self._socket.close()

    def begin(self, priority: int, reliable: int, fragments: int, first: int = 0) -> bool:
        """Sends that many fragments of a message, more to follow; False if the link is closed."""
        header = bytes([_FRAGMENT | _MORE | _EXTENDED | (_RELIABLE if reliable else 0)])
        for number in range(first, first + fragments):
            qos = bytes([_QOS_VALUE, priority])
            try:
                self._send(header + _number(number) + qos + bytes(FRAGMENT_BYTES))
            except OSError:
                return False
        return True

    def _send(self, batch: bytes) -> None:
        self._socket.sendall(len(batch).to_bytes(2, "little") + batch)

    def _receive(self) -> bytes:
        return self._take(int.from_bytes(self._take(2), "little"))

    def _take(self, size: int) -> bytes:
        taken = b""
        while len(taken) < size:
            part = self._socket.recv(size - len(taken))
            assert part, "the other end has closed the link"
            taken += part
        return taken
