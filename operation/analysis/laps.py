"""Where a car was in truth, at the samples of a log and between them; its lap times; the verdict:
whether a run did what was asked, by the truth and by what drove the car."""

import hashlib
from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bayesrace.arrays import Floats, Rows
from bayesrace.columns import Columns, LogColumns, with_estimates
from bayesrace.controller.driver import Level
from bayesrace.integrators import PLANT_SCHEME, PLANT_SUBSTEP_HZ, Discretisation
from bayesrace.learning.sources import CYCLES, STATES, TRUE_STATES
from bayesrace.messages import STATE, TELEMETRY, TRUTH, Topic
from bayesrace.tracks import StartLine, Track
from bayesrace.vehicles import Car

__all__ = [
    "Cycles",
    "DrivenLaps",
    "LapTimes",
    "Trajectory",
    "Verdict",
    "judge",
    "judge_log",
    "laps_in",
    "positions_between",
    "time_laps",
    "trajectory_digest",
]

SHORT_CUT: Final = 0.15
"""A leap along the centreline from one sample to the next of more than this share of the track
leaves out a piece of it: what comes after is no lap. (At 4 m/s a sample is .08 m.)"""

_SAME: Final = 0.05
"""Over the wheelbase: a car that is farther from the next sample after a period is another one."""

_DRIVEN: Final = 0.5
"""Share of a run's time that solutions must have driven."""

_HELD_S: Final = 0.1
"""An input drives until the next one, and no longer than this."""

_LISTED: Final = 20
"""Lap times that a verdict lists; of more it gives the shortest and the longest."""

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
        return np.asarray(self.moments["x"])

    @property
    def u(self) -> Floats:
        """Inputs that acted from each state to the next, shape (max(n - 1, 0), 2)."""
        return np.asarray(self.moments["u_applied"][1:])

    @property
    def time_s(self) -> Floats:
        """Plant time of the states, shape (n,)."""
        return np.asarray(self.moments["time_s"])

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
        return np.asarray(self.moments["lap"])


@dataclass(frozen=True)
class LapTimes:
    """The laps of one run, in order."""

    times_s: tuple[float, ...]
    after: tuple[int, ...]
    """Index of the first sample after each lap's end."""
    cut_at: int | None
    """Index of the sample before which the car left out a piece of the track; no later lap
    counts. None if it never did."""
    before: int = 0
    """Laps that the plant has counted, but whose times are not in the log, as its beginning was
    deleted."""

    @property
    def count(self) -> int:
        """Of all laps."""
        return self.before + len(self.times_s)


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


def positions_between(run: Trajectory, car: Car) -> Floats | None:
    """Positions (n - 1, m, 2) at the ends of the m sub-steps after each of the n samples.

    The built-in equations go through the same sub-steps again, from each logged state with the
    input that acted: in lockstep these are the plant's own states. In real time an input may change
    within a period, and its mean is what is logged; the car is then off by tenths of a millimetre.
    None where the samples are not evenly spaced, or are not those of the built-in equations, or
    where these are not known of the car.
    """
    steps = np.round(np.diff(run.time_s) * PLANT_SUBSTEP_HZ).astype(int)
    if not car.identified or not len(steps) or steps.min() < 1 or np.ptp(steps):
        return None
    places = _integrated(run.x[:-1], run.u, car, int(steps[0]))
    missed = np.linalg.norm(places[:, -1] - run.x[1:, :2], axis=1)
    return None if missed.max() > _SAME * car.wheelbase_m else places


def _integrated(x: Floats, u: Floats, car: Car, count: int) -> Floats:
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


class Verdict(NamedTuple):
    """The verdict and the facts that it follows from, in one sentence."""

    passed: bool
    text: str


