"""Laps and their samples, collected from messages as they arrive."""

import math
import time
from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.columns import Columns, columns_of, with_estimates
from bayesrace.errors import InputError
from bayesrace.learning.dataset import Dataset
from bayesrace.learning.sources import CYCLES, STATES, dataset_from_columns
from bayesrace.messages import Actuation, State, Telemetry
from bayesrace.operation.learn.records import LapRecord
from bayesrace.tracks import StartLine, Track
from bayesrace.vehicles.parameters import Car

__all__ = ["MOST_STATES", "Collector", "Stretch"]

MOST_STATES: Final = 10_000
"""A stretch without the end of a lap is cut here (200 s at 50 Hz), which bounds the memory."""

_PATIENCE_S: Final = 5.0
"""A stretch is given out at the latest this long after its end: its telemetry was dropped, or the
controller is gone."""
_STALL_S: Final = 0.1
"""The most by which one call of :meth:`Collector.take` advances that time: what arrives during a
stall of this host can only be read after it."""

_NEAR: Final = 5.0
"""So many times the way between two states may the car be off the line between which it counts:
plants count by positions of their own."""

_REMEDIES: Final = {
    "standstill": "the car stood still, or nearly; see 'bayesrace status' for why",
    "gap": "messages are lost; give the network and this machine less to do",
    "fallback": "the fallback drove, as the controller had no solution in time; give it a core of "
    "its own, a slower racing line, or weights to begin with",
    "outside limits": "inputs or steering angles are beyond the car's limits; name the car that "
    "drives: --car",
    "steering does not match its rate": "the steering angle does not follow the rate that the "
    "plant reports; correct the FMU's map, or the plant",
}
"""Remedy by the reason why samples are left out (:mod:`bayesrace.learning.sources`)."""


@dataclass(eq=False)
class Stretch:
    """What is driven up to the end of a lap, or a part of it."""

    flying: bool = False
    first: bool = False  # of its run
    states: list[State] = field(default_factory=list)
    versions: dict[str, None] = field(default_factory=dict)
    reported: int = -1  # newest state of this run in the telemetry so far
    end_s: float = 0.0  # time that the collector has waited in all, at the end of the stretch
    samples: Dataset | None = None  # None if no two states are one step apart
    lap: LapRecord | None = None  # the lap that ended with this stretch, without its number
    why_not: str = ""  # why none of it can be learned from, and the remedy


