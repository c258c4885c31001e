"""States that the control thread records for the validator, in memory that both processes map.

    header   u64 states recorded; u64 progress of the watch; u64 heartbeat of the validator [ns]
    ring     the newest states

No side waits for the other: each record carries its number and a checksum, so that the reader
recognises a record that is being overwritten, on any machine.
"""

import mmap
import os
import struct
import tempfile
import time
import zlib
from typing import Final, NamedTuple

from bayesrace.messages import State

__all__ = ["ALL", "RING", "SharedStates", "StateRecord"]

ALL: Final = (1 << 40) - 1
"""In place of a count of states: nothing is watched, and the control thread need not wait."""
RING: Final = 8192
"""States kept: 16 s at 500 Hz, which is more than the validator looks back."""
_MARGIN: Final = 64
"""Oldest states that are not read: they may be overwritten meanwhile."""

_HEADER: Final = 64
_RECORD: Final = 128
_SIZE: Final = _HEADER + RING * _RECORD
_STATE: Final = struct.Struct("<4qdq7d2d?B2x")
_SEAL: Final = struct.Struct("<I")
_FALLEN_BACK: Final = (None, False, True)


class StateRecord(NamedTuple):
    """A state as it was recorded, with its ``number`` among all."""

    number: int
    epoch: int
    run: int
    seq: int
    time_s: float
    recorded_ns: int
    """Monotonic clock, the same in all processes of a machine."""
    x: tuple[float, ...]
    u_applied: tuple[float, ...]
    lockstep: bool
    fallen_back: bool | None = None
    """The input of the cycle before was the fallback's; None: the car was not driven."""


class SharedStates:
    """Either side's view of the memory; the controller's part first."""

    def __init__(self, fd: int | None = None) -> None:
        """Of the file descriptor of another view; None makes new memory."""
        self.fd = _anonymous_file() if fd is None else fd
        self._map = mmap.mmap(self.fd, _SIZE)
        if fd is None:
            self._map[:] = bytes(_SIZE)  # no page is missing when the control loop first writes
        self._words = memoryview(self._map)[:24].cast("Q")
        self._next = self._words[0]

    def record(self, state: State, fallen_back: bool | None) -> None:
        """Keeps a state; for the control thread. ``fallen_back``: see :class:`StateRecord`."""
        number = self._next
        data = _STATE.pack(
            number, state.epoch, state.run, state.seq, state.time_s, time.monotonic_ns(),
            *state.x, *state.u_applied, state.lockstep, _FALLEN_BACK.index(fallen_back),
        )  # fmt: skip
        begin = _HEADER + number % RING * _RECORD
        self._map[begin : begin + _RECORD] = data + _SEAL.pack(zlib.crc32(data))
        self._next = self._words[0] = number + 1

    @property
    def recorded(self) -> int:
        """Number of states recorded so far."""
        return self._words[0]

    @property
    def progress(self) -> tuple[int, int, bool]:
        """Of the watch: revision of the weights, states seen, and whether it rolls back."""
        word = self._words[1]
        return word >> 41, word >> 1 & ALL, bool(word & 1)

    @property
    def heartbeat_s(self) -> float:
        """Monotonic clock of the validator's last heartbeat."""
        return self._words[2] * 1e-9

    def read(self, begin: int) -> tuple[list[StateRecord], int]:
        """For the validator: states from number ``begin`` on that are there; the next number."""
        end, found = self._words[0], []
        for number in range(max(begin, end - RING + _MARGIN), end):
            at = _HEADER + number % RING * _RECORD
            record = self._map[at : at + _RECORD]
            data, seal = record[: _STATE.size], record[_STATE.size :]
            *head, lockstep, driven = _STATE.unpack(data)
            if head[0] == number and _SEAL.pack(zlib.crc32(data)) == seal:
                x, u = tuple(head[6:13]), tuple(head[13:])
                fields = (*head[:6], x, u, lockstep, _FALLEN_BACK[driven])
                found.append(StateRecord._make(fields))
        return found, end

    def report(self, revision: int, seen: int, rolls_back: bool = False) -> None:
        """Publishes the progress of the watch."""
        self._words[1] = revision << 41 | seen << 1 | rolls_back

    def beat(self) -> None:
        """Publishes a heartbeat."""
        self._words[2] = time.monotonic_ns()


def _anonymous_file() -> int:
    if hasattr(os, "memfd_create"):
        fd = os.memfd_create("bayesrace-states")
    else:
        with tempfile.TemporaryFile() as file:
            fd = os.dup(file.fileno())
    os.ftruncate(fd, _SIZE)
    return fd
