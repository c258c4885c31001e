"""Laps and their samples, out of messages as they arrive."""

import time
from collections import deque
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from bayesrace.errors import InputError
from bayesrace.messages import Actuation, State, Telemetry
from bayesrace.tracks import StartLine, Track
from bayesrace.vehicles.parameters import CarParameters
from experiments.learn.usable import why_unusable
from learning.dataset import Dataset
from learning.logs import dataset_from_messages

__all__ = ["MOST_STATES", "Collector", "Driven", "Lap"]

MOST_STATES: Final = 10_000
"""A stretch without a lap's end is cut here (200 s at 50 Hz): memory must not follow a car that
stands."""

_PATIENCE_S: Final = 0.5
"""How long the telemetry of a lap's last cycle is waited for: it is sent after the actuation."""

_FAR_S: Final = 0.1
"""Two states further apart leave it open when the line between them was crossed."""


_WORTH_A_WORD: Final = 50
"""A stretch without a lap's end says why it is of no use from so many states on: less remains
between the last lap and the end of a run."""


@dataclass(frozen=True)
class Lap:
    """One lap as it was driven."""

    run: int
    time_s: float | None
    """None if its beginning or its end was not seen."""
    flying: bool
    """It began at speed, where the lap before ended."""
    versions: tuple[str, ...]
    """Of the weights that drove, in order."""
    fallbacks: int
    """Cycles that the fallback drove."""
    off_track_m: float | None
    """How far outside of the track the car got; 0 inside; None without a track."""


@dataclass(frozen=True, eq=False)
class Driven:
    """Samples of a stretch, and the lap that it was, if it was a whole one or the last of one."""

    samples: Dataset | None
    lap: Lap | None
    why_not: str = ""
    """Why none of it can be learned from, and what to do about it; empty if some of it can, or if
    it is too short to say."""


@dataclass(eq=False)
class _Stretch:
    """What has arrived since the last lap's end."""

    flying: bool = False
    begin_s: float | None = None
    """Plant time when the lap began; None if that was not seen."""
    states: list[State] = field(default_factory=list)
    versions: dict[str, None] = field(default_factory=dict)
    lap_time_s: float | None = None
    is_lap: bool = False
    closed_s: float = 0.0
    """Monotonic clock."""


