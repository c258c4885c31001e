"""Where a car is on its track, and its lap times, state by state."""

import math
from bisect import bisect_right
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from bayesrace.api.values import State
from bayesrace.arrays import Floats
from bayesrace.plant.car import LineCounter
from bayesrace.tracks import StartLine, Track

__all__ = ["Centreline", "LapTimer", "Place", "curvature_table"]

_NEWTON_STEPS: Final = 10
_TABLE_STEP: Final = 1 / 64
"""Of the narrowest width: spacing of the table of curvatures."""


class Place(NamedTuple):
    """Where a car is on the track."""

    s_m: float
    n_m: float
    """Offset from the centreline, positive to the left."""
    heading_rad: float
    """Of the centreline."""
    right_m: float
    """Width of the track to this side."""
    left_m: float

    @property
    def off_track_m(self) -> float:
        """Distance outside the track; <= 0 inside."""
        return max(self.n_m - self.left_m, -self.n_m - self.right_m)


class Centreline:
    """Finds where a car is, step after step, as :meth:`Track.project_path` does.

    That takes 0.2 ms for a single point, twenty times as long as the car's equations, because its
    arrays are made for trajectories. Near the centreline, Newton's method on plain numbers finds
    the same place from the one before; elsewhere the track is asked.
    """

    def __init__(self, track: Track) -> None:
        curve = track.centreline
        self._track, self._length_m = track, track.length_m
        self._knots: list[float] = curve.knots.tolist()
        step = np.diff(np.append(curve.knots, curve.period))[:, None]
        point, first, second = curve.derivatives(curve.knots)
        third = (np.roll(second, -1, axis=0) - second) / step
        widths = np.column_stack([track.width_right_m, track.width_left_m])
        growth = (np.roll(widths, -1, axis=0) - widths) / step
        pieces = np.column_stack([point, first, second / 2, third / 6, widths, growth])
        self._pieces: list[tuple[float, ...]] = [tuple(one) for one in pieces.tolist()]
        self._near_m2 = min(track.one_foot_m, float(np.max(widths.sum(axis=1)))) ** 2

    def locate(self, x: float, y: float, before: Place | None = None) -> Place:
        """Place of a car at x, y [m]; before: its place a step ago, None: it may be anywhere."""
        s_m = None if before is None else self._follow(x, y, before.s_m)
        if s_m is None:
            guess_m = None if before is None else before.s_m
            s_m = float(self._track.project_path([[x, y]], guess_m).s_m[0])
        cx, cy, tx, ty, _, _, right_m, left_m = self._at(s_m)
        n_m = ((y - cy) * tx - (x - cx) * ty) / math.hypot(tx, ty)
        return Place(s_m, n_m, math.atan2(ty, tx), right_m, left_m)

    def _follow(self, x: float, y: float, s_m: float) -> float | None:
        """Arc length of the nearest point, sought from one near by; None: not found for sure."""
        for _ in range(_NEWTON_STEPS):
            cx, cy, tx, ty, ax, ay, _, _ = self._at(s_m)
            dx, dy = cx - x, cy - y
            away_m2 = dx * dx + dy * dy
            bend = tx * tx + ty * ty + dx * ax + dy * ay
            if not (away_m2 < self._near_m2 and bend > 0):
                return None
            change_m = (dx * tx + dy * ty) / bend
            s_m = (s_m - change_m) % self._length_m
            if abs(change_m) < 1e-12 * self._length_m:
                return s_m if s_m < self._length_m else 0.0
        return None

    def _at(self, s_m: float) -> tuple[float, ...]:
        """Point, first and second derivative of the centreline; width to the right, to the left."""
        i = bisect_right(self._knots, s_m) - 1
        t = s_m - self._knots[i]
        x, y, x1, y1, x2, y2, x3, y3, right, left, right1, left1 = self._pieces[i]
        return (
            x + t * (x1 + t * (x2 + t * x3)), y + t * (y1 + t * (y2 + t * y3)),
            x1 + t * (2 * x2 + t * 3 * x3), y1 + t * (2 * y2 + t * 3 * y3),
            2 * x2 + 6 * t * x3, 2 * y2 + 6 * t * y3,
            right + t * right1, left + t * left1,
        )  # fmt: skip


def curvature_table(track: Track, ahead_m: float) -> tuple[Floats, Floats]:
    """Arc lengths from 0 to beyond the track's length by so much, and curvatures there."""
    width_m = float(np.min(track.width_right_m + track.width_left_m))
    count = max(math.ceil(track.length_m / (_TABLE_STEP * width_m)), 4 * len(track.s_m))
    step_m = track.length_m / count
    s_m: Floats = step_m * np.arange(count + math.ceil(ahead_m / step_m) + 2, dtype=np.float64)
    return s_m, track.curvature(s_m)


class LapTimer:
    """Times laps step by step, by the rule of :func:`.time_laps`."""

    def __init__(self, track: Track) -> None:
        line = StartLine(track)
        self._line = LineCounter(*track.start_pose(), line.left_m, line.right_m)

    def begin(self, state: State) -> None:
        """At time zero."""
        self._line.restart(state.x, state.y)
        self._ends_s = [0.0]
        self.times_s: tuple[float, ...] = ()
        """Of the laps."""

    def move(self, state: State, time_s: float, step_s: float) -> None:
        """To the state at this time, a step after the one before."""
        if self._line.move(state.x, state.y) > len(self.times_s):
            before_s = time_s - step_s
            self._ends_s.append(before_s + self._line.newest.fraction * (time_s - before_s))
            self.times_s = tuple(end - begin for begin, end in pairwise(self._ends_s))