class Cycles:
    """The controller's cycles in one run: the state that each answered, what spoke against that
    state, and at which level the input was found."""

    def __init__(self, telemetry: Columns) -> None:
        """``telemetry``: its columns :data:`bayesrace.learning.sources.CYCLES`; of several cycles
        for one state the newest counts."""
        seqs = telemetry["state_seq"].tolist()
        self._levels = dict(zip(seqs, telemetry["fallback"].tolist(), strict=True))
        self._faults = dict(zip(seqs, telemetry["sensor_fault"], strict=True))

    @property
    def counts(self) -> dict[str, int]:
        """Number of cycles by the name of their level, of all levels."""
        found = Counter(self._levels.values())
        return {level.name.lower(): found[level] for level in Level}

    @property
    def sensor_faults(self) -> dict[str, int]:
        """Number of states that were not believed, by kind."""
        return dict(Counter(filter(None, self._faults.values())))

    def __str__(self) -> str:
        levels = [f"{count} {name}" for name, count in self.counts.items() if count]
        faults = [f"{count} {name}" for name, count in self.sensor_faults.items()]
        text = f"cycles: {', '.join(levels) or 'none'}".replace("_", " ")
        return text + (f"; sensor faults: {', '.join(faults)}" if faults else "")

    def driven_s(self, seqs: Rows, time_s: Floats) -> float:
        """Time for which solutions have driven, of a run with these states."""
        levels = np.array([self._levels.get(seq, -1) for seq in seqs.tolist()])
        answered = levels >= 0
        held = np.minimum(np.diff(np.append(time_s[answered], time_s[-1])), _HELD_S)
        return float(held[levels[answered] == Level.SOLUTION].sum())


def judge(
    samples: Columns, off_track_m: Floats, laps: LapTimes, cycles: Cycles, asked: int
) -> Verdict:
    """Judges a run of which ``asked`` laps were wanted; 0: none.

    ``samples``: the truth, or the measurements of a car that knows none. ``off_track_m``: how far
    outside of the track the counted ones are.
    """
    faults: list[str] = []
    if not len(samples):
        return Verdict(False, "failed: there is no state of the run")
    if laps.count < asked:
        fault = f"{laps.count} of {asked} laps driven"
        if laps.cut_at is not None:
            cut_s = samples["time_s"][laps.cut_at]
            fault += f": at {cut_s:.2f} s the car left out a piece of the track"
        faults.append(fault)
    if (off := int((off_track_m > 0).sum())) > 0:
        faults.append(f"{off} samples off the track, up to {off_track_m.max():.3f} m")
    time_s = samples["time_s"]
    lasted_s = float(time_s[-1] - time_s[0])
    driven_s = cycles.driven_s(samples["seq"], time_s)
    if driven_s < _DRIVEN * lasted_s:
        faults.append(f"solutions drove the car for {driven_s:.2f} of {lasted_s:.2f} s")
    if faults:
        return Verdict(False, f"failed: {'; '.join(faults)} ({cycles})")
    done = _driven(laps) or f"{lasted_s:.2f} s driven"
    before = f"; {laps.before} laps before these are not in the log any more" if laps.before else ""
    return Verdict(True, f"passed: {done}, on the track throughout ({cycles}){before}")


def _driven(laps: LapTimes) -> str:
    """The laps with their times, or with the range of many; empty without any."""
    if not (times := laps.times_s):
        return ""
    listed = ", ".join(f"{time:.3f}" for time in times)
    many = f"{min(times):.3f} to {max(times):.3f}"
    count = f"{len(times)} lap{'s' if len(times) > 1 else ''}"
    return f"{count} in {many if len(times) > _LISTED else listed} s"


class DrivenLaps(NamedTuple):
    """What a run in a log is judged by, in the order in which :func:`judge` takes it."""

    samples: Columns
    off_track_m: Floats
    laps: LapTimes
    cycles: Cycles


def laps_in(log: Path, run: int, track: Track) -> DrivenLaps:
    """What a run in a log was; InputError if there is no log."""
    wanted: dict[Topic[Any], str] = {
        STATE: f"{STATES} lap", TRUTH: f"{TRUE_STATES} lap", TELEMETRY: CYCLES
    }  # fmt: skip
    columns = LogColumns(log, wanted).read()
    states, truth, telemetry = (columns[one][columns[one]["run"] == run] for one in wanted)
    known = truth if len(truth) else with_estimates(states, telemetry)
    projected = track.project_path(known["x"][:, :2])
    laps = time_laps(track, known["time_s"], known["x"][:, :2], projected.s_m)
    counted = laps.after[-1] if laps.after else len(known)
    if columns.reader.parts_gone and len(known) and known["time_s"][0] > 0:
        # The lap that its first sample is in the middle of has a number, and no time.
        begun = len(laps.times_s[:1])
        laps = replace(laps, times_s=laps.times_s[1:], after=laps.after[1:],
                       before=int(known["lap"][0]) + begun)  # fmt: skip
    return DrivenLaps(known, projected.off_track_m[:counted], laps, Cycles(telemetry))


def judge_log(log: Path, run: int, track: Track, asked: int) -> Verdict:
    """Judges a run in a log."""
    return judge(*laps_in(log, run, track), asked)
