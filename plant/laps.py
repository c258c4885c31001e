"""Counting laps where the car is: crossings of the start line, from its geometry alone."""

import math
from typing import Final

__all__ = ["LineCounter"]

_ON_THE_LINE_M: Final = 1e-9
"""A start pose on the line is past it, also when rounding puts it this much before."""


class LineCounter:
    """Counts crossings of a line: forwards plus one, backwards minus one.

    The signed distance from the line along the direction of driving goes from negative to not
    negative (or back) between two positions, at a place within the line's reach to either side.
    """

    def __init__(
        self, x_m: float, y_m: float, heading_rad: float, left_m: float, right_m: float
    ) -> None:
        self._x, self._y = x_m, y_m
        self._tx, self._ty = math.cos(heading_rad), math.sin(heading_rad)
        self._left, self._right = left_m, right_m
        self._ahead = self._offset = 0.0
        self.crossings = 0

    def restart(self, x_m: float, y_m: float) -> None:
        """Begin at a position, without a crossing so far."""
        self._ahead, self._offset = self._place(x_m, y_m)
        self.crossings = 0

    def move(self, x_m: float, y_m: float) -> int:
        """Crossings so far, after the car moved here."""
        before, offset_before = self._ahead, self._offset
        ahead, offset = self._place(x_m, y_m)
        self._ahead, self._offset = ahead, offset
        if (before >= 0.0) != (ahead >= 0.0):
            share = before / (before - ahead)
            across = offset_before + share * (offset - offset_before)
            if -self._right <= across <= self._left:
                self.crossings += 1 if ahead >= 0.0 else -1
        return self.crossings

    def _place(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Signed distance past the line, and to the left along it."""
        dx, dy = x_m - self._x, y_m - self._y
        ahead = dx * self._tx + dy * self._ty + _ON_THE_LINE_M
        return ahead, dy * self._tx - dx * self._ty
