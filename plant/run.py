"""One run of the plant, in lockstep or in real time; the same car below both."""

import heapq
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Final, NamedTuple

from bayesrace import clock
from bayesrace.messages import (
    ACTUATION,
    Actuation,
    BrakingPlan,
    Decoder,
    Numbering,
    RunRequest,
    State,
    Truth,
)
from bayesrace.plant.car import CarRun, End, drive_lockstep, fault_end, truth_behind
from bayesrace.plant.faults import FaultPlayer, SensorFault
from bayesrace.plant.vehicle import Command, FmuFault, Vehicle, planned_at
from bayesrace.realtime import SUSPENDED_S
from bayesrace.sensors import EXACT, Sensors
from bayesrace.transport import LOCKSTEP_SPIN_S, Inbox, Item, Kind, Publisher
from bayesrace.transport.hold import HOLD_MISSING, HoldWatch

__all__ = ["CONTROLLER_LOST", "Run", "RunCounters"]

CONTROLLER_LOST: Final = End("controller_lost", "the controller vanished: killed or unreachable")

_REMEMBERED: Final = 1024
"""States to which an actuation may refer; one for an older state is stale."""

_OVERDUE: Final = 1.5
"""Times the interval of the commands after which the next one is overdue ..."""
_LONGEST_S: Final = 0.1
"""... which counts as no longer than this [s]."""

_NEVER: Final = -1.0
"""In place of a delay, see ``State.actuation_delays``."""
_MOST_DELAYS: Final = 64
"""Rows of ``State.actuation_delays`` that one message has room for."""

_ROUNDING_S: Final = 1e-9
"""Of plant time."""

_STANDING_MPS: Final = 0.02
_STOPPING_S: Final = 10.0
"""How long a car that is stopped may take to stand."""


@dataclass(slots=True)
class RunCounters:
    """What went on in the runs so far, besides the guard's counts."""

    late: int = 0
    """Periods that ended without the answer to the state at their beginning."""
    stale: int = 0
    """Actuations for another plant, run or state than the current one, or overtaken ones."""
    overruns: int = 0
    """Periods that the plant itself finished more than a period too late."""
    suspended: int = 0
    """Times that the process did not run for a second or more; plant time stood still meanwhile."""
    holds_lost: int = 0
    """Held runs whose director was missing, so that the car was stopped."""


def _decided(one: Actuation) -> float:
    return one.decided_at_s


class _Waiting(NamedTuple):
    """An actuation that has arrived; the order is that of acting."""

    acts_ns: int
    number: int
    """Of arrival: two may act at the same time."""
    actuation: Actuation


