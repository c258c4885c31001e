"""Laps and their samples, collected from messages as they arrive."""

import time
from collections import deque
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from bayesrace.columns import columns_of, with_estimates
from bayesrace.errors import InputError
from bayesrace.learning.dataset import Dataset
from bayesrace.learning.sources import CYCLES, STATES, dataset_from_columns
from bayesrace.messages import Actuation, State, Telemetry
from bayesrace.operation.learn.records import LapRecord
from bayesrace.tracks import StartLine, Track
from bayesrace.vehicles.parameters import CarParameters

__all__ = ["MOST_STATES", "Collector", "Stretch"]

MOST_STATES: Final = 10_000
"""A stretch without the end of a lap is cut here (200 s at 50 Hz), which bounds the memory."""

_PATIENCE_S: Final = 5.0
"""A stretch is given out at the latest this long after its end: its telemetry was dropped, or the
controller is gone."""
_STALL_S: Final = 0.1
"""The most by which one call of :meth:`Collector.take` advances that time: what arrives during a
stall of this host can only be read after it."""

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
    begin_s: float | None = None  # plant time when the lap began, if that was seen
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

    def __init__(self, car: CarParameters, step_s: float, track: Track | None = None) -> None:
        """``track``: times laps to less than a period, and measures excursions."""
        self._car, self._step_s, self._track = car, step_s, track
        self._line = None if track is None else StartLine(track)
        self._open = Stretch()
        self._ended: deque[Stretch] = deque()
        self._run, self._laps = (-1, -1), 0
        self._cycles: deque[Telemetry] = deque(maxlen=2 * MOST_STATES)
        """Those in which the fallback drove, or the state was estimated or not believed."""
        self._waited_s, self._looked_s = 0.0, time.monotonic()

    def state(self, state: State) -> None:
        """Adds a state of the plant."""
        if (state.epoch, state.run) != self._run:
            self._end(Stretch(begin_s=state.time_s if state.time_s == 0 else None))
            self._run, self._laps = (state.epoch, state.run), state.lap
        states = self._open.states
        if states and state.seq <= states[-1].seq:
            return
        states.append(state)
        if state.lap > self._laps:
            self._end_lap(state)
        elif len(states) >= MOST_STATES:  # the lap keeps its time, should it ever end
            self._end(Stretch(self._open.flying, self._open.begin_s, [state]))
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
        last_cycle = stretch.states[-2].seq  # that of the last state belongs to the next stretch
        return stretch.reported >= last_cycle or self._waited_s >= stretch.end_s + _PATIENCE_S

    def _end_lap(self, state: State) -> None:
        """The plant has counted a lap: this state is the first one behind the line."""
        stretch, counted = self._open, state.lap - self._laps
        self._laps = state.lap
        crossed_s, time_s = self._crossing_s(stretch.states), None
        if crossed_s is not None and stretch.begin_s is not None and counted == 1:
            time_s = crossed_s - stretch.begin_s
        stretch.lap = LapRecord(run=state.run, time_s=time_s, flying=stretch.flying)
        self._end(Stretch(flying=True, begin_s=crossed_s, states=[state]))

    def _crossing_s(self, states: list[State]) -> float | None:
        """Plant time at the line; None if the states around it are missing."""
        if len(states) < 2 or states[-1].time_s - states[-2].time_s > 0.1:
            return None
        before, after = states[-2], states[-1]
        if self._line is not None:
            crossing = self._line.crossing(before.x[:2], after.x[:2])
            if crossing.direction == 1:
                return before.time_s + crossing.fraction * (after.time_s - before.time_s)
        return after.time_s

    def _end(self, following: Stretch) -> None:
        if len(self._open.states) > 1:
            self._open.end_s = self._waited_s
            self._ended.append(self._open)
        self._open = following

    def _evaluate(self, stretch: Stretch) -> None:
        states, lap = stretch.states, stretch.lap
        run, first, last = states[0].run, states[0].seq, states[-1].seq
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
        if lap is not None:
            fallbacks = {one.state_seq for one in cycles if one.fallback and one.state_seq < last}
            lap.versions, lap.fallbacks = list(stretch.versions), len(fallbacks)
            if samples is not None:
                lap.samples, lap.left_out = len(samples), samples.dropped
            known = with_estimates(*columns)["x"]
            if self._track is not None and len(known):
                path = self._track.project_path(known[:, :2])
                lap.off_track_m = max(float(np.max(path.off_track_m)), 0.0)
