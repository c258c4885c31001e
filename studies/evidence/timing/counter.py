"""Instructions that this thread executes, by the processor's counter (Linux, perf_event_open)."""

import ctypes
import os
import platform
from typing import Final

__all__ = ["InstructionCounter"]

_CALL: Final = {"x86_64": 298, "aarch64": 241}
"""Of perf_event_open."""
_SIZE: Final = 112
"""PERF_ATTR_SIZE_VER5."""
_INSTRUCTIONS: Final = 1
_USER_ALONE: Final = 1 << 5 | 1 << 6
"""exclude_kernel, exclude_hv."""


class InstructionCounter:
    """Counts from its making on; ``missing`` says why it cannot, and is empty if it can."""

    def __init__(self) -> None:
        self.missing, self._file = "", -1
        call = _CALL.get(platform.machine()) if platform.system() == "Linux" else None
        if call is None:
            self.missing = f"none known of {platform.system()} on {platform.machine()}"
            return
        words = (ctypes.c_uint64 * (_SIZE // 8))()
        words[0], words[1], words[5] = _SIZE << 32, _INSTRUCTIONS, _USER_ALONE
        libc = ctypes.CDLL(None, use_errno=True)
        self._file = libc.syscall(call, ctypes.byref(words), 0, -1, -1, 0)
        if self._file < 0:
            self.missing = f"perf_event_open: {os.strerror(ctypes.get_errno())}"

    def read(self) -> int:
        """So far; 0 where there is no counter."""
        return 0 if self.missing else int.from_bytes(os.read(self._file, 8), "little")

    def close(self) -> None:
        """Gives the counter back."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
