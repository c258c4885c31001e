"""The controller process: answers each state with an actuation; everything else comes between.

The loop is the same in lockstep and free-running mode: take the newest state, step, send the
actuation, then the telemetry. Between two cycles it takes over weights and answers for its status.
It writes nothing to disk and logs nothing while it drives.
"""

import gc
import logging
import math
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from bayesrace.clock import die_with_parent, pin_to_cpu, quiet_garbage_collector
from bayesrace.errors import InputError
from bayesrace.messages import (
    ACTUATION,
    EVENT,
    STATE,
    STATUS,
    TELEMETRY,
    WEIGHTS,
    Actuation,
    Decoder,
    Event,
    Reply,
    Scalar,
    State,
    Status,
    Telemetry,
)
from bayesrace.transport import (
    CONTROLLER_ENDPOINT,
    LOCKSTEP_SPIN_S,
    PLANT_ENDPOINT,
    Endpoints,
    Inbox,
    Item,
    Kind,
    Publisher,
    Request,
    open_session,
)
from bayesrace.vehicles.parameters import get_car
from controller.fallback import Fallback, FallbackSettings, Level
from controller.interface import Controller, StepOutput

__all__ = ["ControllerProcess", "ControllerSettings", "main"]

_log = logging.getLogger("bayesrace.controller")

_STEP_RAISED = 255
"""Status of a cycle whose step raised an exception."""


