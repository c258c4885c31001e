"""Drives whose states are not measured but estimated: what was read in them, in order of time, and
which samples are of them."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bayesrace.arrays import Flags, Floats, Rows
from bayesrace.messages import QUANTITIES, Reading

__all__ = ["POSE", "Drive", "Estimates", "Event", "Measured"]

POSE: Final = (0, 1, 2)
"""Numbers of the states that are position and heading."""
_SAME_S: Final = 1e-9
_LEAST: Final = 10
"""Readings that a drive needs."""
_FASTEST_MPS: Final = 20.0
"""Two poses in a row that are further apart do not agree."""


@dataclass(frozen=True, eq=False)
class Drive:
    """One unbroken run: times of its states (n,), the input (n, 2) that acted in the period before
    each, and all that was read. ``steering_rad``: angle at the first state, as it was believed."""

    time_s: Floats
    u: Floats
    readings: tuple[Reading, ...]
    steering_rad: float = 0.0
    steering_deviation_rad: float = 0.0
    path: Floats | None = None
    """At each event, as smoothed last."""
    refused: Flags | None = None
    """Events whose reading is known to be wrong."""

    def turned_rad(self, time_s: float) -> float:
        """What the steering has turned since the first state, as it was commanded; what it still
        had to turn until then, negative, if the time is in the period before."""
        passed = np.clip(time_s - self.time_s[:-1], 0, np.diff(self.time_s))
        ahead_s = min(time_s - self.time_s[0], 0.0)
        return float(passed @ self.u[1:, 1] + ahead_s * self.u[0, 1])

    @cached_property
    def events(self) -> "list[Event]":
        """Ends of periods and readings in order of time, from the first pose on; empty: nothing can
        be made of them."""
        read = sorted((Measured.of(one) for one in self.readings), key=lambda one: one.time_s)
        first, last_s = _first_pose(read), self.time_s[-1] + _SAME_S
        if first is None:
            return []
        begin = read[first]
        inside = [one for one in read[first + 1 :] if one.time_s <= last_s]
        if len(inside) < _LEAST:
            return []
        ends = [(float(t), k) for k, t in enumerate(self.time_s) if t > begin.time_s - _SAME_S]
        every: list[tuple[float, int, Measured | None]] = [
            (one.time_s, int(np.searchsorted(self.time_s, one.time_s - _SAME_S)), one)
            for one in inside
        ]
        every += [(t, k, None) for t, k in ends]
        every.sort(key=lambda one: (one[0], one[2] is None))
        events, time_s = [Event(0.0, -1, np.zeros(2), begin)], begin.time_s
        for at_s, k, one in every:
            u = self.u[min(k, len(self.u) - 1)]
            events.append(Event(max(at_s - time_s, 0.0), k if one is None else -1, u, one))
            time_s = max(at_s, time_s)
        if self.refused is None:
            return events
        wrong = zip(events, self.refused, strict=True)
        return [one.without() if known else one for one, known in wrong]


class Measured(NamedTuple):
    """A reading as numbers: the states that it is of, in their order."""

    time_s: float
    states: tuple[int, ...]
    value: Floats
    variance: Floats
    instrument: str

    @classmethod
    def of(cls, reading: Reading) -> "Measured":
        """Of a message."""
        names = sorted(reading.values, key=QUANTITIES.index)
        values = np.array([reading.values[name] for name in names], dtype=np.float64)
        rows = tuple(QUANTITIES.index(name) for name in names)
        return cls(reading.time_s, rows, values[:, 0], values[:, 1] ** 2, reading.instrument)


class Event(NamedTuple):
    """The end of a period, or a reading."""

    duration_s: float  # since the event before
    period: int  # number of the state whose time it is; -1: none
    u: Floats  # acted since the event before
    measured: Measured | None

    def without(self) -> "Event":
        """The same without its reading."""
        return self._replace(measured=None)


def _first_pose(read: Sequence[Measured]) -> int | None:
    """The first of two poses in a row that agree: none of them is an outlier then."""
    poses = [k for k, one in enumerate(read) if one.states[:3] == POSE]
    for before, after in pairwise(poses):
        one, other = read[before], read[after]
        most_m = _FASTEST_MPS * (other.time_s - one.time_s) + 6 * np.sqrt(one.variance[:2].max())
        turned = np.remainder(other.value[2] - one.value[2] + np.pi, 2 * np.pi) - np.pi
        if np.abs(other.value[:2] - one.value[:2]).max() < most_m and abs(turned) < 1:
            return before
    return None


@dataclass(frozen=True, eq=False)
class Estimates:
    """Of samples whose states are estimated, row by row.

    ``deviation`` (n, 4): standard deviations of the residuals of vx, vy, omega, and of the steering
    angle; 0 where a state was measured. ``origin`` (n, 2): the number of the sample's drive in
    ``drives``, and that of its state there; -1 where the drive is not at hand.
    """

    deviation: Floats
    origin: NDArray[np.int64]
    drives: tuple[Drive, ...] = ()

    @classmethod
    def settled(cls, deviation: Floats) -> "Estimates":
        """Without drives."""
        return cls(deviation, np.full((len(deviation), 2), -1))

    @classmethod
    def exact(cls, count: int) -> "Estimates":
        """Of measured states."""
        return cls.settled(np.zeros((count, 4)))

    def select(self, rows: slice | Rows) -> "Estimates":
        """Those of the given rows, with the drives that they are of."""
        origin = self.origin[rows].copy()
        used, number = np.unique(origin[:, 0], return_inverse=True)
        known = used >= 0
        origin[:, 0] = np.where(known, np.cumsum(known) - 1, -1)[number]
        drives = tuple(self.drives[k] for k in used[known])
        return Estimates(self.deviation[rows], origin, drives)

    @classmethod
    def joined(cls, parts: "Sequence[Estimates]") -> "Estimates":
        """One after the other."""
        origins, drives = [], list[Drive]()
        for part in parts:
            origin = part.origin.copy()
            origin[origin[:, 0] >= 0, 0] += len(drives)
            origins.append(origin)
            drives += part.drives
        deviation = np.concatenate([part.deviation for part in parts])
        return cls(deviation, np.concatenate(origins), tuple(drives))