class Collector:
    """Takes messages in the order of arrival; :meth:`take` gives what is complete.

    Samples are those of :func:`learning.logs.dataset_from_messages`: the same pairs, gaps, fallback
    cycles and filters as from a log of the same drive. A lap ends where the plant has counted it.
    """

    def __init__(self, car: CarParameters, step_s: float, track: Track | None = None) -> None:
        """``track``: for laps timed to less than a period, and for excursions."""
        self._car, self._step_s, self._track = car, step_s, track
        self._line = None if track is None else StartLine(track)
        self._open = _Stretch()
        self._closed: deque[_Stretch] = deque()
        self._run = (-1, -1)
        self._laps = 0
        self._seen = (-1, -1)
        """Run and number of the last state that telemetry is there for."""
        self._fallbacks: dict[tuple[int, int], None] = {}
        """Run and number of the states that the fallback has answered, in order."""

    def state(self, state: State) -> None:
        """A state of the plant."""
        run = (state.epoch, state.run)
        if run != self._run:
            self._close()
            self._run, self._laps = run, state.lap
            self._open.begin_s = state.time_s if state.time_s == 0 else None
        states = self._open.states
        if states and state.seq <= states[-1].seq:
            return
        states.append(state)
        if state.lap > self._laps:
            self._cross(state)
        elif len(states) >= MOST_STATES:
            self._cut(state)
        if state.final:
            self._close()
            self._run = (-1, -1)

    def telemetry(self, message: Telemetry) -> None:
        """Of any cycle."""
        self._seen = (message.run, message.state_seq)
        if message.fallback > 0:
            if len(self._fallbacks) >= 2 * MOST_STATES:
                del self._fallbacks[next(iter(self._fallbacks))]
            self._fallbacks[message.run, message.state_seq] = None

    def actuation(self, message: Actuation) -> None:
        """Of any cycle: it names the weights that drive."""
        states = self._open.states
        if states and states[0].seq <= message.state_seq and message.run == states[0].run:
            self._open.versions.setdefault(message.weights_version)

    def take(self, at_once: bool = False) -> list[Driven]:
        """Stretches that have ended, their telemetry at hand or waited for long enough."""
        done = []
        while self._closed and (at_once or self._complete(self._closed[0])):
            done.append(self._driven(self._closed.popleft()))
        return done

    def end(self) -> list[Driven]:
        """All there is, what has no end included."""
        self._close()
        return self.take(at_once=True)

    def _cross(self, state: State) -> None:
        """The plant has counted a lap: this state is the first behind the line."""
        stretch, counted = self._open, state.lap - self._laps
        self._laps = state.lap
        crossed_s = self._crossing_s(stretch.states)
        stretch.is_lap = True
        if crossed_s is not None and stretch.begin_s is not None and counted == 1:
            stretch.lap_time_s = crossed_s - stretch.begin_s
        self._close()
        self._open = _Stretch(flying=True, begin_s=crossed_s, states=[state])

    def _crossing_s(self, states: list[State]) -> float | None:
        """When the line was crossed; None if the states around it are missing."""
        if len(states) < 2 or states[-1].time_s - states[-2].time_s > _FAR_S:
            return None
        before, after = states[-2], states[-1]
        fraction = 1.0
        if self._line is not None:
            crossing = self._line.crossing(before.x[:2], after.x[:2])  # type: ignore[arg-type]
            fraction = crossing.fraction if crossing.direction == 1 else 1.0
        return before.time_s + fraction * (after.time_s - before.time_s)

    def _cut(self, state: State) -> None:
        """A stretch has become too long to keep; its lap, if it ever ends, keeps its time."""
        begin_s, flying = self._open.begin_s, self._open.flying
        self._close()
        self._open = _Stretch(flying=flying, begin_s=begin_s, states=[state])

    def _close(self) -> None:
        if len(self._open.states) > 1:
            self._open.closed_s = time.monotonic()
            self._closed.append(self._open)
        self._open = _Stretch()

    def _complete(self, stretch: _Stretch) -> bool:
        last = stretch.states[-1]
        # The last state's own cycle belongs to the next stretch, or there is none.
        if self._seen[0] == last.run and self._seen[1] >= last.seq - 1:
            return True
        return time.monotonic() - stretch.closed_s > _PATIENCE_S

    def _driven(self, stretch: _Stretch) -> Driven:
        first, last = stretch.states[0], stretch.states[-1]
        fallbacks = [
            key for key in self._fallbacks if key[0] == first.run and first.seq <= key[1] < last.seq
        ]
        for key in fallbacks:
            del self._fallbacks[key]
        try:
            samples = dataset_from_messages(stretch.states, fallbacks, self._car, self._step_s)
        except InputError:  # no two states that are a step apart
            samples = None
        lap = self._lap(stretch, len(fallbacks)) if stretch.is_lap else None
        told = lap is not None or len(stretch.states) >= _WORTH_A_WORD
        why_not = why_unusable(stretch.states, samples, self._car, self._step_s) if told else ""
        return Driven(samples, lap, why_not)

    def _lap(self, stretch: _Stretch, fallbacks: int) -> Lap:
        off_m = None
        if self._track is not None:
            xy = np.array([state.x[:2] for state in stretch.states])
            off_m = max(float(np.max(self._track.project_path(xy).off_track_m)), 0.0)
        return Lap(
            stretch.states[0].run,
            stretch.lap_time_s,
            stretch.flying,
            tuple(stretch.versions),
            fallbacks,
            off_m,
        )
