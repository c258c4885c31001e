"""A shadow: a second controller beside the one that drives, whose inputs are recorded and never
reach the car.

It answers each actuation of the controller that drives, once it has the state that this answers: by
that state, for the plant time of that decision, and with the other's inputs on their way, not its
own. So each decision begins where the car really is. The driving controller does not notice it: a
shadow has no token, serves no requests, and sends on keys of its own.
"""

import logging
import os
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Final

from bayesrace.controller.cycle import Cycle
from bayesrace.controller.interface import Controller
from bayesrace.controller.process_settings import ControllerSettings
from bayesrace.messages import (
    ACTUATION,
    SHADOW_ACTUATION,
    SHADOW_TELEMETRY,
    STATE,
    Actuation,
    State,
)
from bayesrace.processes import die_with_parent
from bayesrace.realtime import prepare_thread
from bayesrace.transport import (
    HEARTBEAT_S,
    NEWEST,
    Inbox,
    Kind,
    Publisher,
    open_sessions,
    unlinked,
)

__all__ = ["ShadowProcess", "main"]

_log = logging.getLogger("bayesrace.shadow")

_SILENT_S: Final = 1.0
"""As of the controller process: after so long without a message any run may follow."""
_WAITING: Final = 64
"""Inputs that wait for their states at most."""
_NICE: Final = 10
"""Of the process, below the controller that drives."""


class ShadowProcess:
    """Decides beside the controller of one car, over an open session."""

    def __init__(self, session: Any, settings: ControllerSettings, controller: Controller) -> None:
        self._settings = settings
        self.name = settings.name or settings.car.name
        self._cycle = Cycle(controller, settings.car, settings)
        self._driver, self._timing = self._cycle.driver, self._cycle.timing
        self._actuations = Publisher(session, SHADOW_ACTUATION, self.name, settings.shadow)
        self._telemetry = Publisher(session, SHADOW_TELEMETRY, self.name, settings.shadow)
        self.inbox = Inbox(session, self.name)
        self._decoders = [self.inbox.subscribe(one, newest=NEWEST) for one in (STATE, ACTUATION)]
        self._states: deque[tuple[State, int]] = deque(maxlen=NEWEST)
        """That no input has answered yet, with the times of their arrival."""
        self._sent: deque[Actuation] = deque()
        """Inputs of the controller that drives, whose states have not come yet."""
        self._newest_ns = 0
        self._session, self._linked = session, False
        self.answered = 0
        self.unanswered = 0
        """Inputs whose states have not come, or are not to be driven on."""

    def serve(self, renewed: Callable[[], Any] = lambda: None) -> None:
        """Until SIGINT or SIGTERM; ``renewed``: :meth:`.Sessions.renewed`, between runs."""
        while (item := self.inbox.get(HEARTBEAT_S)) is None or item.kind is not Kind.SIGNAL:
            if item is None:
                self._rest(renewed)
                continue
            self._newest_ns = item.received_ns
            if isinstance(item.value, State):
                self._states.append((item.value, item.received_ns))
            elif isinstance(item.value, Actuation):
                self._sent.append(item.value)
            while self._sent and self._follow(self._sent[0]):
                self._sent.popleft()

    def _rest(self, renewed: Callable[[], Any]) -> None:
        if not self._linked and not unlinked(self._session, self._settings.endpoints):
            self._linked = True
            _log.info("shadow '%s' has its links", self._settings.shadow)
        for decoder in self._decoders:
            decoder.report(_log)
        if time.monotonic_ns() - self._newest_ns < _SILENT_S * 1e9:
            return
        while self._states:  # the final one, or those that no controller answers
            self._observe(*self._states.popleft())
        self._driver.lost(silent=True)
        if (session := renewed()) is not None:
            self._session = session
            for one in (self._actuations, self._telemetry, self.inbox):
                one.bind(session)

    def _follow(self, actuation: Actuation) -> bool:
        """Answers an input of the controller, or gives it up; False: its state may still come."""
        wanted = actuation.epoch, actuation.state_seq
        waiting = [(one.epoch, one.seq) for one, _ in self._states]
        if wanted in waiting:
            for _ in range(waiting.index(wanted) + 1):
                self._observe(*self._states.popleft())
        newest = self._driver.newest
        here = newest is not None and (newest.epoch, newest.seq) == wanted
        if newest is not None and here:
            self._answer(newest, actuation)
            self.answered += 1
        elif len(self._sent) <= _WAITING and not self._passed(wanted, waiting):
            return False
        else:
            self.unanswered += 1
        self._driver.sent(actuation.decided_at_s, actuation.u)
        if newest is not None and here:
            self._prepare(newest)
        return True

    def _passed(self, wanted: tuple[int, int], waiting: list[tuple[int, int]]) -> bool:
        """Whether a later state of that plant is there, or that very one has been refused."""
        newest = self._driver.newest
        known = waiting if newest is None else [*waiting, (newest.epoch, newest.seq)]
        return any(epoch == wanted[0] and seq >= wanted[1] for epoch, seq in known)

    def _observe(self, state: State, received_ns: int) -> None:
        self._timing.received_ns = received_ns
        self._driver.observe(state)
        if state.final:
            self._driver.lost(silent=False)
            _log.info(
                "run %d is over; since the start %d inputs answered, %d not, %d states lost",
                state.run, self.answered, self.unanswered, self._driver.numbering.lost,
            )  # fmt: skip

    def _answer(self, state: State, actuation: Actuation) -> None:
        timing, lockstep = self._timing, state.lockstep
        timing.released_ns = time.monotonic_ns()
        decision = self._cycle.decide(actuation.decided_at_s, self._budget_s(state))
        timing.missed = not lockstep and self._spent_s > 1 / self._settings.rate_hz
        answer = self._cycle.actuation(self._actuations.next_seq, state, decision)
        self._actuations.put(answer, lockstep=lockstep)
        report = self._cycle.telemetry(
            self._telemetry.next_seq, state, decision, timing.received_ns
        )
        self._telemetry.put(report, lockstep=lockstep)

    def _prepare(self, state: State) -> None:
        budget_s = self._budget_s(state)
        left_s = budget_s - self._spent_s if budget_s else 0.0
        if left_s >= 0:
            self._cycle.prepare(self._driver.interval_s, left_s)

    def _budget_s(self, state: State) -> float:
        """As of the controller process: none in lockstep."""
        return 0.0 if state.lockstep else self._settings.budget / self._settings.rate_hz

    @property
    def _spent_s(self) -> float:
        return (time.monotonic_ns() - self._timing.released_ns) * 1e-9


def main(settings: ControllerSettings, controller: Controller) -> int:
    """Decide beside the controller that drives until SIGINT or SIGTERM; returns the exit code.
    Raises InputError at a bad start.

    Call it from the main thread of a process: it takes over the signals.
    """
    die_with_parent(settings.parent_pid)
    settings.endpoints.check_car(settings.name or settings.car.name)
    with open_sessions(settings.endpoints, "shadow") as sessions:
        process = ShadowProcess(sessions.current, settings, controller)
        os.nice(_NICE)
        for refusal in prepare_thread(settings.realtime):
            _log.warning("%s", refusal)
        _log.info("shadow '%s' of the controller of car '%s'", settings.shadow, process.name)
        with process.inbox.receive_signals():
            process.serve(sessions.renewed)
    return 0
