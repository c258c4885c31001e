"""A racing line as data, its file form, and what it was made for, checked where it is driven.

Columns ``s_m; x_m; y_m; psi_rad; kappa_radpm; vx_mps; ax_mps2``, as the TUM and F1TENTH communities
have them; comments say what the line was made for (:class:`LineIdentity`). No optimiser is needed
to read or use a line.
"""

import logging
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import numpy as np
from pydantic import Field

from bayesrace.arrays import Floats
from bayesrace.cache import digest
from bayesrace.errors import InputError
from bayesrace.strict import StrictModel
from bayesrace.tracks import Track
from bayesrace.tracks.tables import read_table, write_table
from bayesrace.vehicles.parameters import Car

__all__ = [
    "LineIdentity",
    "RaceLine",
    "RaceLineError",
    "RaceLineSettings",
    "check_line",
    "line_identity",
    "read_raceline",
    "read_raceline_for",
    "same_track",
    "write_raceline",
]

_log = logging.getLogger("bayesrace.raceline")

_COLUMNS: Final = ("s_m", "x_m", "y_m", "psi_rad", "kappa_radpm", "vx_mps", "ax_mps2")
_MIN_POINTS: Final = 8
_HEADINGS_DIFFER: Final = 0.3
"""Mean distance on the unit circle within which two headings are the same."""


class RaceLineError(RuntimeError):
    """The optimiser found no racing line; the message says how it ended and what may help."""


class RaceLineSettings(StrictModel):
    """Settings of :func:`bayesrace.raceline.compute_raceline`; the car's tuning has its steps."""

    friction: float | None = Field(
        default=None, gt=0, le=5, description="horizontal acceleration over g; None: the car's"
    )
    margin_m: float | None = Field(
        default=None, ge=0, description="centre of gravity to track edge; None: half a car's width"
    )
    max_iterations: int = Field(default=500, ge=1, description="iteration limit of the optimiser")


@dataclass(frozen=True)
class LineIdentity:
    """What a racing line was made for."""

    car: str
    """Name and digest: :attr:`bayesrace.vehicles.Car.identity`."""
    width_m: float
    """Of the car, which the distance from the edges follows."""
    friction: float
    """Usable acceleration over g [-]."""
    track: str
    """Name and digest: :attr:`bayesrace.tracks.Track.identity`."""
    settings: str
    """Digest of the optimisation's settings."""


@dataclass(frozen=True, eq=False, repr=False)
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

    def __repr__(self) -> str:
        return f"<RaceLine on '{self.track_name}': {self.length_m:.3f} m, {self.lap_time_s:.3f} s>"

    @property
    def duration_s(self) -> Floats:
        """Time from each point to the next, (n,), acceleration constant between points."""
        step = np.diff(np.append(self.s_m, self.s_m[0] + self.length_m))
        return np.asarray(2.0 * step / (self.vx_mps + np.roll(self.vx_mps, -1)))

    @property
    def lap_time_s(self) -> float:
        """Time of a flying lap at the line's speeds."""
        return float(np.sum(self.duration_s))

    @property
    def xy_m(self) -> Floats:
        """The points, shape (n, 2)."""
        return np.column_stack([self.x_m, self.y_m])


def write_raceline(path: Path | str, line: RaceLine) -> None:
    """Writes the line; the first point is repeated at the end with the length as its s.

    The repetition carries the length; psi of the last row continues that of the row before.
    """
    table = np.column_stack([getattr(line, name) for name in _COLUMNS])
    closing = table[:1].copy()
    closing[0, 0] = line.s_m[0] + line.length_m
    closing[0, 3] += 2 * np.pi * np.round((line.psi_rad[-1] - line.psi_rad[0]) / (2 * np.pi))
    about = {} if line.made_for is None else asdict(line.made_for)
    write_table(path, _COLUMNS, np.concatenate([table, closing]), about)


def read_raceline(path: Path | str, track_name: str | None = None) -> RaceLine:
    """The racing line in a file, with or without the first point repeated at the end.

    ``track_name``: default: the file's name. Raises InputError naming file, row and remedy.
    """
    path = Path(path)
    table, rows, about = read_table(path, _COLUMNS)
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
    return RaceLine(name, s, x, y, psi, kappa, v, a, length, _made_for(about))


def _continuous(psi: Floats, xy: Floats) -> Floats:
    """Headings without jumps, from the x axis; those of TUM's planner count from the y axis."""
    chord = np.roll(xy, -1, axis=0) - np.roll(xy, 1, axis=0)
    off = np.mean(np.exp(1j * (psi - np.arctan2(chord[:, 1], chord[:, 0]))))
    from_y_axis = abs(off + 1j) < _HEADINGS_DIFFER
    return np.asarray(np.unwrap(psi + np.pi / 2 if from_y_axis else psi))


def _made_for(about: dict[str, str]) -> LineIdentity | None:
    """None unless the comments say all of it."""
    try:
        width_m, friction = float(about["width_m"]), float(about["friction"])
        made = LineIdentity(about["car"], width_m, friction, about["track"], about["settings"])
    except (KeyError, ValueError):
        return None
    return made if math.isfinite(width_m) and math.isfinite(friction) else None


def line_identity(track: Track, car: Car, settings: RaceLineSettings) -> LineIdentity:
    """Of the line that these give."""
    return LineIdentity(
        car=car.identity,
        width_m=car.width_m,
        friction=car.friction if settings.friction is None else settings.friction,
        track=track.identity,
        settings=digest([settings.model_dump_json(), car.tuning.raceline.model_dump_json()]),
    )


def check_line(line: RaceLine, track: Track, car: Car, where: str) -> None:
    """InputError, beginning with ``where``, if the line was made for another car, grip or track.

    Names do not count, only what they stand for. A line that does not say what it was made for is
    accepted, with a warning in the log; how it was computed (``settings``) is not compared.
    """
    made = line.made_for
    if made is None:
        _log.warning(
            "%s does not say for which car, grip and track it was made: it is driven as it is",
            where,
        )
        return
    remedy = "run 'bayesrace raceline' for this one, or name the one that the line is for"
    if _shape(made.car) != car.digest():
        fault = f"the car '{made.car}', this is '{car.identity}'"
    elif made.width_m != car.width_m:
        fault = f"a car {made.width_m:g} m wide, '{car.name}' is {car.width_m:g} m"
    elif made.friction != car.friction:
        fault = f"a friction of {made.friction:g}, the car '{car.name}' has {car.friction:g}"
        remedy = f"run 'bayesrace raceline' for it, or set [limits] friction = {made.friction:g}"
    elif not same_track(made.track, track.identity):
        fault = f"the track '{made.track}', this is '{track.identity}'"
    else:
        return
    raise InputError(f"{where} was made for {fault}: {remedy}")


def same_track(one: str, other: str) -> bool:
    """Whether two :attr:`bayesrace.tracks.Track.identity` are of one shape, whatever the names."""
    return _shape(one) == _shape(other)


def _shape(identity: str) -> str:
    """The digest of a name with a digest."""
    return identity.rpartition("-")[2]


def read_raceline_for(path: Path, track: Track, car: Car) -> RaceLine:
    """The racing line in a file, to be driven by ``car`` on ``track``; see :func:`check_line`."""
    line = read_raceline(path, track.name)
    check_line(line, track, car, str(path))
    return line
