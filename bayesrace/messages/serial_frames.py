"""Datagrams as frames on a serial line: controller/host/br_serial.c describes them."""

import struct
import zlib
from typing import Final

__all__ = ["FrameReader", "to_frame"]

_SUM: Final = struct.Struct(">I")
_LONGEST: Final = 66_000
"""Of a stuffed frame, at least."""


def _stuffed(data: bytes) -> bytes:
    out = bytearray()
    for block in data.split(b"\0"):
        for at in range(0, len(block) // 254 * 254, 254):
            out += b"\xff" + block[at : at + 254]
        rest = block[len(block) // 254 * 254 :]
        out += bytes([len(rest) + 1]) + rest
    return bytes(out)


def _unstuffed(frame: bytes) -> bytes:
    """Too few bytes for a frame that is none."""
    out, at = bytearray(), 0
    while at < len(frame):
        code = frame[at]
        out += frame[at + 1 : at + code]
        at += code
        if code < 255 and at < len(frame):
            out.append(0)
    return bytes(out) if at == len(frame) else b""


def to_frame(data: bytes) -> bytes:
    """A datagram as it is sent."""
    return b"\0" + _stuffed(data + _SUM.pack(zlib.crc32(data))) + b"\0"


class FrameReader:
    """The datagrams among the bytes that come."""

    def __init__(self) -> None:
        self._rest = b""
        self.bad = 0
        """Frames so far that were damaged or too long."""

    def take(self, received: bytes) -> list[bytes]:
        """The datagrams that these bytes complete."""
        *frames, rest = (self._rest + received).split(b"\0")
        self._rest = rest[: _LONGEST + 1]
        found = []
        for frame in filter(None, frames):
            content = _unstuffed(frame) if len(frame) <= _LONGEST else b""
            data, said = content[: -_SUM.size], content[-_SUM.size :]
            if said == _SUM.pack(zlib.crc32(data)):
                found.append(data)
            else:
                self.bad += 1
        return found
