"""Instructions of each phase of a cycle, counted by valgrind while a C program answers.

The count is the same each time to one in a million (a launch's has differed by 6e-5, once), and on
any processor of the kind: of user code, with the instruction sets that valgrind knows (AVX2, where
the processor has AVX-512).
"""

import itertools
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bayesrace.messages import State
from bayesrace.operation.host import HostProgram

__all__ = ["COUNTED", "Counts", "count_instructions", "missing"]

Counts = NDArray[np.int64]

COUNTED: Final = ("estimate", "feedback", "prepare")
"""Phases, in the order of a cycle."""

_CALLS: Final = ("br_cycle_observe", "br_cycle_decide", "br_cycle_prepare")
"""What each of them is in C."""

_PART: Final = re.compile(r"^desc: Trigger: --dump-after=(\w+)$.*^totals: (\d+)$", re.M | re.S)


def missing() -> str:
    """Why nothing can be counted here; empty if it can."""
    return "" if shutil.which("valgrind") else "valgrind is not installed"


def count_instructions(host: HostProgram, states: Sequence[State]) -> Counts:
    """Of the phases (n, 3) for each state that is answered."""
    counts = host.folder / "counts"
    tool = ["valgrind", "-q", "--tool=callgrind", f"--callgrind-out-file={counts}"]
    tool.append(f"--dump-before={_CALLS[0]}")
    tool += [f"--dump-after={one}" for one in _CALLS]
    host.answers(states, tool)
    rows: list[list[int]] = []
    for number in itertools.count(1):  # what is before a cycle, then its phases
        part = Path(f"{counts}.{number}")
        if not part.is_file():
            break
        if match := _PART.search(part.read_text()):
            if match[1] == _CALLS[0]:
                rows.append([])
            rows[-1].append(int(match[2]))
    answered = [row for row in rows if len(row) == len(_CALLS)]
    return np.array(answered).reshape(-1, len(_CALLS))
