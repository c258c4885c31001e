"""A racing line as data, and its file form. No optimiser is needed to read or use one.

Columns ``s_m; x_m; y_m; psi_rad; kappa_radpm; vx_mps; ax_mps2``, as the TUM and F1TENTH communities
have them; lines with # are comments. Those of the form ``# key: value`` say what the line was made
for (:class:`LineIdentity`). Every number that is written reads back as the same double.
"""

import math
import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.files import read_text, write_whole
from bayesrace.tracks.files import read_table

__all__ = ["RACELINE_COLUMNS", "LineIdentity", "RaceLine", "read_raceline", "write_raceline"]

RACELINE_COLUMNS: Final = ("s_m", "x_m", "y_m", "psi_rad", "kappa_radpm", "vx_mps", "ax_mps2")
_MIN_POINTS: Final = 8
_HEADINGS_DIFFER: Final = 0.3
"""Mean distance on the unit circle within which two headings are the same."""
_KEY: Final = re.compile(r"#\s*(\w+):\s*(\S+)\s*")


@dataclass(frozen=True)
class LineIdentity:
    """What a racing line was made for."""

    car: str
    """Name and digest: :attr:`bayesrace.vehicles.CarParameters.identity`."""
    width_m: float
    """Of the car, which the distance from the edges follows."""
    friction: float
    """Usable acceleration over g [-]."""
    track: str
    """Name and digest: :attr:`bayesrace.tracks.Track.identity`."""
    settings: str
    """Digest of the optimisation's settings."""


@dataclass(frozen=True, eq=False)
class RaceLine:
    """Closed racing line, arrays (n,) in driving order; the last point is not the first again.

    ``s_m`` is arc length along the line itself from the start line; ``psi_rad`` the direction of
    the path, continuous (it ends a full turn away from where it began); ``kappa_radpm`` its
    curvature, positive to the left; ``vx_mps`` speed; ``ax_mps2`` acceleration along the path.
    """

    track_name: str
    s_m: Floats
    x_m: Floats
    y_m: Floats
    psi_rad: Floats
    kappa_radpm: Floats
    vx_mps: Floats
    ax_mps2: Floats
    length_m: float
    made_for: LineIdentity | None = None
    """None: not known; the line comes from elsewhere."""

    @property
    def lap_time_s(self) -> float:
        """Time of a flying lap at the line's speeds, acceleration constant between points."""
        step = np.diff(np.append(self.s_m, self.s_m[0] + self.length_m))
        return float(np.sum(2.0 * step / (self.vx_mps + np.roll(self.vx_mps, -1))))

    @property
    def xy_m(self) -> Floats:
        """The points, shape (n, 2)."""
        return np.column_stack([self.x_m, self.y_m])


def write_raceline(path: Path | str, line: RaceLine) -> None:
    """Writes the line; the first point is repeated at the end with the length as its s.

    The repetition carries the length; psi of the last row continues that of the row before.
    """
    table = np.column_stack([getattr(line, name) for name in RACELINE_COLUMNS])
    closing = table[:1].copy()
    closing[0, 0] = line.s_m[0] + line.length_m
    closing[0, 3] += 2 * np.pi * np.round((line.psi_rad[-1] - line.psi_rad[0]) / (2 * np.pi))
    rows = np.concatenate([table, closing]).tolist()
    lines = [f"# {'; '.join(RACELINE_COLUMNS)}"]
    if line.made_for is not None:
        lines += [f"# {f.name}: {getattr(line.made_for, f.name)}" for f in fields(LineIdentity)]
    lines += ["; ".join(repr(value) for value in row) for row in rows]
    write_whole(Path(path), "\n".join(lines) + "\n")


def read_raceline(path: Path | str, track_name: str | None = None) -> RaceLine:
    """The racing line in a file, with or without the first point repeated at the end.

    ``track_name``: default: the file's name. Raises InputError naming file, row and remedy.
    """
    path = Path(path)
    table, rows = read_table(path, RACELINE_COLUMNS)
    if len(table) < _MIN_POINTS:
        raise InputError(
            f"{path}: too few points ({len(table)}); a racing line needs at least {_MIN_POINTS}"
        )
    step = np.diff(table[:, 0])
    if not (step > 0).all():
        row = rows[int(np.argmin(step > 0)) + 1]
        raise InputError(f"{path}, row {row}: s_m does not grow; give the rows in driving order")
    chord = np.linalg.norm(np.diff(table[:, 1:3], axis=0), axis=1)
    uneven = (chord > 1.01 * step + 1e-3) | (chord < 0.5 * step - 1e-3)
    if uneven.any():
        row = rows[int(np.argmax(uneven)) + 1]
        raise InputError(
            f"{path}, row {row}: s_m and the distance to the point before disagree; "
            "s_m must be the arc length of the line itself in metres"
        )
    if not (table[:, 5] > 0).all():
        row = rows[int(np.argmin(table[:, 5] > 0))]
        raise InputError(
            f"{path}, row {row}: vx_mps is not positive; a racing line is a flying lap"
        )
    closing = float(np.linalg.norm(table[-1, 1:3] - table[0, 1:3]))
    if closing <= 1e-3 * float(np.median(step)):
        length, table = float(table[-1, 0] - table[0, 0]), table[:-1]
    elif closing <= 3.0 * float(np.max(step)):
        length = float(table[-1, 0] - table[0, 0]) + closing
    else:
        raise InputError(
            f"{path}, row {rows[-1]}: the line ends {closing:.3g} m from where it began; "
            "a racing line must be closed"
        )
    name = path.stem if track_name is None else track_name
    s, x, y, psi, kappa, v, a = np.ascontiguousarray(table.T)
    psi = _continuous(psi, table[:, 1:3])
    return RaceLine(name, s, x, y, psi, kappa, v, a, length, _made_for(path))


def _continuous(psi: Floats, xy: Floats) -> Floats:
    """Headings without jumps, from the x axis; those of TUM's planner count from the y axis."""
    chord = np.roll(xy, -1, axis=0) - np.roll(xy, 1, axis=0)
    off = np.mean(np.exp(1j * (psi - np.arctan2(chord[:, 1], chord[:, 0]))))
    from_y_axis = abs(off + 1j) < _HEADINGS_DIFFER
    return np.asarray(np.unwrap(psi + np.pi / 2 if from_y_axis else psi))


def _made_for(path: Path) -> LineIdentity | None:
    """None unless the comments say all of it."""
    text = read_text(path, "the racing line")
    found = (_KEY.fullmatch(row) for row in text.splitlines() if row.startswith("#"))
    values = {match[1]: match[2] for match in found if match}
    try:
        width_m, friction = float(values["width_m"]), float(values["friction"])
        made = LineIdentity(values["car"], width_m, friction, values["track"], values["settings"])
    except (KeyError, ValueError):
        return None
    return made if math.isfinite(width_m) and math.isfinite(friction) else None
