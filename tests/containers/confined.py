"""Runs a program that may make no system calls but those named, as systemd's SystemCallFilter does:

    python -m tests.containers.confined CALL... -- PROGRAM ARGUMENT...

A call that is not allowed fails with EPERM.
"""

import ctypes
import errno
import os
import sys
from typing import Final

LIBRARY: Final = "libseccomp.so.2"
_ALLOW: Final = 0x7FFF0000
_ERRNO: Final = 0x00050000


def _confine(names: list[str]) -> None:
    seccomp = ctypes.CDLL(LIBRARY)
    seccomp.seccomp_init.restype = ctypes.c_void_p
    context = ctypes.c_void_p(seccomp.seccomp_init(_ERRNO | errno.EPERM))
    for name in names:
        number = seccomp.seccomp_syscall_resolve_name(name.encode())
        if number >= 0:  # others are those of other processors
            added = seccomp.seccomp_rule_add_array(context, _ALLOW, number, 0, None)
            assert added == 0, name
    assert seccomp.seccomp_load(context) == 0


if __name__ == "__main__":
    end = sys.argv.index("--")
    _confine(sys.argv[1:end])
    os.execv(sys.argv[end + 1], sys.argv[end + 1 :])  # noqa: S606 (no shell, as systemd)
