"""Listens to one car without getting in the way: two cores have to do.

Messages collect in Zenoh's own bounded channels, without a line of Python at their arrival, and are
taken out and decoded some times a second. No time is taken here: all times are in the messages, so
this process may be late as long as it keeps up. It gives itself low priority for that.
"""

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from bayesrace.errors import InputError
from bayesrace.messages import (
    ACTUATION,
    CLOCK,
    STATE,
    TELEMETRY,
    TRUTH,
    ClockRequest,
)
from bayesrace.tracks import Track
from bayesrace.transport import Inbox, ask
from experiments.latency.clocks import ClockPair, Exchange, OffsetEstimator
from experiments.latency.course import Course
from experiments.latency.histograms import LegHistogram
from experiments.latency.legs import LEGS, Cycles

__all__ = ["ClockProbe", "Observer", "lower_priority"]

_CAPACITY: Final = 20_000
"""Messages of a topic that wait at most: 40 s at 500 Hz; of more, the oldest go."""

_JUDGED_AFTER_S: Final = 3.0
"""A cycle's answers are in by then, and so are the clocks' readings after it."""

_NICE: Final = 10

_INTERVALS: Final = 60
_SHORTEST_S: Final = 2.0
"""Intervals of the histograms in a measurement; ending one takes some 50 ms."""


def lower_priority() -> None:
    """Lets this process's threads step back; call it when everything is started.

    Processes started from here on would step back with it.
    """
    if not Path("/proc/self/task").is_dir():
        os.nice(_NICE)
        return
    for thread in Path("/proc/self/task").iterdir():
        os.setpriority(os.PRIO_PROCESS, int(thread.name), _NICE)


class ClockProbe:
    """Exchanges timestamps with plant and controller."""

    def __init__(self, session: Any, car: str) -> None:
        self._session, self._car = session, car
        self.pair = ClockPair()
        self._seq = 0

    def exchange(self, rounds: int = 1) -> None:
        """Asks both, ``rounds`` times; no answer is counted, not raised."""
        for _ in range(rounds):
            for source, estimator in self._estimators():
                self._ask(source, estimator)

    def settle(self) -> None:
        """What has been exchanged counts from now on."""
        for _, estimator in self._estimators():
            estimator.flush()

    def begin(self) -> None:
        """First exchanges, and from them whether it is one clock; InputError without an answer."""
        self.exchange(20)
        self.settle()
        for source, estimator in self._estimators():
            if not estimator.known:
                raise InputError(
                    f"the {source} of car '{self._car}' does not tell its clock; "
                    "is it of the same release, and its endpoint among those given?"
                )
        self.pair.decide()

    def _estimators(self) -> tuple[tuple[str, OffsetEstimator], ...]:
        return ("plant", self.pair.plant), ("controller", self.pair.controller)

    def _ask(self, source: str, estimator: OffsetEstimator) -> None:
        sent = time.monotonic_ns()
        self._seq += 1
        try:
            answer = ask(self._session, CLOCK, self._car, ClockRequest(self._seq, sent), source)
        except InputError:
            estimator.failed += 1
            return
        estimator.add(Exchange(sent, answer.source_time_ns, time.monotonic_ns()))
        self.pair.hosts[source] = answer.host


class Observer:
    """Subscribes to a car's messages and makes the legs' histograms of them."""

    def __init__(
        self,
        session: Any,
        car: str,
        rate_hz: float,
        clocks: ClockPair,
        duration_s: float,
        track: Track | None,
        out: Path,
    ) -> None:
        """``out``: folder for the histogram logs, one a leg."""
        self.course = Course(track)
        self.cycles = Cycles(
            self._record, clocks.to_plant, round(_JUDGED_AFTER_S * rate_hz), self._sampled
        )
        self.refused = 0
        self.lockstep = 0
        """States of a lockstep run: nothing to measure."""
        self._out = out
        self._counting = False
        self._first_ns: int | None = None
        self._interval_s = max(duration_s / _INTERVALS, _SHORTEST_S)
        self._whole = max(int(duration_s / self._interval_s), 1)
        self._rolled = 0
        self._elapsed_s = 0.0
        """Of the cycles judged so far, on the plant's clock."""
        self.histograms: dict[str, LegHistogram] = {}
        self._inbox = Inbox(session, car)
        self._take: dict[str, Callable[[Any], None]] = {
            STATE.name: self._state,
            TRUTH.name: self.course.truth,
            ACTUATION.name: self.cycles.actuation,
            TELEMETRY.name: self.cycles.telemetry,
        }
        self._decoders = [
            self._inbox.subscribe(topic, newest=_CAPACITY)
            for topic in (STATE, TRUTH, ACTUATION, TELEMETRY)
        ]

    def begin(self) -> None:
        """Counts from now on; before, only the car's way was followed."""
        self.drain()
        self.cycles.reset()
        epoch_s = time.time()
        for leg in LEGS:
            path = self._out / f"{leg.name}.hlog"
            self.histograms[leg.name] = LegHistogram(path, leg.title, epoch_s)
        self._first_ns = None
        self._counting = True

    def drain(self) -> None:
        """Takes in what has arrived."""
        while (item := self._inbox.get()) is not None:
            if item.value is not None:
                self._take[item.name](item.value)
        self.cycles.settle()

    def finish(self) -> None:
        """Takes in what is left and closes the logs."""
        self.drain()
        self.cycles.finish()
        self._counting = False
        for histogram in self.histograms.values():
            histogram.roll(self._elapsed_s)
            histogram.close()

    @property
    def refused_messages(self) -> int:
        """What could not be decoded."""
        return sum(decoder.refused for decoder in self._decoders)

    def _state(self, message: Any) -> None:
        if message.lockstep:
            self.lockstep += 1
            return
        self.cycles.state(message)

    def _sampled(self, at_ns: int) -> None:
        """A cycle is judged: ends the histograms' interval if it lies beyond.

        The last interval takes what is left: a piece of one would say little.
        """
        if not self._counting:
            return
        if self._first_ns is None or at_ns < self._first_ns:  # or another plant's clock
            self._first_ns = at_ns - round(self._elapsed_s * 1e9)
        self._elapsed_s = (at_ns - self._first_ns) * 1e-9
        if self._rolled + 1 < self._whole:
            end_s = (self._rolled + 1) * self._interval_s
            if self._elapsed_s >= end_s:
                self._rolled = int(self._elapsed_s / self._interval_s)
                for histogram in self.histograms.values():
                    histogram.roll(self._rolled * self._interval_s)

    def _record(self, leg: str, value_ns: int) -> None:
        if self._counting:
            self.histograms[leg].record(value_ns)