@dataclass(eq=False, kw_only=True)
class Run:
    """Executes one accepted request."""

    request: RunRequest
    simulator: Vehicle
    inbox: Inbox
    states: Publisher[State]
    truths: Publisher[Truth]
    decoder: Decoder[Actuation]
    counters: RunCounters
    numbering: Numbering
    react: Callable[[Item], End | None]
    """Handles what is neither an actuation nor the controller's going (requests, signals); what it
    returns, if anything, ends the run."""
    beat: Callable[[], End | None]
    """Called once a period; what it returns ends the run, too."""
    pause: Callable[[float], End | None]
    """Called in lockstep after each :attr:`.RunRequest.pause_s`, with plant time; returns when the
    run may go on, or what ends it."""
    suspended: Callable[[float], None]
    """Called when the process has not run for so many seconds in real time."""
    hold: HoldWatch
    epoch: int
    delay_s: float = 0.0
    """Added to states and to actuations."""
    buffer_s: float = 0.0
    """From the decision on an input until it acts, at least: :attr:`.PlantSettings.buffer_s`."""
    sensors: Sensors = EXACT
    seed: int = 0
    """Of what they add."""
    faults: Sequence[SensorFault] = ()

    def __post_init__(self) -> None:
        self._faults = FaultPlayer(self.faults)
        played = self.sensors, 2 * self.delay_s, self.seed
        self._car = CarRun(self.request, self.simulator, self.epoch, *played)
        self._delay_ns = round(self.delay_s * 1e9)
        self._start_ns = 0
        self._pauses = 0
        # In real time:
        self._outbox: deque[tuple[int, State, tuple[float, ...]]] = deque()
        self._sampled_ns: dict[int, int] = {}
        self._waiting: list[_Waiting] = []
        self._held: Actuation | None = None
        self._held_since_s = self._interval_s = 0.0
        self._braking: BrakingPlan | None = None
        self._lost_s: float | None = None
        """When the director was missing, or a real car's run was over; nothing that arrives drives
        the car from then on."""
        self._over: End | None = None
        """Why a real car is being stopped."""

    @property
    def laps(self) -> int:
        """Start-line crossings so far."""
        return self._car.laps

    @property
    def time_s(self) -> float:
        """Plant time since the start."""
        return self._car.time_s

    def execute(self) -> End:
        """Drive until something ends the run."""
        if self.request.lockstep:
            self.inbox.spin_s = LOCKSTEP_SPIN_S
            try:
                first = self.states.next_seq
                return drive_lockstep(self._car, first, self._exchange, self._beat_or_pause)
            finally:
                self.inbox.spin_s = 0.0
        with self.inbox.stamped():
            return self._real_time()

    def _send(self, state: State, x: tuple[float, ...]) -> None:
        """The truth goes second: it must not delay the measurement. Of a real car there is none."""
        self.states.put(self._faults.report(state), lockstep=state.lockstep)
        if not self.simulator.real:
            self.truths.put(truth_behind(state, x), lockstep=state.lockstep)

    # Lockstep ----------------------------------------------------------------------------------

    def _beat_or_pause(self) -> End | None:
        """Once a period."""
        end, pause_s = self.beat(), self.request.pause_s
        if end is None and 0 < pause_s * (self._pauses + 1) <= self.time_s + _ROUNDING_S:
            self._pauses += 1
            end = self.pause(self.time_s)
        return end

    def _exchange(self, state: State, x: tuple[float, ...]) -> tuple[float, ...] | End:
        """Sends the state and waits for its answer; the last one has none."""
        self._send(state, x)
        return () if state.final else self._answer_to(state.seq)

    def _answer_to(self, seq: int) -> tuple[float, ...] | End:
        """Waits for the actuation that answers this state, or for what ends the run."""
        deadline = clock.monotonic() + self.request.actuation_timeout_s
        run = self.request.run
        while True:
            item = self.inbox.get(deadline - clock.monotonic())
            if item is None:
                return self._timed_out(seq)
            if item.kind is Kind.MESSAGE:
                actuation: Actuation | None = item.value
                if actuation is None or item.name != ACTUATION.name:
                    continue
                self.numbering.note(actuation.seq)
                answered = (actuation.epoch, actuation.run, actuation.state_seq)
                if answered == (self.epoch, run, seq):
                    return actuation.u
                self.counters.stale += 1
            elif item.kind is Kind.GONE and item.name == "controller":
                return CONTROLLER_LOST
            elif (end := self.react(item)) is not None:
                return end

    def _timed_out(self, seq: int) -> End:
        text = f"no actuation for state {seq} within {self.request.actuation_timeout_s:g} s"
        if self.decoder.last_reason:
            text += f"; last refused message: {self.decoder.last_reason}"
        return End("actuation_timeout", text)

    # Free-running ------------------------------------------------------------------------------

    def _real_time(self) -> End:
        period_ns = round(self.simulator.step_s * 1e9)
        seq = self.states.next_seq
        first = self._car.sample(seq)
        late_ns = 0
        self._start_ns = start_ns = first[0].source_time_ns
        self.simulator.begins(start_ns)
        self._enqueue(*first)
        while True:
            begin_ns = start_ns + self.simulator.steps * period_ns
            end = self._pass(begin_ns + period_ns)
            before_ns, late_ns = late_ns, clock.monotonic_ns() - begin_ns - period_ns
            if late_ns - before_ns > SUSPENDED_S * 1e9:
                # Not to be made up for: nobody could have driven the car meanwhile.
                self.counters.suspended += 1
                self.suspended(late_ns * 1e-9)
                start_ns, begin_ns, late_ns = start_ns + late_ns, begin_ns + late_ns, 0
                self._start_ns = start_ns
                self.simulator.begins(start_ns)
            self.counters.overruns += late_ns > period_ns
            asked = end or self._receive()
            if asked is None and self._lost_s is None and self.hold.missing:
                self._lost_s = self._car.time_s
                self.counters.holds_lost += 1
            delays, end = self._drive_period(begin_ns, begin_ns + period_ns, seq)
            # A final state tells the controller that this run needs no director any more.
            end = self._halting(end or self._finished() or asked)
            if end is not None and end.reason == "left_world":
                return end  # no message could carry this state
            seq += 1
            self._enqueue(*self._car.sample(seq, delays, final=end is not None))
            if end is not None:
                if self._outbox:
                    self._sleep_and_send(self._outbox[-1][0])
                return end
            end = self.beat()
            if self._over is None and (end := self._halting(end)) is not None:
                return end

    def _finished(self) -> End | None:
        """What ends the run in the state just reached; of a car that is being stopped, that it
        stands."""
        end = self._car.finished()
        if end is None and (why := self.simulator.silent):
            end = End("plant_fault", why)
        if self._lost_s is None or (end is not None and end.reason == "left_world"):
            return end
        if self._rolls and self.time_s < self._lost_s + _STOPPING_S:
            return None
        vx_mps = float(self.simulator.x[3])
        return self._over or End("hold_lost", f"stopped to {vx_mps:.2f} m/s: {HOLD_MISSING}")

    @property
    def _rolls(self) -> bool:
        """Of a car that cannot be seen: that its braking plan is not over."""
        if self.simulator.silent:
            return planned_at(self._braking, self.time_s) is not None
        return abs(float(self.simulator.x[3])) > _STANDING_MPS

    def _halting(self, end: End | None) -> End | None:
        """A run of a real car does not end before it stands, unless it is asked to twice."""
        if end is None or not self.simulator.real or self._over is not None or not self._rolls:
            return end
        self._lost_s = self.time_s if self._lost_s is None else self._lost_s
        self._over = end
        return None

    def _pass(self, until_ns: int) -> End | None:
        """The rest of a period; a real car meanwhile does what comes as soon as it comes."""
        if not self.simulator.real:
            self._sleep_and_send(until_ns)
            return None
        self.simulator.actuate(self._fresh(0))
        acting = self._held
        while (left_ns := until_ns - clock.monotonic_ns()) > 0:
            if (end := self._receive(left_ns * 1e-9)) is not None:
                return end
            now_ns = clock.monotonic_ns()
            due = (one.actuation for one in self._waiting if one.acts_ns <= now_ns)
            new = max(due, key=_decided, default=None)
            if new is None or self._lost_s is not None:
                continue
            if acting is None or _decided(new) > _decided(acting):
                self.simulator.actuate(new.u)
                acting = new
        return None

    def _enqueue(self, state: State, x: tuple[float, ...]) -> None:
        """Send the state when its delay is over; keep in mind when it was sampled."""
        self._sampled_ns[state.seq] = state.source_time_ns
        self._sampled_ns.pop(state.seq - _REMEMBERED, None)
        self._outbox.append((state.source_time_ns + self._delay_ns, state, x))
        self._sleep_and_send(0)

    def _sleep_and_send(self, until_ns: int) -> None:
        """Sleep, sending the states whose delay is over in the meantime."""
        outbox = self._outbox
        while outbox and outbox[0][0] <= max(until_ns, clock.monotonic_ns()):
            due_ns, state, x = outbox.popleft()
            clock.sleep_until_ns(due_ns)
            self._send(state, x)
        clock.sleep_until_ns(until_ns)

    def _receive(self, wait_s: float = 0.0) -> End | None:
        """Takes what has arrived by now, and no more: requests without end must not hold up the
        car. Returns what ends the run, if anything. ``wait_s``: for the first, at most."""
        first = [self.inbox.get(wait_s)] if wait_s > 0 else []
        for item in chain(first, (self.inbox.get() for _ in range(self.inbox.queued))):
            if item is None:
                break
            if item.kind is Kind.MESSAGE:
                actuation = item.value
                if actuation is None:
                    continue
                mine = (actuation.epoch, actuation.run) == (self.epoch, self.request.run)
                if item.name != ACTUATION.name:
                    self._braking = actuation if mine and self._lost_s is None else self._braking
                    continue
                self.numbering.note(actuation.seq)
                # one from the future would never grow old, and every later one would be overtaken
                ahead = actuation.decided_at_s > self.simulator.time_s + 2 * self.simulator.step_s
                known = actuation.state_seq in self._sampled_ns
                if not mine or ahead or not known:
                    self.counters.stale += 1
                    continue
                due_s = actuation.decided_at_s + self.buffer_s if self.buffer_s else 0.0
                acts_ns = max(
                    item.received_ns + self._delay_ns, self._start_ns + round(due_s * 1e9)
                )
                waiting = _Waiting(acts_ns, self.numbering.received, actuation)
                heapq.heappush(self._waiting, waiting)
            elif (end := self.react(item)) is not None:
                return end
        return None

    def _drive_period(
        self, begin_ns: int, end_ns: int, seq: int
    ) -> tuple[tuple[float, ...], End | None]:
        """Drive one period of zero-order hold: ``State.actuation_delays``, and a fault if any."""
        simulator = self.simulator
        substep_ns = simulator.step_s * 1e9 / simulator.substeps
        commands: list[tuple[int, Command]] = []
        delays: list[float] = []
        done, came = 0, False
        while self._waiting and self._waiting[0].acts_ns < end_ns:
            acts_ns, _, new = heapq.heappop(self._waiting)
            arrival_s = (acts_ns - self._sampled_ns.get(new.state_seq, acts_ns)) * 1e-9
            if self._held is not None and new.decided_at_s <= self._held.decided_at_s:
                self.counters.stale += 1
                delays += (float(new.state_seq), arrival_s, _NEVER)
                continue
            # It acts from the first substep that begins after its arrival.
            at = min(max(-int((begin_ns - acts_ns) // substep_ns), done), simulator.substeps)
            if at > done:
                commands.append((at - done, self._fresh(done)))
            elif came:  # with the one before, as after a link was held up: that one never acts
                delays[-1] = _NEVER
            before_s = new.decided_at_s if self._held is None else self._held.decided_at_s
            self._interval_s = min(new.decided_at_s - before_s, _LONGEST_S)
            self._held, done, came = new, at, True
            self._held_since_s = simulator.time_s + at * substep_ns * 1e-9
            acting_s = self._held_since_s - new.decided_at_s + simulator.command_s
            delays += (float(new.state_seq), arrival_s, acting_s)
        if done < simulator.substeps:
            commands.append((simulator.substeps - done, self._fresh(done)))
        end: End | None = None
        try:
            simulator.step_switched(commands)
        except FmuFault as fault:
            end = fault_end(fault)
        if self._held is None or self._held.state_seq < seq:
            self.counters.late += 1
        return tuple(delays[: 3 * _MOST_DELAYS]), end

    def _fresh(self, substep: int) -> Command:
        """The held command while the next one is not overdue; then the braking plan, or as long as
        there is none the held command for a while, or None: brake. Without the director at once."""
        if self._held is None:
            return None
        simulator = self.simulator
        now_s = simulator.time_s + substep * simulator.step_s / simulator.substeps
        overdue_s = _OVERDUE * max(self._interval_s, simulator.step_s)
        drives = self._lost_s is None
        if drives and now_s - self._held_since_s <= overdue_s:
            return self._held.u
        if (planned := planned_at(self._braking, now_s)) is not None:
            return planned
        age_s = now_s - self._held.decided_at_s
        return self._held.u if drives and age_s <= self.request.actuation_timeout_s else None
