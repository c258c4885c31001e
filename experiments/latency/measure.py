"""The time observed: takes in messages, clocks, counters and memory, and disturbs no one."""

import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from bayesrace.errors import InputError
from bayesrace.messages import Event, Status
from bayesrace.tracks import Track
from bayesrace.transport import Director, Kind
from experiments.latency.memory import MemoryWatch
from experiments.latency.observer import ClockProbe, Observer
from experiments.latency.traffic import numbers

__all__ = ["Measurement", "Snapshot"]

_LOOK_S: Final = 0.2
"""Between two looks at what has arrived; as often, timestamps are exchanged with other hosts."""

_FIRST_ATTEMPTS: Final = 5
_ATTEMPTS: Final = 25


@dataclass(frozen=True)
class Snapshot:
    """What both processes had counted at about the same time."""

    plant: Status
    controller: Status
    apart_s: float
    """At most so long after the one the other answered."""

    @property
    def in_flight(self) -> tuple[int, int]:
        """States, actuations sent and neither received nor counted as lost."""
        plant, controller = numbers(self.plant), numbers(self.controller)

        def missing(name: str, sender: dict[str, int], receiver: dict[str, int]) -> int:
            arrived = receiver.get(f"{name}_received", 0) + receiver.get(f"{name}_lost", 0)
            return sender.get(f"{name}_sent", 0) - arrived

        return missing("states", plant, controller), missing("actuations", controller, plant)


@dataclass
class Measurement:
    """One car, from outside. Call the methods in their order."""

    session: Any
    director: Director
    car: str
    rate_hz: float
    duration_s: float
    track: Track | None
    out: Path
    pids: dict[str, int]
    """Processes on this machine whose memory is watched."""
    notes: list[str] = field(default_factory=list)
    ended_early: str = ""
    """Why the time observed was cut short."""
    interrupted: bool = False
    elapsed_s: float = 0.0

    def __post_init__(self) -> None:
        self.clocks = ClockProbe(self.session, self.car)
        self.clocks.begin()
        self.observer = Observer(
            self.session, self.car, self.rate_hz, self.clocks.pair, self.duration_s, self.track,
            self.out,
        )  # fmt: skip
        self.memory = MemoryWatch(self.pids, self.duration_s)

    def settle(self, until_ns: int) -> None:
        """Follows the run without counting."""
        with self.director.inbox.receive_signals():
            while not self.ended_early and (left_ns := until_ns - time.monotonic_ns()) > 0:
                self._wait(min(_LOOK_S, left_ns * 1e-9))
                self.observer.drain()
                if not self.clocks.pair.shared:
                    self.clocks.exchange()

    def observe(self) -> None:
        """Counts for ``duration_s``, or until the run ends, a process started here, or Ctrl-C."""
        self.begin = self._snapshot()
        self.observer.begin()
        began_ns = time.monotonic_ns()
        end_ns = began_ns + round(self.duration_s * 1e9)
        with self.director.inbox.receive_signals():
            while not self.ended_early and (left_ns := end_ns - time.monotonic_ns()) > 0:
                self._wait(min(_LOOK_S, left_ns * 1e-9))
                self._look((time.monotonic_ns() - began_ns) * 1e-9)
            self.elapsed_s = (time.monotonic_ns() - began_ns) * 1e-9
            self.memory.look(self.elapsed_s)  # at least once: the looks before may have come late
            self.observer.drain()
            self._conclude()

    def _conclude(self) -> None:
        """The end's counters and clocks; without those of the processes that have gone."""
        try:
            self.end = self._snapshot(self.begin)
        except InputError as error:
            self.end = self.begin
            self.notes.append(f"no counters at the end: {error}")
        else:
            self.clocks.exchange(10)
        self.clocks.settle()
        if self.clocks.pair.shared and not self.clocks.pair.agree():
            self.notes.append(
                "the clocks of plant and controller were one at the beginning and are not any more"
            )
        self.observer.finish()

    def _look(self, elapsed_s: float) -> None:
        self.observer.drain()
        self.memory.look(elapsed_s)
        if not self.clocks.pair.shared:
            self.clocks.exchange()

    def _wait(self, timeout_s: float) -> None:
        """Lets time pass; notices what ends the measurement."""
        until = time.monotonic() + timeout_s
        while (left_s := until - time.monotonic()) > 0 and not self.ended_early:
            item = self.director.inbox.get(left_s)
            if item is None:
                return
            if item.kind is Kind.SIGNAL:
                self.interrupted, self.ended_early = True, "interrupted"
            elif item.kind is Kind.GONE:
                self._gone(item.name)
            elif isinstance(item.value, Event) and item.value.kind == "run_ended":
                self.ended_early = item.value.text

    def _gone(self, source: str) -> None:
        text = f"the {source} of car '{self.car}' vanished"
        if source in self.pids:
            self.ended_early = text
        else:
            self.notes.append(text)

    def _snapshot(self, like: Snapshot | None = None) -> Snapshot:
        """Counters of both; if it can be, of a moment without a message between them.

        Asked first, the controller answers right after its actuation has gone, and the plant when
        it has taken that in, before the next state: nothing is under way, and what differs was
        counted before this process looked. A period may begin in between, so it is tried a few
        times: until the difference is that of ``like``, else the commonest difference counts.
        """
        found: list[Snapshot] = []
        for _ in range(_FIRST_ATTEMPTS if like is None else _ATTEMPTS):
            begin = time.monotonic()
            controller, plant = (self.director.status(name) for name in ("controller", "plant"))
            found.append(Snapshot(plant, controller, time.monotonic() - begin))
            if like is not None and found[-1].in_flight == like.in_flight:
                return found[-1]
        commonest = Counter(one.in_flight for one in found).most_common(1)[0][0]
        return next(one for one in found if one.in_flight == commonest)
