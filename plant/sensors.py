"""Plays the instruments that measure the car in one run (:mod:`bayesrace.sensors`).

The true state is known at periods, an instrument measures in between. There the pose is a cubic
polynomial with the poses and the velocities at both ends, and the velocities are its derivatives:
they have the right mean over the period, too. The steering angle turns at a constant rate.

Each instrument has random numbers of its own, so many for a measurement, whatever comes of it.
"""

import heapq
import math
from collections.abc import Sequence

import numpy as np

from bayesrace.messages import MOST_READINGS, QUANTITIES, Reading
from bayesrace.sensors import Instrument, Sensors

__all__ = ["Motion", "SensorPlayer"]

_ROUNDING_S = 1e-9
_State = Sequence[float]


class Motion:
    """The car between two true states (7,) of consecutive periods."""

    def __init__(self, before: _State, after: _State, duration_s: float) -> None:
        self._duration_s, self._delta = duration_s, (before[6], after[6])
        self._cubics = [
            (p, v0 * duration_s, v1 * duration_s, q - p)
            for p, q, v0, v1 in zip(
                before[:3], after[:3], _rates(before), _rates(after), strict=True
            )
        ]

    def at(self, share: float) -> tuple[float, ...]:
        """The state (7,) after such a share of the period."""
        pose, rates = [], []
        for p, a, b, way in self._cubics:
            second, third = 3 * way - 2 * a - b, a + b - 2 * way
            pose.append(p + share * (a + share * (second + share * third)))
            rates.append((a + share * (2 * second + share * 3 * third)) / self._duration_s)
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        vx, vy = rates[0] * cos + rates[1] * sin, rates[1] * cos - rates[0] * sin
        begin, end = self._delta
        return (*pose, vx, vy, rates[2], begin + share * (end - begin))


def _rates(x: _State) -> tuple[float, float, float]:
    """How fast x, y and the heading change in this state."""
    cos, sin = math.cos(x[2]), math.sin(x[2])
    return x[3] * cos - x[4] * sin, x[3] * sin + x[4] * cos, x[5]


class _Player:
    """One instrument; it begins to measure somewhere in its first period."""

    def __init__(self, name: str, instrument: Instrument, random: np.random.Generator) -> None:
        self._name, self._instrument, self._random = name, instrument, random
        channels = instrument.channels.items()
        self._channels = [(key, QUANTITIES.index(key), one) for key, one in channels]
        self._phase, self._count = float(random.uniform(1e-3, 1)), 0

    @property
    def next_s(self) -> float:
        """When it measures next."""
        return (self._phase + self._count) / self._instrument.rate_hz

    def measure(self, x: _State) -> tuple[float, Reading] | None:
        """A reading of the true state (7,), and when it is reported; None: it is lost."""
        time_s, one = self.next_s, self._instrument
        self._count += 1
        lost, wrong, late = self._random.random(3).tolist()
        normal = self._random.standard_normal(2 * len(self._channels)).tolist()
        in_gap = one.gap_s > 0 and time_s % one.gap_every_s >= one.gap_every_s - one.gap_s
        if in_gap or lost < one.lost:
            return None
        values = {}
        for i, (key, index, channel) in enumerate(self._channels):
            value = x[index] + channel.offset + normal[2 * i] * channel.deviation_at(x[index])
            if wrong < one.outliers:
                value += normal[2 * i + 1] * channel.outlier
            if key == "psi":
                value = math.remainder(value, 2 * math.pi)
            if channel.step > 0:
                value = round(value / channel.step) * channel.step
            values[key] = value, channel.deviation_at(value)
        reported_s = time_s + one.delay_s + (2 * late - 1) * one.jitter_s
        return reported_s, Reading(instrument=self._name, time_s=time_s, values=values)


class SensorPlayer:
    """The instruments of one run; the same seed gives each run the same errors."""

    def __init__(self, sensors: Sensors, seed: int = 0) -> None:
        self._players = [
            _Player(name, instrument, np.random.default_rng([seed, number]))
            for number, (name, instrument) in enumerate(sensors.root.items())
        ]
        self._waiting: list[tuple[float, int, Reading]] = []
        """When each is reported, which it is of all, and what."""
        self._made = 0
        self._time_s = math.inf
        self._x: _State = ()

    def report(self, time_s: float, x: _State) -> tuple[Reading, ...]:
        """What is reported with the state at a time, when ``x`` (7,) is true; at the first one
        nothing has been measured yet. What does not fit waits for the next state."""
        if time_s > self._time_s:
            self._measure(time_s, x)
        self._time_s, self._x = time_s, x
        due: list[Reading] = []
        while self._waiting and len(due) < MOST_READINGS:
            if self._waiting[0][0] > time_s + _ROUNDING_S:
                break
            due.append(heapq.heappop(self._waiting)[2])
        return tuple(due)

    def _measure(self, time_s: float, x: _State) -> None:
        """Everything that is measured from the state before up to this one."""
        begin_s, period_s = self._time_s, time_s - self._time_s
        motion = Motion(self._x, x, period_s)
        for player in self._players:
            while (at_s := player.next_s) <= time_s:
                made = player.measure(motion.at((at_s - begin_s) / period_s))
                self._made += 1
                if made is not None:
                    heapq.heappush(self._waiting, (made[0], self._made, made[1]))
