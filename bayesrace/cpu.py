"""What CPU this is, as far as code compiled for it (-march=native) depends on it."""

import hashlib
import platform
from functools import cache
from pathlib import Path

__all__ = ["cpu_digest", "cpu_identity"]


@cache
def cpu_identity() -> str:
    """Model and features: a library built on one CPU may not run on another."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()}"
    wanted = ("model name", "flags", "Features", "CPU part")
    return "\n".join(dict.fromkeys(s for s in lines if s.startswith(wanted)))


def cpu_digest() -> str:
    """Short form of :func:`cpu_identity`."""
    return hashlib.sha256(cpu_identity().encode()).hexdigest()[:12]