class ControllerSettings(BaseModel):
    """How a controller process is started; what it drives is made by the caller."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    car: str = Field(default="orca", description="car whose limits hold")
    name: str = Field(default="", description="name in message keys; the car's own if empty")
    endpoints: Endpoints = Endpoints(listen=(CONTROLLER_ENDPOINT,), connect=(PLANT_ENDPOINT,))
    fallback: FallbackSettings = FallbackSettings()
    stale_s: float = Field(
        default=0.5, gt=0, le=60, description="without a state for this long it counts as waiting"
    )
    cpu: int | None = Field(default=None, ge=0, description="CPU to bind to")
    parent_pid: int | None = Field(None, description="end when this process, the parent, ends")


class ControllerProcess:
    """Drives one car over an open session."""

    def __init__(self, session: Any, settings: ControllerSettings, controller: Controller) -> None:
        self._settings = settings
        self._controller = controller
        self.name = settings.name or settings.car
        self._fallback = Fallback(get_car(settings.car), settings.fallback)
        self._decoder: Decoder[State] = Decoder(State)
        self._actuations = Publisher(session, ACTUATION, self.name)
        self._telemetry = Publisher(session, TELEMETRY, self.name)
        self._events = Publisher(session, EVENT, self.name, "controller")
        self._x = np.zeros(7)
        self._u_previous = np.zeros(2)
        self._run: int | None = None
        self._phase = "waiting"
        self._text = "waiting for the plant"
        self._skipped = self._raised = self._weights_taken = self._weights_refused = 0
        self._stopping = False
        inbox = self.inbox = Inbox(session, self.name)
        inbox.subscribe(STATE)
        inbox.serve(STATUS, "controller")
        inbox.serve(WEIGHTS)
        inbox.watch("plant")
        inbox.announce("controller")

    def serve(self) -> None:
        """Until SIGINT or SIGTERM."""
        while not self._stopping:
            newest = self._newest_state()
            if newest is not None:
                self._cycle(newest)

    def _newest_state(self) -> State | None:
        """Waits for something to happen; the last state of all that has, if there is one."""
        item = self.inbox.get(self._settings.stale_s)
        if item is None:
            self._decoder.report(_log)
            if self._phase != "waiting":
                self._phase = "waiting"
                gc.collect()
            return None
        data: bytes | None = None
        while item is not None:
            if item.kind is Kind.MESSAGE:
                if data is not None:
                    self._skipped += 1
                data = item.value
            else:
                self._react(item)
            item = self.inbox.get()
        return None if data is None or self._stopping else self._decoder(data)

    def _cycle(self, state: State) -> None:
        controller, fallback = self._controller, self._fallback
        if state.run != self._run:
            self._run = state.run
            self.inbox.spin_s = LOCKSTEP_SPIN_S if state.lockstep else 0.0
            fallback.reset()
            controller.reset(state)
        self._x[:] = state.x
        self._u_previous[:] = state.u_applied
        begin_ns = time.perf_counter_ns()
        try:
            output: StepOutput | None = controller.step(self._x, self._u_previous)
        except Exception as error:
            # Whatever it is, the car must not be left without an answer.
            output = None
            self._raised += 1
            self._text = f"the step raised {type(error).__name__}: {error}"
        solve_us = (time.perf_counter_ns() - begin_ns) * 1e-3
        d, rate, level = fallback.decide(output, state.x[3])
        status = _STEP_RAISED if output is None else output.status
        self._actuations.put(
            Actuation(
                self._actuations.next_seq,
                time.monotonic_ns(),
                state.run,
                state.seq,
                (d, rate),
                controller.weights_version,
                status,
            ),
            lockstep=state.lockstep,
        )
        self._phase = "driving" if level is Level.SOLUTION else "fallback"
        self._report(state, output, status, level, solve_us)

    def _report(
        self, state: State, output: StepOutput | None, status: int, level: Level, solve_us: float
    ) -> None:
        """Telemetry, after the actuation is on its way."""
        if output is None:
            output = StepOutput(u=self._u_previous)
        self._telemetry.put(
            Telemetry(
                self._telemetry.next_seq,
                time.monotonic_ns(),
                state.run,
                state.seq,
                status,
                int(level),
                output.iterations,
                output.solve_us or solve_us,
                _finite(output.plan_x),
                _finite(output.plan_u),
                _known(output.residual_dynamics),
                _known(output.residual_bounds),
                _known(output.residual_stationarity),
                output.s_ref_m if math.isfinite(output.s_ref_m) else 0.0,
                output.n_ref_m if math.isfinite(output.n_ref_m) else 0.0,
            ),
            lockstep=state.lockstep,
        )

    def _react(self, item: Item) -> None:
        if item.kind is Kind.SIGNAL:
            self._stopping = True
        elif item.kind is Kind.GONE:
            self._run = None  # a plant that comes back begins its run numbers anew
            self._phase, self._text = "waiting", "the plant vanished: killed or unreachable"
            _log.warning("%s; waiting for it", self._text)
        elif item.kind is Kind.ALIVE:
            self._text = "the plant is there"
        elif item.kind is Kind.REQUEST:
            self._serve(item.value)

    def _serve(self, request: Request) -> None:
        if request.service is STATUS:
            request.answer(self._status())
        else:
            request.answer(self._take_weights(request.payload))

    def _take_weights(self, data: bytes) -> Reply:
        data_map: dict[str, Scalar] = {}
        try:
            version = self._controller.set_weights(data)
        except InputError as error:
            self._weights_refused += 1
            accepted, text = False, str(error)[:2000]
        else:
            self._weights_taken += 1
            accepted, text = True, f"weights {version} in use from the next step on"
            data_map["version"] = version
        self._publish_event("weights_accepted" if accepted else "weights_refused", text, data_map)
        return Reply(0, time.monotonic_ns(), accepted, text, data_map)

    def _publish_event(self, kind: str, text: str, data: Mapping[str, Scalar]) -> None:
        now_ns = time.monotonic_ns()
        seq = self._events.next_seq
        event = Event(seq, now_ns, self._run or 0, "controller", kind, text, data)
        self._events.put(event, lockstep=True)

    def _status(self) -> Status:
        counts = self._fallback.counts
        counters: dict[str, Scalar] = {
            "cycles": sum(counts),
            "solution": counts[Level.SOLUTION],
            "shifted_plan": counts[Level.SHIFTED_PLAN],
            "brake": counts[Level.BRAKE],
            "stop": counts[Level.STOP],
            "raised": self._raised,
            "skipped": self._skipped,
            "refused": self._decoder.refused,
            "overflowed": self.inbox.overflowed,
            "weights_taken": self._weights_taken,
            "weights_refused": self._weights_refused,
        }
        return Status(
            0,
            time.monotonic_ns(),
            "controller",
            self._phase,
            self._run or 0,
            self._text[:2000],
            self._controller.weights_version,
            counters,
        )


def _finite(plan: Any) -> tuple[float, ...]:
    """The plan row by row; nothing of it if any of it is no number (receivers would refuse it)."""
    if not len(plan):
        return ()
    flat = np.asarray(plan, dtype=np.float64).ravel()
    if not (np.abs(flat) <= 1e6).all():
        return ()
    return tuple(flat.tolist())


def _known(residual: float) -> float:
    return float(residual) if 0.0 <= residual <= 1e12 else -1.0


def main(settings: ControllerSettings, controller: Controller) -> int:
    """Drive until SIGINT or SIGTERM; returns the exit code. Raises InputError at a bad start.

    Call it from the main thread of a process: it takes over the signals.
    """
    die_with_parent(settings.parent_pid)
    if refusal := pin_to_cpu(settings.cpu):
        _log.warning("%s", refusal)
    with open_session(settings.endpoints) as session:
        process = ControllerProcess(session, settings, controller)
        quiet_garbage_collector()
        _log.info(
            "controller of car '%s', plant at %s",
            process.name,
            ", ".join(settings.endpoints.connect) or "(connects to us)",
        )
        with process.inbox.catching_signals():
            process.serve()
    return 0
