"""A limit as data, and its file form: a CSV of states and inputs over time.

Comments say what the limit is and how well it is known.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from pydantic import Field

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.strict import StrictModel
from bayesrace.tracks.tables import read_table, write_table

__all__ = ["LimitLap", "LimitSettings", "read_limit", "write_limit"]

_COLUMNS: Final = (
    "t_s", "x_m", "y_m", "psi_rad", "vx_mps", "vy_mps", "omega_radps", "delta_rad", "d",
    "ddelta_radps",
)  # fmt: skip
_KEYS: Final = {
    "car": str, "track": str, "lap_s": float, "intervals": int, "mesh_change": float,
    "solve_s": float,
}  # fmt: skip


class LimitSettings(StrictModel):
    """Settings of :func:`bayesrace.limit.compute_limit`."""

    standing: bool = Field(False, description="from the start pose; otherwise a flying lap")
    start_speed_mps: float = Field(
        0.1, ge=0, le=5, description="speed at the start of a standing lap"
    )
    margin_m: float = Field(0.0, ge=0, description="least distance of the car from the edge")
    body: bool = Field(
        False, description="the car's outline keeps the margin; otherwise its centre of gravity"
    )
    lateral_speed_mps: float | None = Field(
        None, gt=0, description="largest lateral speed |vy|, for a lap without slides; None: any"
    )
    max_iterations: int = Field(300, ge=1, description="iteration limit of the optimiser")


@dataclass(frozen=True, eq=False)
class LimitLap:
    """The fastest lap of a car on a track, as minimum-time optimal control finds it."""

    car: str
    """Name and digest: :attr:`bayesrace.vehicles.Car.identity`."""
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
    about = {key: getattr(lap, key) for key in _KEYS}
    write_table(path, _COLUMNS, np.column_stack([lap.t_s, lap.x, lap.u]), about)


def read_limit(path: Path | str) -> LimitLap:
    """The limit in a file that :func:`write_limit` has written; InputError naming what is wrong."""
    table, _, said = read_table(Path(path), _COLUMNS)
    try:
        about = {key: kind(said[key]) for key, kind in _KEYS.items()}
        if not (0 < about["lap_s"] < math.inf):
            raise ValueError
    except (KeyError, ValueError):
        raise InputError(
            f"{path} does not say which limit it is; write it anew with 'bayesrace limit'"
        ) from None
    return LimitLap(**about, t_s=table[:, 0], x=table[:, 1:8], u=table[:, 8:])
