"""Counting laps where the car is: crossings of the start line, from its geometry alone."""

from bayesrace.tracks.startline import CrossingLine

__all__ = ["LineCounter"]


class LineCounter:
    """Counts crossings of a line: forwards plus one, backwards minus one."""

    def __init__(
        self, x_m: float, y_m: float, heading_rad: float, left_m: float, right_m: float
    ) -> None:
        self._line = CrossingLine(x_m, y_m, heading_rad, left_m, right_m)
        self.restart(x_m, y_m)

    def restart(self, x_m: float, y_m: float) -> None:
        """Begin at a position, without a crossing so far."""
        self._at, self._past = (x_m, y_m), self._line.is_past(x_m, y_m)
        self.crossings = 0

    def move(self, x_m: float, y_m: float) -> int:
        """Crossings so far, after the car moved here."""
        before, was_past = self._at, self._past
        self._at, self._past = (x_m, y_m), self._line.is_past(x_m, y_m)
        if self._past != was_past:
            self.crossings += self._line.crossing(before, self._at).direction
        return self.crossings
