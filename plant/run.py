"""One run of the plant, in lockstep or by the wall clock; the same car below both."""

import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Final

from bayesrace.clock import sleep_until_ns
from bayesrace.messages import Actuation, Decoder, RunRequest, State
from bayesrace.transport import LOCKSTEP_SPIN_S, Inbox, Item, Kind, Publisher
from plant.laps import LineCounter
from plant.simulator import Simulator

__all__ = ["End", "Run", "RunCounters"]

_WORLD_M: Final = 1e4


@dataclass(slots=True)
class RunCounters:
    """What went on in the runs so far, besides the guard's counts."""

    late: int = 0
    """Periods that ended without the answer to the state at their beginning."""
    stale: int = 0
    """Actuations for another state or run than the one waited for."""
    overruns: int = 0
    """Periods that the plant itself finished more than a period too late."""

    def as_dict(self) -> dict[str, int]:
        """Name to count."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


@dataclass(frozen=True, slots=True)
class End:
    """Why a run ended: a word of ``END_REASONS``, and a sentence."""

    reason: str
    text: str


@dataclass(slots=True)
class _Held:
    """The command that acts, and the number of the state that it answers."""

    u: tuple[float, ...]
    state_seq: int


class Run:
    """Executes one accepted request.

    ``react`` handles what is neither an actuation nor the controller's going (requests, signals);
    what it returns, if anything, ends the run.
    """

    def __init__(
        self,
        request: RunRequest,
        simulator: Simulator,
        inbox: Inbox,
        publisher: Publisher[State],
        decoder: Decoder[Actuation],
        counters: RunCounters,
        react: Callable[[Item], End | None],
    ) -> None:
        self.request = request
        self._simulator = simulator
        self._inbox = inbox
        self._publisher = publisher
        self._decode = decoder
        self._counters = counters
        self._react = react
        self._line = LineCounter(
            request.line_x_m,
            request.line_y_m,
            request.line_heading_rad,
            request.line_left_m,
            request.line_right_m,
        )
        simulator.reset(request.x0)
        self._line.restart(request.x0[0], request.x0[1])

    @property
    def laps(self) -> int:
        """Start-line crossings so far."""
        return self._line.crossings

    @property
    def time_s(self) -> float:
        """Plant time since the start."""
        return self._simulator.time_s

    def execute(self) -> End:
        """Drive until something ends the run."""
        if self.request.lockstep:
            self._inbox.spin_s = LOCKSTEP_SPIN_S
            try:
                return self._lockstep()
            finally:
                self._inbox.spin_s = 0.0
        with self._inbox.stamped():
            return self._wall_clock()

    # Both modes --------------------------------------------------------------------------------

    def _publish(self) -> int:
        """Send the state; returns its number."""
        simulator, request = self._simulator, self.request
        seq = self._publisher.next_seq
        state = State(
            seq,
            time.monotonic_ns(),
            request.run,
            simulator.time_s,
            tuple(simulator.x.tolist()),
            simulator.u_applied,
            self._line.crossings,
            request.lockstep,
        )
        self._publisher.put(state, lockstep=request.lockstep)
        return seq

    def _finished(self) -> End | None:
        """Judges the state that has just been reached."""
        x, y = float(self._simulator.x[0]), float(self._simulator.x[1])
        if not (abs(x) <= _WORLD_M and abs(y) <= _WORLD_M):
            return End("left_world", f"the car is {_WORLD_M:g} m away or nowhere")
        laps = self._line.move(x, y)
        if 0 < self.request.laps <= laps:
            return End("laps", f"{laps} lap(s) done")
        if self._simulator.time_s >= self.request.max_time_s:
            return End("max_time", f"time limit of {self.request.max_time_s:g} s reached")
        return None

    def _reached(self) -> int | End:
        """Sends the state that a period led to; its number, or the end of the run.

        The last state of a run is sent as well, unless no message could carry it.
        """
        end = self._finished()
        if end is not None and end.reason == "left_world":
            return end
        seq = self._publish()
        return seq if end is None else end

    # Lockstep ----------------------------------------------------------------------------------

    def _lockstep(self) -> End:
        seq = self._publish()
        while True:
            answer = self._answer_to(seq)
            if isinstance(answer, End):
                return answer
            self._simulator.step(answer)
            reached = self._reached()
            if isinstance(reached, End):
                return reached
            seq = reached

    def _answer_to(self, seq: int) -> tuple[float, ...] | End:
        """Waits for the actuation that answers this state, or for what ends the run."""
        deadline = time.monotonic() + self.request.actuation_timeout_s
        run = self.request.run
        while True:
            item = self._inbox.get(deadline - time.monotonic())
            if item is None:
                return self._timed_out(seq)
            if item.kind is Kind.MESSAGE:
                actuation = self._decode(item.value)
                if actuation is None:
                    continue
                if actuation.state_seq == seq and actuation.run == run:
                    return actuation.u
                self._counters.stale += 1
            elif item.kind is Kind.GONE:
                return End("controller_lost", "the controller vanished: killed or unreachable")
            elif (end := self._react(item)) is not None:
                return end

    def _timed_out(self, seq: int) -> End:
        text = f"no actuation for state {seq} within {self.request.actuation_timeout_s:g} s"
        if self._decode.last_reason:
            text += f"; last refused message: {self._decode.last_reason}"
        return End("actuation_timeout", text)

    # Free-running ------------------------------------------------------------------------------

    def _wall_clock(self) -> End:
        period_ns = round(self._simulator.step_s * 1e9)
        first_seq = seq = self._publish()
        start_ns = time.monotonic_ns()
        held: _Held | None = None
        while True:
            begin_ns = start_ns + (seq - first_seq) * period_ns
            sleep_until_ns(begin_ns + period_ns)
            if time.monotonic_ns() > begin_ns + 2 * period_ns:
                self._counters.overruns += 1
            arrivals, end = self._arrivals(first_seq)
            if end is not None:
                return end
            held = self._drive_period(begin_ns, held, arrivals, seq)
            reached = self._reached()
            if isinstance(reached, End):
                return reached
            seq = reached

    def _arrivals(self, first_seq: int) -> tuple[list[tuple[int, _Held]], End | None]:
        """What arrived during the period: usable actuations with their times of arrival."""
        arrivals: list[tuple[int, _Held]] = []
        while (item := self._inbox.get()) is not None:
            if item.kind is Kind.MESSAGE:
                actuation = self._decode(item.value)
                if actuation is None:
                    continue
                if actuation.run == self.request.run and actuation.state_seq >= first_seq:
                    arrivals.append((item.received_ns, _Held(actuation.u, actuation.state_seq)))
                else:
                    self._counters.stale += 1
            elif item.kind is not Kind.GONE and (end := self._react(item)) is not None:
                return arrivals, end
        return arrivals, None

    def _drive_period(
        self, begin_ns: int, held: _Held | None, arrivals: list[tuple[int, _Held]], seq: int
    ) -> _Held | None:
        """One period of zero-order hold, to the substep; returns what is held at its end."""
        simulator = self._simulator
        substep_ns = simulator.step_s * 1e9 / simulator.substeps
        commands: list[tuple[int, tuple[float, ...] | None]] = []
        done = 0
        for received_ns, new in arrivals:
            if held is not None and new.state_seq <= held.state_seq:
                self._counters.stale += 1
                continue
            # It acts from the first substep that begins after its arrival.
            at = min(max(-int((begin_ns - received_ns) // substep_ns), done), simulator.substeps)
            if at > done:
                commands.append((at - done, self._fresh(held, seq)))
            held, done = new, at
        if done < simulator.substeps:
            commands.append((simulator.substeps - done, self._fresh(held, seq)))
        simulator.step_switched(commands)
        if held is None or held.state_seq < seq:
            self._counters.late += 1
        return held

    def _fresh(self, held: _Held | None, seq: int) -> tuple[float, ...] | None:
        """The held command, or None (brake) if the state it answers is too old."""
        if held is None:
            return None
        age_s = (seq - held.state_seq) * self._simulator.step_s
        return held.u if age_s <= self.request.actuation_timeout_s else None
