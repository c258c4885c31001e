"""The control cycle with its execution times, for the loops that carry the messages.

:mod:`controller.process` receives states and sends actuations over the network;
``operation.closed_loop`` does so by function calls. Both answer a lockstep state by
:meth:`Cycle.answer`, so their runs are equal to the bit.
"""

import time
from collections.abc import Callable

from bayesrace.messages import Actuation, State, Telemetry
from bayesrace.vehicles.parameters import CarParameters
from controller.driver import Decision, Driver
from controller.interface import Controller, Environment
from controller.process_settings import ControllerSettings
from controller.telemetry import Timing, telemetry_of

__all__ = ["Cycle"]


class Cycle:
    """Drives one car with one controller; for one thread."""

    def __init__(
        self, controller: Controller, car: CarParameters, settings: ControllerSettings
    ) -> None:
        """``car``: whose limits hold."""
        self.driver = Driver(
            controller,
            car,
            settings.fallback,
            settings.compensation,
            settings.stale_s,
            settings.hold,
            settings.sensor_tolerance,
        )
        self.timing = Timing()
        self._controller = controller

    def answer(
        self,
        state: State,
        send: Callable[[State, Decision], None],
        environment: Environment | None = None,
    ) -> None:
        """Answers a state of a lockstep run, then prepares for the next one."""
        self.timing.released_ns = time.monotonic_ns()
        send(state, self.decide(state.time_s, environment=environment))
        self.prepare(self.driver.interval_s, 0.0)

    def decide(
        self,
        decided_at_s: float,
        budget_s: float = 0.0,
        spent_s: float = 0.0,
        environment: Environment | None = None,
    ) -> Decision:
        """:meth:`Driver.decide`, timed."""
        begin_ns = time.perf_counter_ns()
        decision = self.driver.decide(decided_at_s, budget_s, spent_s, environment)
        self.timing.solve_us = (time.perf_counter_ns() - begin_ns) * 1e-3
        return decision

    def prepare(self, period_s: float, budget_s: float) -> None:
        """:meth:`Driver.prepare`, timed."""
        begin_ns = time.perf_counter_ns()
        self.driver.prepare(period_s, budget_s)
        self.timing.prepare_us = (time.perf_counter_ns() - begin_ns) * 1e-3

    def actuation(self, seq: int, state: State, decision: Decision) -> Actuation:
        """The message that answers ``state``."""
        return Actuation(
            seq=seq,
            source_time_ns=time.monotonic_ns(),
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
        self.timing.ticks += 1
        self.timing.received_ns = received_ns
        return telemetry_of(seq, state, decision, self.driver.output, self.timing)
