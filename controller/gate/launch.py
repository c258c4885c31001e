"""Starts the gatekeeper without holding up the interpreter's other threads.

``subprocess`` keeps the interpreter's lock while the system makes the process, which takes a
millisecond or more: too long when the control loop runs in the same interpreter. ``posix_spawn``
called through ctypes does not.
"""

import ctypes as ct
import os
import sys
import time
from collections.abc import Sequence
from typing import Final

from bayesrace.interpreter import RUN_MODULE

__all__ = ["ended", "spawn"]

_SETPGROUP: Final = 0x02
_ATTRIBUTES_BYTES: Final = 1024
"""More than any system's ``posix_spawnattr_t``."""


def spawn(module: str, arguments: Sequence[str]) -> int:
    """Process number of ``python -m module arguments``; inheritable descriptors go with it.

    A process group of its own: Ctrl-C at the terminal is the starter's matter. OSError if the
    system does not start it.
    """
    libc = ct.CDLL(None, use_errno=True)
    path = os.pathsep.join(os.path.abspath(entry) for entry in sys.path if entry)  # noqa: PTH100
    environment = {**os.environ, "PYTHONPATH": path}
    words = [*RUN_MODULE, module, *arguments]
    pairs = [f"{name}={value}" for name, value in environment.items()]
    attributes = ct.create_string_buffer(_ATTRIBUTES_BYTES)
    pid = ct.c_int()
    libc.posix_spawnattr_init(attributes)
    libc.posix_spawnattr_setflags(attributes, ct.c_short(_SETPGROUP))
    error = libc.posix_spawn(
        ct.byref(pid), os.fsencode(sys.executable), None, attributes, _texts(words), _texts(pairs)
    )
    libc.posix_spawnattr_destroy(attributes)
    if error:
        raise OSError(error, os.strerror(error))
    return pid.value


def ended(pid: int, patience_s: float) -> bool:
    """Whether the child has ended within that time; it is then forgotten."""
    deadline = time.monotonic() + patience_s
    while True:
        try:
            if os.waitpid(pid, os.WNOHANG)[0]:
                return True
        except ChildProcessError:
            return True
        if time.monotonic() > deadline:
            return False
        time.sleep(0.005)


def _texts(words: Sequence[str]) -> "ct.Array[ct.c_char_p]":
    encoded = [*map(os.fsencode, words), None]
    return (ct.c_char_p * len(encoded))(*encoded)
