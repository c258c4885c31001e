"""The output of an FMU's process: passed on to standard error within bounds, its end kept."""

import os
import re
import select
from contextlib import suppress
from typing import Final

__all__ = ["Output"]

_SHOWN: Final = 1 << 16
"""Bytes of one run that are passed on."""
_KEPT: Final = 4096
"""Bytes in which the last message is looked for."""
_TROUBLE: Final = re.compile(r"^\[FMU (?!info)\w+\] (.+)", re.MULTILINE)


class Output:
    """The reading end of the pipe that is an FMU's standard output and error, and its log."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        os.set_blocking(descriptor, False)
        self._left, self._tail = _SHOWN, b""

    def restart(self) -> None:
        """A new run: pass on again, and forget the output of the last one."""
        self.pump()
        self._left, self._tail = _SHOWN, b""

    def pump(self) -> bool:
        """Takes what is there, up to a megabyte; False at the end of the pipe."""
        for _ in range(16):
            try:
                data = os.read(self._descriptor, 1 << 16)
            except BlockingIOError:
                return True
            if not data:
                return False
            self._tail = (self._tail + data)[-_KEPT:]
            self._pass_on(data[: self._left])
        return True

    def last_message(self) -> str:
        """The last message of its log that reports trouble, or else the last line."""
        self.pump()
        text = self._tail.decode(errors="replace").strip()
        lines: list[str] = _TROUBLE.findall(text) or text.splitlines()
        return lines[-1].removeprefix("[FMU info]").strip() if lines else ""

    def close(self) -> None:
        """No more."""
        os.close(self._descriptor)

    def _pass_on(self, data: bytes) -> None:
        self._left -= len(data)
        if data and not self._left:
            data += b"\n[what else the FMU prints is not shown]\n"
        # A standard error that nothing reads must not hold up the car: then it is lost.
        for begin in range(0, len(data), select.PIPE_BUF):
            with suppress(OSError, ValueError):
                if select.select((), (2,), (), 0)[1]:
                    os.write(2, data[begin : begin + select.PIPE_BUF])
