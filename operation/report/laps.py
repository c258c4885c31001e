"""Laps as functions of the arc length of the centreline."""

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import CubicSpline

from bayesrace.arrays import Floats
from bayesrace.tracks import Track
from operation.analysis.race import DrivenRun

__all__ = ["Lap", "first_laps", "flying_laps", "reference_of"]


_SLOW_MPS = 0.05
_POINTS, _SMOOTH = 600, 0.015


class Lap:
    """One lap of a run over the arc length of the centreline, [0, length]."""

    def __init__(self, run: DrivenRun, track: Track, number: int) -> None:
        self.run, self.length_m, self.number = run, track.length_m, number
        self.rows = run.shown(number)
        self.s_m: Floats = run.on_track.progress_m[self.rows] - number * track.length_m

    def time_at(self, s: Floats) -> Floats:
        """Time since the start line at arc lengths (n,) [s]; the lap must be a finished one."""
        time_s = self.run.record.time_s[self.rows]
        progress = CubicSpline(time_s, self.s_m)  # smooth at standstill, as its inverse is not
        time = np.interp(s, np.maximum.accumulate(self.s_m), time_s)
        for _ in range(2):  # Newton's steps from the linear interpolation, which errs by 1 ms
            step = (s - progress(time)) / np.maximum(progress(time, 1), _SLOW_MPS)
            time = np.clip(time + step, time_s[0], time_s[-1])
        return np.asarray(time - time[0])

    def behind(self, other: "Lap") -> tuple[Floats, Floats]:
        """Arc lengths (n,) from the start line on, and the time behind another finished lap [s].

        Smoothed over :data:`_SMOOTH` of the lap: feet on a bent centreline jump by millimetres.
        """
        s: Floats = np.linspace(0.0, self.length_m, _POINTS)
        window = np.ones(round(_SMOOTH * _POINTS)) / round(_SMOOTH * _POINTS)
        padded = np.pad(self.time_at(s) - other.time_at(s), len(window) // 2, mode="edge")
        return s, np.convolve(padded, window, "valid")[:_POINTS]


def first_laps(runs: Sequence[DrivenRun], track: Track) -> list[Lap]:
    """The first lap of each run, or its part that was driven."""
    return [Lap(run, track, 0) for run in runs if len(run.record.truth) > 1]


def flying_laps(runs: Sequence[DrivenRun], track: Track) -> list[Lap]:
    """The best lap after the first of each run that has one."""
    return [
        Lap(run, track, 1 + int(np.argmin(run.laps.times_s[1:])))
        for run in runs
        if len(run.laps.times_s) > 1
    ]


def reference_of(laps: Sequence[Lap]) -> Lap | None:
    """Of finished laps the one to compare with: BestCase's, or the fastest; None without any."""
    best = [lap for lap in laps if lap.run.controller == "bestcase"]
    return min(best or laps, key=lambda lap: lap.run.laps.times_s[lap.number], default=None)
