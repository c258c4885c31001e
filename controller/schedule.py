"""Release times of a fixed-rate loop, locked in phase to the arrival of the states.

A loop that runs free of its plant takes states that are up to a period old. This one keeps its
rate, and moves its phase slowly until the states arrive at its releases: a first-order phase lock
whose step is limited, so that a message held up on its way hardly moves it.
"""

from typing import Final

__all__ = ["Schedule"]

_GAIN: Final = 0.1
_SLEW: Final = 0.005
"""Largest correction of a release, as a fraction of the period."""
_LOST: Final = 0.25
"""Phase error, as a fraction of the period, beyond which the lock is taken anew ..."""
_LOST_FOR: Final = 5
"""... if it stays there for so many states in a row."""
_WHOLE: Final = 0.02
"""How far the ratio of the two periods may be from a whole number for a lock to be possible."""


class Schedule:
    """Releases at a fixed rate on the monotonic clock [ns]."""

    def __init__(self, rate_hz: float) -> None:
        self.period_ns = round(1e9 / rate_hz)
        self.release_ns = 0
        """The next release; its deadline is the release after it."""
        self._lost = 0

    @property
    def deadline_ns(self) -> int:
        """By when the work released next must be done."""
        return self.release_ns + self.period_ns

    def start(self, release_ns: int) -> None:
        """Begin with a release at this time."""
        self.release_ns = release_ns
        self._lost = 0

    def advance(self, now_ns: int) -> int:
        """Go on to the next release whose deadline has not passed; how many were skipped."""
        self.release_ns += self.period_ns
        late_ns = now_ns - self.deadline_ns
        skipped = late_ns // self.period_ns + 1 if late_ns >= 0 else 0
        self.release_ns += skipped * self.period_ns
        return skipped

    def observe(self, arrival_ns: int, interval_ns: float) -> None:
        """A state has arrived; they are ``interval_ns`` apart (0: not known).

        Moves the releases only if one period is a whole multiple of the other: else there is no
        phase to keep.
        """
        if not self._lockable(interval_ns):
            return
        grid_ns = min(self.period_ns, interval_ns)
        error_ns = (arrival_ns - self.release_ns + grid_ns / 2) % grid_ns - grid_ns / 2
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

    def _lockable(self, interval_ns: float) -> bool:
        if interval_ns <= 0:
            return False
        ratio = max(interval_ns, self.period_ns) / min(interval_ns, self.period_ns)
        return abs(ratio - round(ratio)) <= _WHOLE
