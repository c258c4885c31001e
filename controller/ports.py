"""How datagrams come from and go to a controller without Python (docs/host.md, Links)."""

import os
import select
import socket
import termios
from collections import deque
from typing import Any, Final

from bayesrace.errors import InputError, RestartError
from bayesrace.messages import FrameReader, to_frame

__all__ = ["SerialPort", "SocketPort", "open_port"]

_LARGEST: Final = 1 << 16
_LONGEST_PATH: Final = 107
_WAITING_BYTES: Final = 1 << 20
"""Of datagrams that wait: after a stall the newest are wanted; as many as the system grants."""
_RATES: Final = (115200, 230400, 460800, 921600, 1000000, 2000000, 3000000, 4000000)
_DEFAULT: Final = "921600"
_KINDS: Final = "udp:ADDRESS:PORT, such as udp:127.0.0.1:7450, unix:PATH or serial:DEVICE[:BAUD]"


class SocketPort:
    """Datagrams of a socket, to one address and from it."""

    def __init__(self, made: socket.socket, address: Any = None) -> None:
        """``address``: of a socket that is not connected."""
        made.setblocking(False)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _WAITING_BYTES)
        self._socket, self._address, self._poll = made, address, select.poll()
        self._poll.register(made, select.POLLIN)

    def send(self, data: bytes) -> None:
        """Never waits; OSError if it cannot be sent."""
        if self._address is None:
            self._socket.send(data)
        else:
            self._socket.sendto(data, self._address)

    def receive(self, timeout_s: float) -> bytes | None:
        """The next datagram; None if there is none in time, OSError of one that was sent before."""
        if not self._poll.poll(1e3 * timeout_s):
            return None
        data, sender = self._socket.recvfrom(_LARGEST)
        return data if self._address is None or sender == self._address else None

    def close(self) -> None:
        """No more datagrams."""
        self._socket.close()


class SerialPort:
    """Frames on a serial line, raw and without flow control."""

    def __init__(self, where: str) -> None:
        """``where``: DEVICE[:BAUD]. InputError if there is none."""
        device, _, rate = where.rpartition(":")
        if not (device and rate.isdecimal()):  # names of devices may have colons, too
            device, rate = where, _DEFAULT
        if rate not in map(str, _RATES):
            raise InputError(f"'{where}' has no rate of these: {', '.join(map(str, _RATES))}")
        speed = getattr(termios, f"B{rate}")
        control = [b"\0"] * termios.NCCS
        control[termios.VMIN] = b"\1"
        flags = termios.CS8 | termios.CREAD | termios.CLOCAL
        try:
            self._file = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        except (OSError, ValueError) as error:
            raise InputError(f"'{device}' is no serial line: {error.args[-1]}") from None
        try:
            termios.tcsetattr(self._file, termios.TCSANOW, [0, 0, flags, 0, speed, speed, control])
            has = termios.tcgetattr(self._file)[4:6]
        except (OSError, termios.error) as error:
            self.close()
            raise InputError(f"'{device}' is no serial line: {error.args[-1]}") from None
        if has != [speed, speed]:
            self.close()
            raise InputError(f"'{device}' cannot have a rate of {rate}; give another one")
        self.frames, self._device = FrameReader(), device
        self._came: deque[bytes] = deque()
        self._poll = select.poll()
        self._poll.register(self._file, select.POLLIN)

    def send(self, data: bytes) -> None:
        """Never waits; OSError if not all of it finds room, of which the rest is left out then."""
        frame = to_frame(data)
        if os.write(self._file, frame) < len(frame):
            raise BlockingIOError

    def receive(self, timeout_s: float) -> bytes | None:
        """The next datagram; None if there is none in time, RestartError where none can come."""
        if not self._came and self._poll.poll(1e3 * timeout_s):
            self._came.extend(self.frames.take(self._read()))
        return self._came.popleft() if self._came else None

    def _read(self) -> bytes:
        try:
            received = os.read(self._file, _LARGEST)
        except BlockingIOError:
            return b""
        except OSError:
            received = b""
        if not received:
            raise RestartError(f"nothing can come from {self._device} any more: is it plugged in?")
        return received

    def close(self) -> None:
        """No more datagrams."""
        os.close(self._file)


def open_port(name: str, own: str = "") -> SocketPort | SerialPort:
    """The port of a link by its name; ``own``: path that a Unix socket gets, to which answers come.

    InputError for what is no link.
    """
    kind, _, where = name.partition(":")
    if kind == "udp":
        return SocketPort(_connected(name, where))
    if kind == "unix" and where and len(os.fsencode(where)) <= _LONGEST_PATH:
        made = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        made.bind(own)
        return SocketPort(made, where)
    if kind == "serial":
        return SerialPort(where)
    raise InputError(f"'{name}' is no link: use {_KINDS}")


def _connected(name: str, where: str) -> socket.socket:
    host, _, port = where.rpartition(":")
    numeric = socket.AI_NUMERICHOST | socket.AI_NUMERICSERV
    try:
        if not host or not 0 < int(port) < 1 << 16:
            raise ValueError
        (found, *_) = socket.getaddrinfo(
            host.removeprefix("[").removesuffix("]"), port, type=socket.SOCK_DGRAM, flags=numeric
        )
        made = socket.socket(found[0], socket.SOCK_DGRAM)
        made.connect(found[4])
    except (OSError, ValueError, OverflowError):
        raise InputError(f"'{name}' is no link: use {_KINDS}") from None
    return made
