"""A limit as data, and its file form: a CSV of states and inputs over time.

Columns :data:`COLUMNS`; lines with # are comments, and those of the form ``# key: value`` say what
the limit is and how well it is known.
"""

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.files import read_text, write_whole
from bayesrace.tracks.files import read_table

__all__ = ["COLUMNS", "LimitLap", "read_limit", "write_limit"]

COLUMNS: Final = (
    "t_s", "x_m", "y_m", "psi_rad", "vx_mps", "vy_mps", "omega_radps", "delta_rad", "d",
    "ddelta_radps",
)  # fmt: skip
_KEY: Final = re.compile(r"#\s*(\w+):\s*(\S+)\s*")
_KEYS: Final = {
    "car": str, "track": str, "lap_s": float, "intervals": int, "mesh_change": float,
    "solve_s": float,
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class LimitLap:
    """The fastest lap of a car on a track, as minimum-time optimal control finds it."""

    car: str
    """Name and digest: :attr:`bayesrace.vehicles.CarParameters.identity`."""
    track: str
    """Name and digest: :attr:`bayesrace.tracks.Track.identity`."""
    lap_s: float
    intervals: int
    """Of the mesh; this many from the start to the end of the lap."""
    mesh_change: float
    """Share by which the lap differs from that on the mesh with half as many intervals."""
    solve_s: float
    """How long the optimisation took."""
    t_s: Floats
    """Times (n,) of the rows, from 0 to the lap's."""
    x: Floats
    """States (n, 7): x, y, psi, vx, vy, omega, delta."""
    u: Floats
    """Inputs (n, 2): drive command and steering rate, linear in between."""


def write_limit(path: Path | str, lap: LimitLap) -> None:
    """Writes the whole file or nothing."""
    rows = np.column_stack([lap.t_s, lap.x, lap.u]).tolist()
    lines = [f"# {'; '.join(COLUMNS)}", *(f"# {key}: {getattr(lap, key)}" for key in _KEYS)]
    lines += ["; ".join(repr(value) for value in row) for row in rows]
    write_whole(Path(path), "\n".join(lines) + "\n")


def read_limit(path: Path | str) -> LimitLap:
    """The limit in a file that :func:`write_limit` has written; InputError naming what is wrong."""
    path = Path(path)
    table, _ = read_table(path, COLUMNS)
    text = read_text(path, "the limit")
    found = (_KEY.fullmatch(row) for row in text.splitlines() if row.startswith("#"))
    values = {match[1]: match[2] for match in found if match}
    try:
        about = {key: kind(values[key]) for key, kind in _KEYS.items()}
        if not (0 < about["lap_s"] < math.inf):
            raise ValueError
    except (KeyError, ValueError):
        raise InputError(
            f"{path} does not say which limit it is; write it anew with 'bayesrace limit'"
        ) from None
    return LimitLap(**about, t_s=table[:, 0], x=table[:, 1:8], u=table[:, 8:])
