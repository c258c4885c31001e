"""Resident memory of processes over time."""

import os
from pathlib import Path
from typing import Final

from experiments.latency.results import Memory

__all__ = ["MemoryWatch", "resident_bytes"]

_PAGE: Final = os.sysconf("SC_PAGE_SIZE")
_WARM_UP_S: Final = 60.0


def resident_bytes(pid: int) -> int | None:
    """Resident memory of the process; None if it is gone or the system has no /proc."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * _PAGE
    except (OSError, IndexError, ValueError):
        return None


class MemoryWatch:
    """Growth after the first minute, or after the first third of a run under three minutes."""

    def __init__(self, pids: dict[str, int], duration_s: float) -> None:
        self._pids = pids
        self._from_s = min(_WARM_UP_S, duration_s / 3)
        self._begin: dict[str, int] = {}
        self._most: dict[str, int] = {}

    def look(self, elapsed_s: float) -> None:
        """Takes note of all, ``elapsed_s`` after the beginning."""
        if elapsed_s < self._from_s:
            return
        for name, pid in self._pids.items():
            resident = resident_bytes(pid)
            if resident is not None:
                self.note(name, resident)

    def note(self, name: str, resident: int) -> None:
        """Takes note of one."""
        self._begin.setdefault(name, resident)
        self._most[name] = max(self._most.get(name, 0), resident)

    def result(self) -> dict[str, Memory]:
        """By process."""
        return {
            name: Memory(begin_bytes=begin, most_bytes=self._most[name])
            for name, begin in self._begin.items()
        }
