"""From states to inputs: stop and go, delay compensation, the step, the fallback. No input/output.

The process around it knows messages and clocks; this knows what is to be driven. Times are the
plant's unless they say otherwise, so lockstep and free-running mode are the same here.
"""

import math
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from bayesrace.errors import InputError
from bayesrace.messages import State
from bayesrace.vehicles.parameters import CarParameters
from controller.compensation import CompensationSettings, DelayCompensator
from controller.fallback import Fallback, FallbackSettings, Level
from controller.interface import Controller, StepOutput
from controller.states import StateStream

__all__ = ["HALTED", "NO_STATE", "STEP_RAISED", "UNPREDICTABLE", "Decision", "Driver", "Phase"]

STEP_RAISED = 255
"""Status of a cycle whose step raised an exception."""

NO_STATE = 254
"""Status of a cycle without a step: the newest state is too old."""

UNPREDICTABLE = 252
"""Status of a cycle without a step: the state cannot be predicted to the moment of acting."""

HALTED = 253
"""Status of a cycle without a step: the car is not to be driven."""

_JUMP, _JUMP_BY = 2.0, 0.01
"""A plan that costs more than so many times the one before, shifted, and so much more (m^2)."""

_LONGEST_S = 1.0
"""Longest piece of dead reckoning."""


class Phase(StrEnum):
    """Life cycle of a controller."""

    WAITING = "waiting"
    """For a state."""
    READY = "ready"
    """States arrive; go has not been said."""
    DRIVING = "driving"
    FALLBACK = "fallback"
    STOPPED = "stopped"
    """Stop has been said: the car brakes to standstill, and stays."""


@dataclass(slots=True)
class Decision:
    """What one cycle sends; overwritten by the next."""

    d: float = 0.0
    delta_rate: float = 0.0
    level: Level = Level.STOP
    status: int = HALTED
    basis_s: float = 0.0
    """Plant time up to which the state is known."""
    delay_s: float = 0.0
    """Prediction from there to the moment of acting."""
    output: StepOutput | None = None
    """Of the step, if one was made."""


