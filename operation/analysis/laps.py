"""Where a car was in truth, at the samples of a log and between them, and its lap times."""

import hashlib
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from bayesrace.arrays import Floats
from bayesrace.columns import Columns
from bayesrace.integrators import PLANT_SCHEME, PLANT_SUBSTEP_HZ, Discretisation
from bayesrace.tracks import StartLine, Track
from bayesrace.vehicles import CarParameters

__all__ = ["LapTimes", "Trajectory", "positions_between", "time_laps", "trajectory_digest"]

SHORT_CUT: Final = 0.15
"""A leap along the centreline from one sample to the next of more than this share of the track
leaves out a piece of it: what comes after is no lap. (At 4 m/s a sample is .08 m.)"""

_SAME: Final = 0.05
"""Over the wheelbase: a car that is farther from the next sample after a period is another one."""

_AT_ONCE: Final = 1000
"""Samples; a hundred laps at once would take half a gigabyte."""


class Trajectory:
    """A run as arrays: what is judged is where the car was in truth, never what was measured."""

    @property
    def moments(self) -> Columns:
        """In order, one a sampling period: ``x``, ``u_applied``, ``time_s`` and ``lap``."""
        raise NotImplementedError

    @property
    def x(self) -> Floats:
        """True states, shape (n, 7)."""
        x: Floats = self.moments["x"]
        return x

    @property
    def u(self) -> Floats:
        """Inputs that acted from each state to the next, shape (max(n - 1, 0), 2)."""
        acted: Floats = self.moments["u_applied"][1:]
        return acted

    @property
    def time_s(self) -> Floats:
        """Plant time of the states, shape (n,)."""
        time_s: Floats = self.moments["time_s"]
        return time_s

    @cached_property
    def slip_rad(self) -> Floats:
        """Angle of the velocity to the left of the car's axis, shape (n,); 0 for a car that is
        slower than a hundredth of its largest speed."""
        vx, vy = self.x[:, 3], self.x[:, 4]
        speed = np.hypot(vx, vy)
        return np.where(speed > 0.01 * np.max(speed, initial=0.0), np.arctan2(vy, vx), 0.0)

    @cached_property
    def lateral_mps2(self) -> Floats:
        """Acceleration across the way, to the left, shape (n,): the mean over the period that
        begins; the last state keeps the one before."""
        turned = np.diff(np.unwrap(self.x[:, 2] + self.slip_rad))
        speed = np.hypot(self.x[:, 3], self.x[:, 4])
        across = (speed[1:] + speed[:-1]) / 2 * turned / np.diff(self.time_s)
        return np.append(across, across[-1:]) if len(across) else np.zeros(len(self.x))

    @property
    def lap(self) -> NDArray[np.int64]:
        """Start-line crossings up to each state, shape (n,)."""
        lap: NDArray[np.int64] = self.moments["lap"]
        return lap


@dataclass(frozen=True)
class LapTimes:
    """The laps of one run, in order."""

    times_s: tuple[float, ...]
    after: tuple[int, ...]
    """Index of the first sample after each lap's end."""
    cut_at: int | None
    """Index of the sample before which the car left out a piece of the track; no later lap
    counts. None if it never did."""


def time_laps(track: Track, time_s: Floats, xy: Floats, s_m: Floats) -> LapTimes:
    """Laps of a trajectory: times (n,), positions (n, 2), arc lengths on the centreline (n,).

    A lap ends where the car has crossed the start line once more forwards than backwards since the
    last one; the crossing is interpolated within the sampling period. The first lap begins at
    plant time 0.
    """
    line, crossings = StartLine(track), 0
    ends: list[float] = [0.0]
    after: list[int] = []
    half = track.length_m / 2
    leap = np.abs((np.diff(s_m) + half) % track.length_m - half)
    cuts = np.flatnonzero(leap > SHORT_CUT * track.length_m)
    cut_at = int(cuts[0]) + 1 if len(cuts) else None
    past = line.is_past(xy[:cut_at, 0], xy[:cut_at, 1])
    for k in (np.flatnonzero(past[1:] != past[:-1]) + 1).tolist():
        crossing = line.crossing(xy[k - 1].tolist(), xy[k].tolist())
        crossings += crossing.direction
        if crossings <= len(after):
            continue
        before_s = float(time_s[k - 1])
        ends.append(before_s + crossing.fraction * (float(time_s[k]) - before_s))
        after.append(k)
    return LapTimes(tuple(np.diff(ends).tolist()), tuple(after), cut_at)


def trajectory_digest(x: Floats, laps: LapTimes) -> str:
    """sha256 of the states (n, 7) up to the first sample after the last counted crossing.

    Of all states where no lap was finished.
    """
    states = x[: laps.after[-1] + 1] if laps.after else x
    return hashlib.sha256(states.astype("<f8", order="C").tobytes()).hexdigest()


def positions_between(run: Trajectory, car: CarParameters) -> Floats | None:
    """Positions (n - 1, m, 2) at the ends of the m sub-steps after each of the n samples.

    The built-in equations go through the same sub-steps again, from each logged state with the
    input that acted: in lockstep these are the plant's own states. In real time an input may change
    within a period, and its mean is what is logged; the car is then off by tenths of a millimetre.
    None where the samples are not evenly spaced, or where they are not those of the built-in
    equations.
    """
    steps = np.round(np.diff(run.time_s) * PLANT_SUBSTEP_HZ).astype(int)
    if not len(steps) or steps.min() < 1 or np.ptp(steps):
        return None
    places = _integrated(run.x[:-1], run.u, car, int(steps[0]))
    missed = np.linalg.norm(places[:, -1] - run.x[1:, :2], axis=1)
    return None if missed.max() > _SAME * car.wheelbase_m else places


def _integrated(x: Floats, u: Floats, car: CarParameters, count: int) -> Floats:
    """Positions (n, count, 2) after each sub-step from states (n, 7) with inputs (n, 2)."""
    import casadi as ca

    from bayesrace.vehicles.models import dynamic

    model = dynamic(car)
    substep = Discretisation(scheme=PLANT_SCHEME, step_s=1 / PLANT_SUBSTEP_HZ, substeps=1)
    period = substep.for_any_car(model).mapaccum(count)
    numbers = ca.DM(np.array(model.parameters))
    places = np.empty((len(x), count, 2))
    for begin in range(0, len(x), _AT_ONCE):
        part = slice(begin, begin + _AT_ONCE)
        starts, inputs = x[part], np.repeat(u[part], count, axis=0)
        after = period.map(len(starts))(
            starts.T, inputs.T, ca.repmat(numbers, 1, len(starts) * count)
        )
        places[part] = np.asarray(after)[:2].T.reshape(len(starts), count, 2)
    return places
