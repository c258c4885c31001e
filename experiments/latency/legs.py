"""The legs of a control cycle, each from the message fields that tell it; nothing else is asked.

The plant samples a state, the controller receives, waits for its release, decodes, steps, encodes,
sends, and the plant notes when the answer arrived and when it acted. What one process says of
itself is exact; what lies between a reading of the plant's clock and one of the controller's is as
good as the two clocks are known to each other (:mod:`experiments.latency.clocks`).
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, Literal, NamedTuple

from bayesrace.messages import Actuation, State, Telemetry

__all__ = ["ANSWER", "LEGS", "Cycles", "Leg", "Tally"]


@dataclass(frozen=True)
class Leg:
    """One measured interval."""

    name: str
    """In JSON and file names."""
    title: str
    clock: Literal["controller", "plant", "both"]
    """Whose clock it begins and ends on; both: it crosses from one to the other."""
    meaning: str


LEGS: Final = (
    Leg("wake_up", "wake-up error", "controller", "how late the loop woke from its sleep"),
    Leg("state_transport", "state transport", "both",
        "sampled at the plant → taken from the network by the controller's thread"),
    Leg("decode", "decode", "controller", "bytes → checked state; part of the wait for release"),
    Leg("release_wait", "wait for release", "controller",
        "taken from the network → release: the cycle begins"),
    Leg("state_age", "age of state at release", "both", "sampled at the plant → release"),
    Leg("feedback", "feedback", "controller", "feedback phase of the step; part of the cycle"),
    Leg("compute", "cycle", "controller",
        "release → actuation made: prediction over the delay, feedback, fallback"),
    Leg("encode", "encode and send", "controller",
        "actuation made → handed to the network; the first part of its transport"),
    Leg("actuation_transport", "actuation transport", "both",
        "actuation made at the controller → arrived at the plant"),
    Leg("state_to_actuation", "state → actuation", "plant",
        "sampled at the plant → the first answer to that state arrived there"),
    Leg("acting", "delay until acting", "plant",
        "time up to which the controller knew the state → the answer acts"),
    Leg("prepare", "preparation", "controller",
        "preparation phase of the step, after the actuation of the cycle before has gone"),
)  # fmt: skip
"""In the order of a cycle."""

ANSWER: Final = "state_to_actuation"
"""The leg that counts."""

_RECENT: Final = 64
"""Cycles kept open at least."""

Emit = Callable[[str, int], None]
"""Takes a leg's name and its length in ns, which may be below 0 where clocks are crossed."""


@dataclass
class Tally:
    """What else the messages tell, over the time observed."""

    states: int = 0
    actuations: int = 0
    cycles: int = 0
    """Telemetry messages seen."""
    missed: int = 0
    fallbacks: int = 0
    skipped: int = 0
    """Releases passed over, by the ticks' numbers."""
    repeated: int = 0
    """Answers to a state that had been answered already, predicted forward."""
    overtaken: int = 0
    """Answers that never acted."""
    unobserved: int = 0
    """Messages that did not get as far as here, by the numbers; the run knows nothing of it."""
    restarts: int = 0
    """Times that plant or controller began anew."""
    released_ns: int = 0
    """Time between releases added up, where no restart lies between."""
    periods: int = 0
    """Number of cycles that this time is made of, those not observed included."""

    @property
    def mean_period_ns(self) -> float | None:
        """Mean time from one cycle's release to the next one's."""
        return self.released_ns / self.periods if self.periods else None


class _Tick(NamedTuple):
    """What the controller says of a cycle, in ns."""

    released: int
    wake_up: int
    prepare: int
    feedback: int
    encode: int


@dataclass(slots=True)
class _Cycle:
    """One state and what became of it."""

    sampled_ns: int | None = None
    received_ns: int | None = None
    decode_ns: int = 0
    ticks: list[_Tick] = field(default_factory=list)
    """More than one if no newer state came in time."""
    sent_ns: list[int] = field(default_factory=list)
    """Actuations that answer it, on the controller's clock."""
    arrival_ns: list[int] = field(default_factory=list)
    """Their arrivals at the plant, since sampling."""
    acting_ns: list[int] = field(default_factory=list)


