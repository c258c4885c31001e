"""What an FMU prints: passed on to standard error within bounds, its last line kept."""

import contextlib
import os
import select
from typing import Final

__all__ = ["Output"]

_SHOWN: Final = 1 << 16
"""Bytes of one run that are passed on."""
_CHUNK: Final = 1 << 16
_KEPT: Final = 600


class Output:
    """The reading end of the pipe that is an FMU's standard output and error."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        os.set_blocking(descriptor, False)
        self._left = _SHOWN
        self._tail = b""

    def restart(self) -> None:
        """A new run: pass on again, forget what was said."""
        self.pump()
        self._left = _SHOWN
        self._tail = b""

    def pump(self) -> bool:
        """Takes what is there, a bounded lot; False at the end of the pipe."""
        for _ in range(16):
            try:
                data = os.read(self._descriptor, _CHUNK)
            except BlockingIOError:
                return True
            except OSError:  # closed
                return False
            if not data:
                return False
            self._tail = (self._tail + data)[-_KEPT:]
            self._pass_on(data)
        return True

    @property
    def last_line(self) -> str:
        """The last line printed, "" if there is none."""
        lines = self._tail.decode(errors="replace").strip().splitlines()
        return lines[-1].strip() if lines else ""

    def close(self) -> None:
        """No more."""
        with contextlib.suppress(OSError):
            os.close(self._descriptor)
        self._descriptor = -1

    def _pass_on(self, data: bytes) -> None:
        if self._left <= 0:
            return
        data = data[: self._left]
        self._left -= len(data)
        if self._left <= 0:
            data += b"\n[what else the FMU prints is not shown]\n"
        for begin in range(0, len(data), select.PIPE_BUF):
            # A standard error that nobody reads must not hold up the car: then it is lost.
            with contextlib.suppress(OSError, ValueError):
                if select.select((), (2,), (), 0)[1]:
                    os.write(2, data[begin : begin + select.PIPE_BUF])
