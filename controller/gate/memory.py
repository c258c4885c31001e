"""Memory that a controller shares with its gatekeeper: states one way, weights the other.

    header   u64 states noted; u64 what the watch has seen of them, and what it thinks; u64 when
             the gatekeeper gave its last sign of life, monotonic clock [ns]
    ring     the newest states, written by the control thread alone
    weights  one set, as ``br_mpc_gp`` wants it, written by the gatekeeper alone

Nobody waits for anybody: each state carries its number and a checksum, so that one which is
being overwritten is recognised on any machine, whatever order its memory keeps.
"""

import ctypes as ct
import mmap
import os
import struct
import tempfile
import time
import zlib
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from bayesrace.gp.weights import FEATURES, KERNELS, OUTPUTS, GpWeights
from bayesrace.messages import State
from controller.native_library import Gp

__all__ = ["ALL_SEEN", "Memory", "Noted"]

ALL_SEEN: Final = 1 << 62
"""Nothing is watched: nobody has to wait."""

_HEADER: Final = 64
_RING: Final = 8192
"""States kept: 16 s at 500 Hz, which is more than the gate looks back."""
_MARGIN: Final = 64
"""Oldest states that are not read: they may be overwritten meanwhile."""

_STATE: Final = struct.Struct("<4qdq7d2d")
_SEAL: Final = struct.Struct("<BBxxI")
_FALLEN_BACK: Final = (None, False, True)
_DRIVEN: Final = {None: 0, False: 1, True: 2}
_RECORD: Final = 128
_HEAD: Final = 4
"""Numbers of an output before its arrays: kernel, n, offset, scale."""


class Noted(NamedTuple):
    """A state as it was noted."""

    number: int
    """Its number among all that were noted."""
    epoch: int
    run: int
    seq: int
    time_s: float
    at_ns: int
    """Monotonic clock, the same in all processes of a machine, when it was noted."""
    x: tuple[float, ...]
    u_applied: tuple[float, ...]
    lockstep: bool
    fallen_back: bool | None = None
    """Whether the input of the cycle before was the fallback's; None: the car was not driven."""


class Memory:
    """Either side's view; ``fd`` None makes it."""

    def __init__(self, capacity: int, fd: int | None = None) -> None:
        """``capacity``: training points per output."""
        per_output = _HEAD + len(FEATURES) * (capacity + 1) + capacity
        begin = _HEADER + _RING * _RECORD
        size = begin + 8 * per_output * len(OUTPUTS)
        made = fd is None
        self.fd = _anonymous_file(size) if fd is None else fd
        self.capacity = capacity
        self._map = mmap.mmap(self.fd, size)
        if made:
            self._map[:] = bytes(size)  # no page is missing when the loop first writes there
        self._words = memoryview(self._map)[:24].cast("Q")
        self._noted = self._words[0]
        flat: npt.NDArray[np.float64] = np.frombuffer(
            self._map, np.float64, per_output * len(OUTPUTS), begin
        )
        self._outputs = flat.reshape(len(OUTPUTS), per_output)

    @property
    def noted(self) -> int:
        """States noted so far."""
        return self._words[0]

    def close(self) -> None:
        """Gives the file up; this memory itself stays as long as somebody uses it."""
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1

    # The controller's side -----------------------------------------------------------------------

    def note(self, state: State, fallen_back: bool | None) -> None:
        """Keeps a state; for the control thread. ``fallen_back``: see :class:`Noted`."""
        index = self._noted
        data = _STATE.pack(
            index, state.epoch, state.run, state.seq, state.time_s, time.monotonic_ns(),
            *state.x, *state.u_applied,
        ) + bytes((state.lockstep, _DRIVEN[fallen_back], 0, 0))  # fmt: skip
        begin = _HEADER + index % _RING * _RECORD
        self._map[begin : begin + _RECORD] = data + zlib.crc32(data).to_bytes(4, "little")
        self._noted = self._words[0] = index + 1

    def outputs(self) -> "ct.Array[Gp]":
        """The weights laid down, for ``br_mpc_stage_weights``; they stay in this memory."""
        outputs = (Gp * len(OUTPUTS))()
        for target, row in zip(outputs, self._outputs, strict=True):
            arrays = row.ctypes.data + 8 * _HEAD
            target.kernel, target.n = int(row[0]), min(int(row[1]), self.capacity)
            target.offset, target.scale = row[2:_HEAD]
            target.length_scales = arrays
            target.inputs = arrays + 8 * len(FEATURES)
            target.alpha = arrays + 8 * len(FEATURES) * (1 + target.n)
        return outputs

    @property
    def watched(self) -> tuple[int, bool]:
        """How many of the states noted the watch has seen, and whether it wants to go back."""
        word = self._words[1]
        return word >> 1, bool(word & 1)

    @property
    def alive_s(self) -> float:
        """Monotonic clock of the gatekeeper's last sign of life."""
        return self._words[2] * 1e-9

    # The gatekeeper's side -----------------------------------------------------------------------

    def read(self, begin: int) -> tuple[list[Noted], int]:
        """States from number ``begin`` on, as far as they are still there; the next number."""
        end = self._words[0]
        found = []
        for index in range(max(begin, end - _RING + _MARGIN), end):
            offset = _HEADER + index % _RING * _RECORD
            record = self._map[offset : offset + _RECORD]
            lockstep, driven, seal = _SEAL.unpack_from(record, _STATE.size)
            if zlib.crc32(record[:-4]) != seal:
                continue
            found_number, epoch, run, seq, time_s, at_ns, *rest = _STATE.unpack_from(record)
            if found_number == index:
                x, u = tuple(rest[:7]), tuple(rest[7:])
                how = (bool(lockstep), _FALLEN_BACK[driven])
                found.append(Noted(index, epoch, run, seq, time_s, at_ns, x, u, *how))
        return found, end

    def lay(self, weights: GpWeights | None) -> None:
        """Lays weights down; None: no correction. They have to fit the capacity."""
        for j, row in enumerate(self._outputs):
            row[:_HEAD] = 0.0
            if weights is None:
                continue
            output = weights.outputs[j]
            scale = output.y_scale * output.signal_variance
            row[:_HEAD] = KERNELS.index(output.kernel), output.count, output.y_mean, scale
            flat = (output.length_scales, output.inputs.ravel(), output.alpha)
            values = np.concatenate(flat)
            row[_HEAD : _HEAD + len(values)] = values

    def tell_watched(self, count: int, go_back: bool) -> None:
        """What the control thread waits for in lockstep."""
        self._words[1] = count << 1 | go_back

    def show_life(self) -> None:
        """Whoever does not for long is taken to hang."""
        self._words[2] = time.monotonic_ns()


def _anonymous_file(size: int) -> int:
    if hasattr(os, "memfd_create"):
        fd = os.memfd_create("bayesrace-gate")
    else:
        with tempfile.TemporaryFile() as file:
            fd = os.dup(file.fileno())
    os.ftruncate(fd, size)
    return fd
