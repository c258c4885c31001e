"""The start line as a short segment: counting and timing laps without any spline."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from bayesrace.tracks.track import Track

__all__ = ["Crossing", "CrossingLine", "StartLine"]

_ON_LINE_M = 1e-9
"""A car placed on the line is past it, whatever rounding makes of its coordinates."""


class Crossing(NamedTuple):
    """Whether a step crossed the line: +1 in driving direction, -1 against it, 0 not at all."""

    direction: int
    fraction: float
    """Part of the step at which it crossed, in [0, 1]; 0 without a crossing."""


class CrossingLine:
    """A line across the way: from a point, the direction of driving and the reach to each side.

    Plant and analysis count laps with this one piece of code, or a run could end with a lap that
    does not count.
    """

    def __init__(
        self, x_m: float, y_m: float, heading_rad: float, left_m: float, right_m: float
    ) -> None:
        self._x, self._y = x_m, y_m
        self._cos, self._sin = math.cos(heading_rad), math.sin(heading_rad)
        self.left_m, self.right_m = left_m, right_m

    def signed_distance(self, x: Any, y: Any) -> Any:
        """Distance past the line along the driving direction [m], negative before it."""
        return (x - self._x) * self._cos + (y - self._y) * self._sin

    def is_past(self, x: Any, y: Any) -> Any:
        """Whether points (numbers or arrays) are past it; a step between two that agree does not
        cross it."""
        return self.signed_distance(x, y) >= -_ON_LINE_M

    def crossing(self, prev_xy: Sequence[float], cur_xy: Sequence[float]) -> Crossing:
        """Whether the straight step from ``prev_xy`` to ``cur_xy`` [m] crosses the line.

        A point on the line counts as past it, so that of two successive steps exactly one crosses.
        """
        before = self.signed_distance(prev_xy[0], prev_xy[1])
        after = self.signed_distance(cur_xy[0], cur_xy[1])
        was_past, is_past = before >= -_ON_LINE_M, after >= -_ON_LINE_M
        if was_past == is_past:
            return Crossing(0, 0.0)
        fraction = min(max(before / (before - after), 0.0), 1.0)
        x = prev_xy[0] + fraction * (cur_xy[0] - prev_xy[0]) - self._x
        y = prev_xy[1] + fraction * (cur_xy[1] - prev_xy[1]) - self._y
        lateral = y * self._cos - x * self._sin
        if not -self.right_m <= lateral <= self.left_m:
            return Crossing(0, 0.0)
        return Crossing(1 if is_past else -1, fraction)


class StartLine(CrossingLine):
    """The line across the track at s = 0, as long as the track is wide and a little beyond.

    It ends half-way to the next piece of the track, so that a car there isn't counted.
    """

    def __init__(self, track: Track) -> None:
        x, y, psi = track.start_pose()
        super().__init__(x, y, psi, 0.0, 0.0)
        self.right_m = self._reach(track, float(track.width_right_m[0]), -1.0)
        self.left_m = self._reach(track, float(track.width_left_m[0]), 1.0)

    def _reach(self, track: Track, width: float, side: float) -> float:
        """Twice the width, but not beyond the middle between this piece and the next one."""
        count = max(4 * len(track.s_m), round(track.length_m / (0.1 * max(width, 1e-3))))
        points = track.position(np.arange(count) * (track.length_m / count))
        dx, dy = points[:, 0] - self._x, points[:, 1] - self._y
        along = dx * self._cos + dy * self._sin
        across = side * (dy * self._cos - dx * self._sin)
        change = along * np.roll(along, -1) <= 0
        hits = across[change & (across > 0.5 * width)]
        nearest = float(hits.min()) if len(hits) else math.inf
        return max(width, min(2.0 * width, nearest / 2.0))