class Collector:
    """Makes stretches with their samples and laps of messages, given in the order of arrival.

    Samples are those of :func:`bayesrace.learning.sources.dataset_from_columns`: the same pairs,
    gaps, fallback cycles and filters as from a log of the same drive. A lap ends where the plant
    has counted it. A stretch is given out when the telemetry of its last cycle, or of a later one,
    has arrived.
    """

    def __init__(
        self,
        car: Car,
        step_s: float,
        track: Track | None = None,
        every_s: float | None = None,
    ) -> None:
        """``track``: times laps to less than a period, and measures excursions. ``every_s``:
        length of a stretch at most."""
        self._car, self._step_s, self._track = car, step_s, track
        self._most = min(MOST_STATES, round(every_s / step_s) + 1) if every_s else MOST_STATES
        self._line = None if track is None else StartLine(track)
        self._begin_s: float | None = None
        """Plant time when the lap began that is evaluated next, if that was seen."""
        self._open = Stretch()
        self._ended: deque[Stretch] = deque()
        self._run, self._laps = (-1, -1), 0
        self._lap = LapRecord(run=-1, time_s=None, flying=False)
        """Of all stretches since the last lap ended."""
        self._cycles: deque[Telemetry] = deque(maxlen=2 * MOST_STATES)
        """Those in which the fallback drove, or the state was estimated or not believed."""
        self._waited_s, self._looked_s = 0.0, time.monotonic()

    def state(self, state: State) -> None:
        """Adds a state of the plant."""
        if (state.epoch, state.run) != self._run:
            self._end(Stretch(first=True))
            self._run, self._laps = (state.epoch, state.run), state.lap
        states = self._open.states
        if states and state.seq <= states[-1].seq:
            return
        states.append(state)
        if state.lap > self._laps:
            self._end_lap(state)
        elif len(states) >= self._most:  # the lap keeps its time, should it ever end
            self._end(Stretch(self._open.flying, states=[state]))
        if state.final:
            self._end(Stretch())
            self._run = (-1, -1)

    def telemetry(self, message: Telemetry) -> None:
        """Adds the telemetry of a cycle, which says whether the fallback drove it."""
        for one in (*self._ended, self._open):
            if one.states and one.states[0].run == message.run:
                one.reported = max(one.reported, message.state_seq)
        if message.fallback > 0 or message.sensor_fault or message.estimate:
            self._cycles.append(message)

    def actuation(self, message: Actuation) -> None:
        """Adds the actuation of a cycle, which names the weights that drive."""
        states = self._open.states
        if states and states[0].seq <= message.state_seq and message.run == states[0].run:
            self._open.versions.setdefault(message.weights_version)

    def take(self, at_once: bool = False) -> list[Stretch]:
        """Stretches that are complete; ``at_once``: all, and the one that has no end yet."""
        now_s = time.monotonic()
        self._waited_s += min(now_s - self._looked_s, _STALL_S)
        self._looked_s = now_s
        if at_once:
            self._end(Stretch())
        done: list[Stretch] = []
        while self._ended and (at_once or self._is_complete(self._ended[0])):
            done.append(self._ended.popleft())
            self._evaluate(done[-1])
        return done

    def _is_complete(self, stretch: Stretch) -> bool:
        """Whether all telemetry of the stretch has arrived, or is waited for no longer."""
        before, last = stretch.states[-2:]  # whose cycle belongs to the next stretch, but ...
        estimated = last.estimated and not last.final  # ... says where it is
        last_cycle = last.seq if estimated else before.seq
        return stretch.reported >= last_cycle or self._waited_s >= stretch.end_s + _PATIENCE_S

    def _end_lap(self, state: State) -> None:
        """The plant has counted a lap: this state is the first one behind the line."""
        self._laps = state.lap
        self._open.lap = LapRecord(run=state.run, time_s=None, flying=self._open.flying)
        self._end(Stretch(flying=True, states=[state]))

    def _lap_time_s(self, crossed_s: float | None, counted: int) -> float | None:
        """Of the laps that were counted at that time, if it is one; None: not known."""
        begin_s, self._begin_s = self._begin_s, crossed_s
        if begin_s is None or crossed_s is None or counted != 1:
            return None
        return crossed_s - begin_s

    def _crossing_s(self, around: Columns, cycles: Columns) -> float | None:
        """Plant time at the line, which was counted between these two states; None if others are
        missing there."""
        before_s, after_s = map(float, around["time_s"])
        if after_s - before_s > 0.1:
            return None
        known = with_estimates(around, cycles)
        if self._line is None or not len(known) or known["seq"][0] != around["seq"][0]:
            return after_s
        x = known["x"]  # nothing is estimated of a run's last state
        after = x[1] if len(x) > 1 else _moved(x[0], after_s - before_s)
        before_m, after_m = (float(self._line.signed_distance(*at[:2])) for at in (x[0], after))
        if after_m <= before_m or max(abs(before_m), abs(after_m)) > _NEAR * (after_m - before_m):
            return after_s
        return before_s - before_m / (after_m - before_m) * (after_s - before_s)

    def _end(self, following: Stretch) -> None:
        if len(self._open.states) > 1:
            self._open.end_s = self._waited_s
            self._ended.append(self._open)
        self._open = following

    def _evaluate(self, stretch: Stretch) -> None:
        states, lap = stretch.states, stretch.lap
        run, first = states[0].run, states[0].seq
        if stretch.first:
            self._begin_s = 0.0 if states[0].time_s == 0 else None
            self._lap = LapRecord(run=run, time_s=None, flying=False)
        cycles = [one for one in self._cycles if one.run == run and one.state_seq >= first]
        columns = columns_of(State, states, STATES), columns_of(Telemetry, cycles, CYCLES)
        samples, why_not = None, ""
        try:
            samples = dataset_from_columns(*columns, self._car, self._step_s)
            if not len(samples):
                reason = max(samples.dropped, key=lambda one: samples.dropped[one])
                why_not = _REMEDIES.get(reason, f"the samples are left out: {reason}")
        except InputError as error:
            why_not = str(error)
        stretch.samples = samples
        # A short stretch that is no lap, such as the end of a run, may well be of no use.
        stretch.why_not = why_not if lap is not None or len(states) >= 50 else ""
        self._count(stretch, columns)
        if lap is not None:
            crossed_s = self._crossing_s(columns[0][-2:], columns[1])
            time_s = self._lap_time_s(crossed_s, states[-1].lap - states[0].lap)
            known = {"run": run, "time_s": time_s, "flying": lap.flying}
            stretch.lap = self._lap.model_copy(update=known)
            self._lap = LapRecord(run=run, time_s=None, flying=True)

    def _count(self, stretch: Stretch, columns: tuple[Columns, Columns]) -> None:
        """Adds what a stretch says of its lap."""
        lap, samples, last = self._lap, stretch.samples, stretch.states[-1].seq
        lap.versions = [*dict.fromkeys([*lap.versions, *stretch.versions])]
        cycles = columns[1]
        driven = cycles["state_seq"][(cycles["fallback"] > 0) & (cycles["state_seq"] < last)]
        lap.fallbacks += len({*driven})
        if samples is not None:
            lap.samples += len(samples)
            lap.left_out = Counter(lap.left_out) + Counter(samples.dropped)
        known = with_estimates(*columns)["x"]
        if self._track is not None and len(known):
            off_m = float(np.max(self._track.project_path(known[:, :2]).off_track_m))
            lap.off_track_m = max(off_m, lap.off_track_m or 0.0)


def _moved(x: Floats, duration_s: float) -> Floats:
    """The position (2,) of a state (7,) after so short a time."""
    cos, sin = math.cos(x[2]), math.sin(x[2])
    moved: Floats = x[:2] + duration_s * (np.array([[cos, -sin], [sin, cos]]) @ x[3:5])
    return moved
