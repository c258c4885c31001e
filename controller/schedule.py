"""Release times of a fixed-rate loop, locked in phase to the arrival of the states.

A loop that runs free of its plant takes states that are up to a period old. This one keeps its
rate, and moves its phase slowly until its releases meet the earliest arrivals. Earliest, because
whatever holds up a message makes it later and never sooner: the smallest difference between arrival
and the plant's own time, over the last second, is the one to trust (as in NTP's clock filter).
"""

import math
from collections import deque
from typing import Final

__all__ = ["Schedule"]

_WINDOW_NS: Final = 1_000_000_000
_GAIN: Final = 0.1
_SLEW: Final = 0.005
"""Largest correction of a release, as a fraction of the period."""
_LOST: Final = 0.25
"""Phase error, as a fraction of the period, beyond which the lock is taken anew ..."""
_LOST_FOR: Final = 5
"""... if it stays there for so many states in a row."""
_GRACE: Final = 0.25
"""How long after a release the loop still waits for the state that is due (fraction of the
period)."""
_WHOLE: Final = 0.02
"""How far the ratio of the two periods may be from a whole number for a lock to be possible."""


class _Smallest:
    """Minimum over a sliding window of time, in constant time per value."""

    def __init__(self, window_ns: int) -> None:
        self._window_ns = window_ns
        self._rising: deque[tuple[int, int]] = deque()

    def clear(self) -> None:
        self._rising.clear()

    def add(self, at_ns: int, value: int) -> int:
        """The minimum with the new value."""
        rising = self._rising
        while rising and rising[-1][1] >= value:
            rising.pop()
        rising.append((at_ns, value))
        while rising[0][0] < at_ns - self._window_ns:
            rising.popleft()
        return rising[0][1]


class Schedule:
    """Releases at a fixed rate on the monotonic clock [ns]."""

    def __init__(self, rate_hz: float) -> None:
        self.period_ns = round(1e9 / rate_hz)
        self.release_ns = 0
        """The next release; its deadline is the release after it."""
        self._lost = 0
        self._offset_ns = 0
        self._offset = _Smallest(_WINDOW_NS)

    @property
    def deadline_ns(self) -> int:
        """By when the work released next must be done."""
        return self.release_ns + self.period_ns

    @property
    def window_end_ns(self) -> int:
        """Until when the loop waits for the state that is due at the release."""
        return self.release_ns + round(_GRACE * self.period_ns)

    def start(self, release_ns: int) -> None:
        """Begin with a release at this time."""
        self.release_ns = release_ns
        self._lost = 0
        self._offset.clear()

    def advance(self, now_ns: int) -> int:
        """Go on to the next release whose deadline has not passed; how many were skipped."""
        self.release_ns += self.period_ns
        late_ns = now_ns - self.deadline_ns
        skipped = late_ns // self.period_ns + 1 if late_ns >= 0 else 0
        self.release_ns += skipped * self.period_ns
        return skipped

    def observe(self, arrival_ns: int, time_s: float, interval_s: float) -> None:
        """The state of plant time ``time_s`` has arrived; two are ``interval_s`` apart (0: not
        known).

        Moves the releases only if one period is a whole multiple of the other: else there is no
        phase to keep.
        """
        interval_ns = interval_s * 1e9
        time_ns = round(time_s * 1e9)
        self._offset_ns = self._offset.add(arrival_ns, arrival_ns - time_ns)
        if not self._lockable(interval_ns):
            return
        earliest_ns = self._offset_ns + time_ns
        grid_ns = min(self.period_ns, interval_ns)
        error_ns = (earliest_ns - self.release_ns + grid_ns / 2) % grid_ns - grid_ns / 2
        if abs(error_ns) > _LOST * grid_ns:
            self._lost += 1
            if self._lost >= _LOST_FOR:
                self.release_ns += round(error_ns)
                self._lost = 0
                return
        else:
            self._lost = 0
        limit_ns = _SLEW * grid_ns
        self.release_ns += round(min(max(_GAIN * error_ns, -limit_ns), limit_ns))

    def plant_time_s(self, at_ns: int) -> float:
        """Plant time whose state would have arrived by then, had nothing held it up."""
        return (at_ns - self._offset_ns) * 1e-9

    def missing(self, time_s: float, interval_s: float) -> int:
        """How many states newer than that of plant time ``time_s`` are due by the release; two are
        ``interval_s`` apart (0: not known). 0, too, if none is due at the release itself."""
        period_s = self.period_ns * 1e-9
        interval_s = interval_s or period_s
        since_s = self.plant_time_s(self.release_ns) - time_s
        # States may come less often than releases: not every release has one.
        if abs(math.remainder(since_s, interval_s)) >= period_s / 2:
            return 0
        return max(int((since_s + _GRACE * period_s) / max(interval_s, period_s)), 0)

    def _lockable(self, interval_ns: float) -> bool:
        if interval_ns <= 0:
            return False
        ratio = max(interval_ns, self.period_ns) / min(interval_ns, self.period_ns)
        return abs(ratio - round(ratio)) <= _WHOLE