class Cycles:
    """Puts the messages of one car together, and emits the legs.

    Feed each stream in its order and :meth:`settle` now and then: a cycle is judged once
    ``horizon`` further states have been seen, or at :meth:`finish`. Memory is bounded by that.
    """

    def __init__(
        self,
        emit: Emit,
        to_plant: Callable[[int], int],
        horizon: int,
        sampled: Callable[[int], None] = lambda _: None,
    ) -> None:
        """``to_plant`` turns a reading of the controller's clock into one of the plant's.

        ``sampled`` is told, before the legs of a cycle, when its state was, on the plant's clock.
        """
        self._emit, self._sampled = emit, sampled
        self._to_plant = to_plant
        self._horizon = max(horizon, _RECENT)
        self._open: dict[int, _Cycle] = {}
        self._newest = -1
        self._epoch: int | None = None
        self._last: dict[type[State | Actuation | Telemetry], int] = {}
        self._last_cycle: Telemetry | None = None
        self.tally = Tally()

    def state(self, message: State) -> None:
        """A state, with the answers that have arrived since the one before."""
        if message.epoch != self._epoch:
            self._begin(message.epoch)
        self._follow(message)
        self.tally.states += 1
        self._newest = max(self._newest, message.seq)
        self._cycle(message.seq).sampled_ns = message.source_time_ns
        rows = message.answers
        for k in range(0, len(rows), 3):
            self._answer(int(rows[k]), rows[k + 1], rows[k + 2])

    def actuation(self, message: Actuation) -> None:
        """An actuation; those for another plant's states are not looked at."""
        self._follow(message)
        self.tally.actuations += 1
        if message.epoch == self._epoch and self._plausible(message.state_seq):
            self._cycle(message.state_seq).sent_ns.append(message.source_time_ns)

    def telemetry(self, message: Telemetry) -> None:
        """What the controller says of a cycle."""
        self._follow(message)
        self._count(message)
        if not self._plausible(message.state_seq):
            return
        cycle = self._cycle(message.state_seq)
        if cycle.received_ns is None:
            cycle.received_ns = message.received_ns
            cycle.decode_ns = round(1e3 * message.decode_us)
        parts = (message.wake_us, message.prepare_us, message.solve_us, message.encode_us)
        cycle.ticks.append(_Tick(message.released_ns, *(round(1e3 * part) for part in parts)))

    def settle(self) -> None:
        """Judge what is old enough; call it when all streams are about equally far."""
        self._judge_to(self._newest - self._horizon)

    def finish(self) -> None:
        """No more messages: judge what is open."""
        self._judge_to(self._newest)

    def reset(self) -> None:
        """Begin to count anew; open cycles are dropped."""
        self._open.clear()
        self._last_cycle = None
        self.tally = Tally()

    def _answer(self, state_seq: int, arrival_s: float, acting_s: float) -> None:
        cycle = self._open.get(state_seq)
        if cycle is None:  # older than the time observed
            return
        cycle.arrival_ns.append(round(1e9 * arrival_s))
        if acting_s < 0:
            self.tally.overtaken += 1
        else:
            cycle.acting_ns.append(round(1e9 * acting_s))

    def _cycle(self, state_seq: int) -> _Cycle:
        return self._open.setdefault(state_seq, _Cycle())

    def _plausible(self, state_seq: int) -> bool:
        """Whether it can be a state still open, or one that is about to be seen."""
        return abs(state_seq - self._newest) <= 4 * self._horizon

    def _judge_to(self, limit: int) -> None:
        for seq in sorted(seq for seq in self._open if seq <= limit):
            self._judge(self._open.pop(seq))

    def _judge(self, cycle: _Cycle) -> None:
        if cycle.sampled_ns is not None:
            self._sampled(cycle.sampled_ns)
        self._judge_controller(cycle)
        for acting_ns in cycle.acting_ns:
            self._emit("acting", acting_ns)
        if cycle.arrival_ns:
            self._emit(ANSWER, cycle.arrival_ns[0])
            self.tally.repeated += len(cycle.arrival_ns) - 1
        if cycle.sampled_ns is not None:
            self._judge_crossing(cycle, cycle.sampled_ns)

    def _judge_controller(self, cycle: _Cycle) -> None:
        """What the controller says of itself."""
        for tick in cycle.ticks:
            for name in ("wake_up", "prepare", "feedback", "encode"):
                self._emit(name, getattr(tick, name))
        if cycle.received_ns is not None:
            self._emit("decode", cycle.decode_ns)
            self._emit("release_wait", cycle.ticks[0].released - cycle.received_ns)
        # Which belongs to which is known only if none is missing.
        if len(cycle.sent_ns) == len(cycle.ticks):
            for sent_ns, tick in zip(cycle.sent_ns, cycle.ticks, strict=True):
                self._emit("compute", sent_ns - tick.released)

    def _judge_crossing(self, cycle: _Cycle, sampled_ns: int) -> None:
        """What lies between the clocks of both."""
        to_plant = self._to_plant
        if cycle.received_ns is not None:
            self._emit("state_transport", to_plant(cycle.received_ns) - sampled_ns)
        for tick in cycle.ticks:
            self._emit("state_age", to_plant(tick.released) - sampled_ns)
        if len(cycle.sent_ns) == len(cycle.arrival_ns):
            for sent_ns, arrival_ns in zip(cycle.sent_ns, cycle.arrival_ns, strict=True):
                self._emit("actuation_transport", sampled_ns + arrival_ns - to_plant(sent_ns))

    def _begin(self, epoch: int) -> None:
        """Another plant process: its numbers are not those of the one before."""
        if self._epoch is not None:
            self.tally.restarts += 1
            self._open.clear()
        self._epoch, self._newest = epoch, -1
        self._last.pop(State, None)

    def _follow(self, message: State | Actuation | Telemetry) -> None:
        """Counts what is missing in a stream."""
        kind = type(message)
        before = self._last.get(kind)
        self._last[kind] = message.seq
        if before is None:
            return
        if message.seq <= before:  # its sender began anew
            self.tally.restarts += kind is Actuation
            if kind is Telemetry:
                self._last_cycle = None
            return
        self.tally.unobserved += message.seq - before - 1

    def _count(self, message: Telemetry) -> None:
        self.tally.cycles += 1
        self.tally.missed += message.missed
        self.tally.fallbacks += message.fallback > 0
        before, self._last_cycle = self._last_cycle, message
        if before is None:
            return
        sent = message.seq - before.seq
        self.tally.skipped += max(message.tick - before.tick - sent, 0)
        self.tally.released_ns += message.released_ns - before.released_ns
        self.tally.periods += sent
