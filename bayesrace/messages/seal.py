"""Datagrams under a key that both ends have: controller/host/br_seal.h describes them."""

import hashlib
import hmac
import struct
import time
from pathlib import Path
from typing import Final, Self

from bayesrace.errors import InputError
from bayesrace.files import check_private, read_whole

__all__ = ["Seal"]

_COUNTER: Final = struct.Struct(">Q")
_TAG_BYTES: Final = 16
_SHORTEST, _LONGEST = 32, 4096
_LAST: Final = 2**62 - 1
_TO_PROGRAM, _FROM_PROGRAM = b">", b"<"


class Seal:
    """The end of a link that is not the program's. One thread at a time may seal, and one open."""

    def __init__(self, secret: bytes) -> None:
        """InputError for too short or too long a key."""
        if not _SHORTEST <= len(secret) <= _LONGEST:
            raise InputError(f"a key has {_SHORTEST} to {_LONGEST} bytes, not {len(secret)}")
        self._keyed = hmac.new(secret, digestmod=hashlib.sha256)
        self._sent, self._accepted = 0, time.time_ns()
        self.forged = self.replayed = 0
        """Datagrams that were refused: by the tag, by the counter."""

    @classmethod
    def read(cls, path: Path) -> Self:
        """With the key of a file; InputError for one that is unusable or that others can read."""
        secret = read_whole(path, "key")
        check_private(path)
        try:
            return cls(secret)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None

    def sealed(self, data: bytes) -> bytes:
        """A datagram to the program."""
        self._sent = max(time.time_ns(), max(self._sent, self._accepted) + 1)
        body = data + _COUNTER.pack(self._sent)
        return body + self._tag(_TO_PROGRAM, body)

    def opened(self, data: bytes) -> bytes | None:
        """What the program has sealed; None: nothing that it has sent after all before."""
        body, tag = data[:-_TAG_BYTES], data[-_TAG_BYTES:]
        signed = len(body) >= _COUNTER.size
        if not signed or not hmac.compare_digest(tag, self._tag(_FROM_PROGRAM, body)):
            self.forged += 1
            return None
        (counter,) = _COUNTER.unpack(body[-_COUNTER.size :])
        if not self._accepted < counter < _LAST:
            self.replayed += 1
            return None
        self._accepted = counter
        return body[: -_COUNTER.size]

    def _tag(self, way: bytes, body: bytes) -> bytes:
        hashed = self._keyed.copy()
        hashed.update(way + body)
        return hashed.digest()[:_TAG_BYTES]
