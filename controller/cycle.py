"""The control cycle with its execution times and telemetry, for the loops that carry the messages.

:mod:`bayesrace.controller.process` receives states and sends actuations over the network;
``bayesrace.operation.closed_loop`` does so by function calls. Both answer a lockstep state by
:meth:`Cycle.answer`, so their runs are equal to the bit.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from bayesrace import clock
from bayesrace.arrays import Floats
from bayesrace.controller.driver import Decision, Driver
from bayesrace.controller.interface import NO_PLAN, Controller, Environment, StepOutput
from bayesrace.controller.settings import CycleSettings
from bayesrace.messages import NOT_REPORTED, SENSOR_FAULTS, Actuation, State, Telemetry
from bayesrace.vehicles.parameters import Car

__all__ = ["Cycle", "Timing"]

_SCALE: Final = 1e6
_LARGEST: Final = 1e6
_LARGEST_MEASURE: Final = 1e12
_NO_OUTPUT: Final = StepOutput(u=np.zeros(2), plan_u=NO_PLAN)


@dataclass(slots=True)
class Timing:
    """Times of the cycle at hand, as in :class:`bayesrace.messages.Telemetry`, and the loop's
    counters since the start."""

    released_ns: int = 0
    received_ns: int = 0
    missed: bool = False
    wake_us: float = 0.0
    decode_us: float = 0.0
    prepare_us: float = 0.0
    prepared_s: float = 0.0
    prepared_refused: tuple[int, ...] = ()
    solve_us: float = 0.0
    encode_us: float = 0.0
    ticks: int = 0
    """Cycles, late ones included."""
    skipped: int = 0
    """Releases passed over because a cycle before took too long."""
    misses: int = 0
    """Cycles whose actuation was on its way only after the deadline."""
    overruns: int = 0
    """Cycles that took more than their budget."""
    late_states: int = 0
    """Late cycles: further ones after a release, for a state that came after its window."""

    @property
    def tick(self) -> int:
        """Number of the newest cycle's release."""
        return self.ticks + self.skipped - self.late_states - 1


class Cycle:
    """Drives one car with one controller; for one thread."""

    def __init__(self, controller: Controller, car: Car, settings: CycleSettings) -> None:
        """``car``: whose limits hold."""
        self.driver = Driver(controller, car, settings)
        self.timing = Timing()
        self._controller = controller
        self._reported = 0

    def answer(
        self,
        state: State,
        send: Callable[[State, Decision], None],
        environment: Environment | None = None,
    ) -> None:
        """Answers a state of a lockstep run, then prepares for the next one."""
        self.timing.released_ns = clock.monotonic_ns()
        send(state, self.decide(self.driver.time_s, environment=environment))
        self.prepare(self.driver.interval_s, 0.0)

    def decide(
        self,
        decided_at_s: float,
        budget_s: float = 0.0,
        spent_s: float = 0.0,
        environment: Environment | None = None,
    ) -> Decision:
        """:meth:`Driver.decide`, timed."""
        begin_ns = clock.perf_counter_ns()
        decision = self.driver.decide(decided_at_s, budget_s, spent_s, environment)
        self.timing.solve_us = (clock.perf_counter_ns() - begin_ns) * 1e-3
        return decision

    def prepare(self, period_s: float, budget_s: float) -> None:
        """:meth:`Driver.prepare`, timed."""
        begin_ns = clock.perf_counter_ns()
        self.driver.prepare(period_s, budget_s)
        timing = self.timing
        timing.prepare_us = (clock.perf_counter_ns() - begin_ns) * 1e-3
        timing.prepared_s = period_s
        timing.prepared_refused = self.driver.refusals if budget_s > 0 else ()

    def actuation(self, seq: int, state: State, decision: Decision) -> Actuation:
        """The message that answers ``state``."""
        return Actuation(
            seq=seq,
            source_time_ns=clock.monotonic_ns(),
            epoch=state.epoch,
            run=state.run,
            state_seq=state.seq,
            decided_at_s=decision.decided_at_s,
            u=(decision.d, decision.delta_rate),
            weights_version=self._controller.weights_version,
            status=decision.status,
        )

    def telemetry(self, seq: int, state: State, decision: Decision, received_ns: int) -> Telemetry:
        """How the cycle went; counts it."""
        timing = self.timing
        timing.ticks += 1
        timing.received_ns = received_ns
        output = self.driver.output or _NO_OUTPUT
        estimate, deviation = self._estimate()
        states, self._reported = self.driver.taken - self._reported, self.driver.taken
        prepared_s, prepared_refused = timing.prepared_s, timing.prepared_refused
        timing.prepared_s, timing.prepared_refused = 0.0, ()
        numbers = {"cost": output.cost, "cost_shifted": output.cost_shifted, **output.numbers}
        return Telemetry(
            seq=seq,
            source_time_ns=clock.monotonic_ns(),
            run=state.run,
            state_seq=state.seq,
            status=decision.status,
            fallback=int(decision.level),
            tick=timing.tick,
            released_ns=timing.released_ns,
            received_ns=timing.received_ns,
            missed=timing.missed,
            wake_us=timing.wake_us,
            decode_us=timing.decode_us,
            prepare_us=timing.prepare_us,
            solve_us=decision.step_us or timing.solve_us,
            encode_us=timing.encode_us,
            delay_s=decision.delay_s,
            plan_x=_finite(output.plan_x),
            plan_u=_finite(output.plan_u),
            tube_m=_finite(output.tube_m),
            sensor_fault=SENSOR_FAULTS[decision.fault],
            second_start=output.second_start,
            estimate=estimate,
            deviation=deviation,
            states=states,
            late_s=max(decision.late_s, 0.0),
            refused=decision.refused,
            prepared_s=prepared_s,
            prepared_refused=prepared_refused,
            **{name: _known(numbers.get(name, none), none) for name, none in NOT_REPORTED.items()},
        )

    def _estimate(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Of an estimated state, and its standard deviations; nothing of another."""
        belief = self.driver.belief
        if belief is None:
            return (), ()
        deviation = np.sqrt(np.maximum(belief.covariance.diagonal(), 0.0))
        clipped = (one.clip(-_LARGEST, _LARGEST).tolist() for one in (belief.x, deviation))
        estimate, deviations = map(tuple, clipped)
        return estimate, deviations


def _finite(plan: Floats) -> tuple[float, ...]:
    """The plan row by row, for viewing: to six digits, which halves the size of a log.

    Nothing of it if any of it is no number (receivers would refuse it).
    """
    if not plan.size:
        return ()
    scaled = np.rint(plan.ravel() * _SCALE)
    if not np.maximum.reduce(np.abs(scaled)) <= _LARGEST * _SCALE:
        return ()
    return tuple((scaled / _SCALE).tolist())


def _known(number: float, none: float) -> Any:
    """A number that telemetry can have, or what it has in place of one that is not known."""
    known = 0.0 <= number <= _LARGEST_MEASURE if none < 0 else math.isfinite(number)
    return type(none)(number) if known else none