class Driver:
    """Drives one car with one controller; for one thread."""

    def __init__(
        self,
        controller: Controller,
        car: CarParameters,
        fallback: FallbackSettings,
        compensation: CompensationSettings,
        stale_s: float,
        hold: bool = False,
    ) -> None:
        """``stale_s``: age from which a state is no longer predicted forward but fallen back
        from. ``hold``: wait for :meth:`go`."""
        self._controller = controller
        self._fallback = Fallback(car, fallback)
        self._compensation = DelayCompensator(compensation, controller.predict)
        self._stale_s = stale_s
        self._tuning = car.tuning.driving
        self._stopping_from: tuple[float, float] | None = None
        self.decision = Decision()
        """Of the newest cycle."""
        self._stepped_s: float | None = None
        self._vx_mps = 0.0
        self._standing = False
        self._reckoned = np.zeros(7)
        self._reckoned_s: float | None = None
        self._u_sent = np.zeros(2)
        self.states = StateStream()
        self.phase = Phase.WAITING
        self._halted: Phase | None = Phase.READY if hold else None
        self.raised = 0
        """Steps that raised an exception."""
        self.last_error = ""
        self.second_starts = 0
        """Steps that looked for another plan beside the one that went on from before."""
        self.cost_jumps = 0
        """Steps whose plan costs much more than to go on with the one before."""

    @property
    def delay_s(self) -> float:
        """Delay that is compensated."""
        return self._compensation.delay_s

    @property
    def counts(self) -> list[int]:
        """Cycles so far by level of the fallback; those on command are not among them."""
        return self._fallback.counts

    @property
    def fallen_back(self) -> bool | None:
        """Whether the newest input was the fallback's for want of a solution; None: the car is
        not driven, or its state is not known."""
        decision = self.decision
        if self._standing or decision.status in (HALTED, NO_STATE):
            return None
        return decision.level is not Level.SOLUTION

    def stop(self) -> None:
        """From the next cycle on slow down along the line to standstill, and stay."""
        self._halted = Phase.STOPPED

    def go(self) -> None:
        """From the next cycle on drive."""
        self._halted = self._stopping_from = None
        self._controller.limit_speed(math.inf, 0.0)

    def lost(self, silent: bool) -> State | None:
        """The run is over, its plant has gone, or, ``silent``, nothing has come for long.

        Any other may follow, such as the state that is returned: see :meth:`StateStream.forget`.
        """
        self.phase = Phase.WAITING
        self.states.end()
        return self.states.forget() if silent else None

    def observe(self, state: State) -> bool:
        """Takes a state that has arrived; False if it is an old one."""
        before = self.states.newest
        if not self.states.accept(state):
            return False
        if before is None or (state.epoch, state.run) != (before.epoch, before.run):
            self._fallback.reset()
            self._compensation.reset()
            self._controller.reset(state)
            self._stepped_s = self._stopping_from = self._reckoned_s = None
        if not state.lockstep:
            self._compensation.observe(state)
        return True

    def decide(self, state: State, basis_s: float, budget_s: float = 0.0) -> Decision:
        """The input on the basis of plant time ``basis_s``, with ``state`` the newest one.

        ``budget_s``: how long the step may take; 0 is no limit but its own.
        """
        compensation, decision = self._compensation, self.decision
        decision.basis_s = basis_s
        decision.output = None
        decision.delay_s = 0.0 if state.lockstep else compensation.delay_s
        self._standing = self._halted is not None and not self._slowing(state, basis_s)
        if self._standing:
            return self._halt(state, decision)
        # Where states come seldom, the next one is no sooner to be had.
        if basis_s - state.time_s > max(self._stale_s, 2 * self.states.interval_s):
            decision.status = NO_STATE
            self._reckon(state, basis_s)
        else:
            self._reckoned_s = None
            self._vx_mps = float(state.x[3])
            self._step(state, budget_s)
        return decision

    def settle(self, late_s: float = 0.0) -> Decision:
        """Ends the cycle: what is sent after all, ``late_s`` after it should have been."""
        decision = self.decision
        time_s = decision.basis_s + decision.delay_s
        if not self._standing:
            chosen = self._fallback.decide(decision.output, self._vx_mps, time_s, late_s)
            decision.d, decision.delta_rate, decision.level = chosen
            driving = Phase.DRIVING if decision.level is Level.SOLUTION else Phase.FALLBACK
            self.phase = self._halted or driving
        self._compensation.sent(decision.basis_s, decision.d, decision.delta_rate)
        return decision

    def prepare(self, period_s: float, budget_s: float = 0.0) -> None:
        """Preparation phase for a state that is expected a period after the last one."""
        if self._stepped_s is not None and not self._standing:
            self._controller.prepare(period_s, budget_s)

    def rehearse(self) -> None:
        """Walks the way of a cycle without effect, so that its code and data are in the caches."""
        state = self.states.newest
        if self._stepped_s is None or self._standing or state is None:
            return
        with suppress(InputError):  # a state that cannot be predicted from
            self._compensation.at_acting(state, self.decision.basis_s)
        self._controller.rehearse()
        self._fallback.rehearse(self.decision.output)

    def _slowing(self, state: State, basis_s: float) -> bool:
        """Whether a stop on command is still under way; sets the speed that it has got to.

        Driven to standstill, the car stays on the line and points along it, fit to go on.
        """
        rolling = abs(state.x[3]) > self._tuning.standing_mps
        if self._stopping_from is None and not rolling:
            return False
        if self._stopping_from is None:  # just told, or a rolling car taken over on hold
            self._stopping_from = basis_s, max(float(state.x[3]), 0.0)
        since_s, speed_mps = self._stopping_from
        limit_mps = max(speed_mps - self._tuning.stop_mps2 * (basis_s - since_s), 0.0)
        self._controller.limit_speed(limit_mps, self._tuning.stop_mps2)
        if limit_mps > 0 or rolling:
            return True
        self._stopping_from = None
        return False

    def _halt(self, state: State, decision: Decision) -> Decision:
        """Not to be driven: braked. The next step will be the first of a new drive."""
        self.phase = self._halted or Phase.READY
        if self._stepped_s is not None:
            self._controller.reset(state)
            self._stepped_s = None
        time_s = decision.basis_s + decision.delay_s
        decision.d, decision.delta_rate = self._fallback.halt(float(state.x[3]), time_s)
        decision.level, decision.status = Level.STOP, HALTED
        return decision

    def _reckon(self, state: State, basis_s: float) -> None:
        """How fast the car may still be: by the model, braking since it was last seen.

        A duty cycle that brakes a rolling car drives a standing one backwards.
        """
        decision = self.decision
        self._u_sent[:] = decision.d, decision.delta_rate
        try:
            if self._reckoned_s is None:
                self._reckoned_s = state.time_s + self._stale_s
                self._reckoned[:], _ = self._compensation.at_acting(state, self._reckoned_s)
            duration_s = min(max(basis_s - self._reckoned_s, 0.0), _LONGEST_S)
            self._reckoned[:] = self._controller.predict(self._reckoned, self._u_sent, duration_s)
        except InputError:
            return  # what the model cannot follow: the speed stays the last one known
        self._reckoned_s = basis_s
        self._vx_mps = float(self._reckoned[3])

    def _step(self, state: State, budget_s: float) -> None:
        controller, decision = self._controller, self.decision
        if state.lockstep:
            x, u_previous = self._compensation.as_measured(state)
        else:
            try:
                x, u_previous = self._compensation.at_acting(state, decision.basis_s)
            except InputError:  # no model predicts from such a state
                decision.status = UNPREDICTABLE
                return
        time_s = decision.basis_s + decision.delay_s
        # Where the delay measured has fallen, the moment of acting may even go back.
        elapsed_s = 0.0 if self._stepped_s is None else max(time_s - self._stepped_s, 0.0)
        self._stepped_s = time_s
        try:
            output = controller.step(x, u_previous, elapsed_s, budget_s)
        except Exception as error:
            # Whatever it is, the car must not be left without an answer.
            self.raised += 1
            self.last_error = f"{type(error).__name__}: {error}"
            decision.status = STEP_RAISED
        else:
            decision.output, decision.status = output, output.status
            self.second_starts += output.second_start > 0
            if output.cost_shifted >= 0:
                self.cost_jumps += output.cost > _JUMP * output.cost_shifted + _JUMP_BY
