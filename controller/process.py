"""The controller process: a fixed-rate loop in real time, an answer to each state in lockstep.

In real time the loop keeps its rate whatever arrives: it wakes shortly before a release,
looks for the state that is due, steps, sends, and does everything else (telemetry, requests,
heartbeat, preparation of the next step) in the time that is left. Where the state has not come in
time, it looks for it after that cycle, and answers it by a second one. It writes nothing to disk,
waits for no other process and logs nothing while it drives.
"""

import gc
import logging
import sys
from collections.abc import Callable
from functools import partial
from typing import Any, Final

from bayesrace import clock
from bayesrace.controller.cycle import Cycle
from bayesrace.controller.driver import Decision
from bayesrace.controller.interface import Controller, Environment
from bayesrace.controller.process_settings import ControllerSettings
from bayesrace.controller.schedule import Schedule
from bayesrace.controller.service import Service
from bayesrace.controller.weights.adoption import Adoption
from bayesrace.controller.weights.manager import WeightUpdateManager
from bayesrace.messages import (
    ACTUATION,
    BRAKING,
    STATE,
    TELEMETRY,
    Actuation,
    Scalar,
    State,
    decode,
    encode,
)
from bayesrace.processes import die_with_parent
from bayesrace.realtime import prepare_thread
from bayesrace.transport import (
    HEARTBEAT_S,
    LOCKSTEP_SPIN_S,
    NEWEST,
    POLL_S,
    Inbox,
    Item,
    Kind,
    Publisher,
    open_sessions,
)

__all__ = ["ControllerProcess", "ControllerSettings", "main"]

_log = logging.getLogger("bayesrace.controller")

_SILENT_S: Final = 1.0
"""Without a state for this long the controller waits for a plant and sends no more."""

_LEAD: Final = 0.1
"""How long before a release the loop wakes to look for the state (fraction of the period) ..."""
_LEAD_NS: Final = 300_000
"""... and at most: wake-up error and jitter of the arrival."""

_REHEARSAL_NS: Final = 700_000
"""How much sooner it wakes to rehearse a cycle: as long as one takes when everything is cold."""
_COLD_NS: Final = 5_000_000
"""Periods from which on caches are cold at each release; at higher rates there is no rehearsal."""

_WAY: Final = 0.05
"""How long after a cycle the preparation begins (fraction of the period): the threads that take the
actuation to the plant need the CPU first ..."""
_WAY_NS: Final = 1_000_000
"""... and at most."""

_ROOM: Final = 2.0
"""Time that a late cycle must still have within the budget, in times of the cycle before it. It
takes longer than that one: no preparation has gone before."""

_SERVE_NS: Final = 40_000_000
"""Between two requests that are served while driving: each takes as long as a cycle, and a
flood of requests must not hold up the loop."""

_BRAKING_NS: Final = 15_000_000
"""Between two braking plans: one a stage is enough, and takes as long as several steps."""

_SWITCH_S: Final = 1e-4


class ControllerProcess:
    """Drives one car over an open session."""

    def __init__(self, session: Any, settings: ControllerSettings, controller: Controller) -> None:
        self._settings = settings
        self.name = settings.name or settings.car.name
        self._cycle = Cycle(controller, settings.car, settings)
        self._driver, self._timing = self._cycle.driver, self._cycle.timing
        self._actuations = Publisher(session, ACTUATION, self.name)
        self._telemetry = Publisher(session, TELEMETRY, self.name)
        self._braking = Publisher(session, BRAKING, self.name)
        self._schedule = Schedule(settings.rate_hz)
        self._arrived_ns = 0
        self._serve_ns = 0
        """When the next request may be served."""
        self._reported = False
        inbox = self.inbox = Inbox(session, self.name)
        self._decoder = inbox.subscribe(STATE, newest=NEWEST)
        self._service = Service(
            session, inbox, self.name, settings.rate_hz, self._driver, self._counters,
            partial(inbox.presence, settings.endpoints, "plant"),
        )  # fmt: skip
        self._weights: WeightUpdateManager | None = None
        self._adoption: Adoption | None = None
        if controller.port is not None:
            self._adoption = Adoption(controller.port, settings.gate)
            self._service.weights = self._weights = WeightUpdateManager(
                session, self.name, controller.port, self._adoption, settings.gate,
                self._service.announce,
            )  # fmt: skip
        inbox.watch("plant")
        inbox.announce("controller")
        if self._weights is not None:
            self._weights.start()  # last: what fails before leaves no thread behind

    def close(self) -> None:
        """Ends what the process has started."""
        if self._weights is not None:
            self._weights.stop()

    def serve(self, renewed: Callable[[], Any] = lambda: None) -> None:
        """Until SIGINT or SIGTERM; ``renewed``: :meth:`.Sessions.renewed`, between runs."""
        state: State | None = None
        while not self._service.stopping:
            if self._silent():
                self._renew(renewed)
            self._service.check_hold()
            if state is None or state.final:
                state = self._wait()
            elif state.lockstep:
                state = self._lockstep(state)
            else:
                state = self._free_running(state)

    def _renew(self, renewed: Callable[[], Any]) -> None:
        if (session := self._service.renew(renewed)) is not None:
            if self._weights is not None:
                self._weights.bind(session)
            for one in (self._actuations, self._telemetry, self._braking, self.inbox):
                one.bind(session)  # the inbox last: it announces the process

    # Waiting -----------------------------------------------------------------------------------

    def _wait(self) -> State | None:
        """Waits a little for a first state; serves whatever else happens, and logs it."""
        self._service.beat()
        item = self.inbox.get(HEARTBEAT_S)
        if self._adoption is not None:
            self._adoption.between_cycles(self._next_cycle)
        if item is None and (left := self._left_over()) is not None:
            return left
        if item is None:
            self._decoder.report(_log)
            if not self._service.plant_there and not self._reported:
                _log.warning("the plant vanished: killed or unreachable; waiting for it")
            self._reported = not self._service.plant_there
            return None
        return self._take(item)

    def _take(self, item: Item) -> State | None:
        """The item's state if it is a new one to be driven on; other items are served."""
        if item.kind is not Kind.MESSAGE:
            self._service.react(item)
            return None
        self._timing.decode_us = (clock.monotonic_ns() - item.received_ns) * 1e-3
        if item.value is None or not self._driver.observe(item.value):
            return None
        return self._recorded(item.value, item.received_ns)

    def _recorded(self, state: State, arrived_ns: int) -> State:
        self._service.report_fault()
        if self._adoption is not None and not self._driver.doubted:
            self._adoption.observe(self._driver.vx_mps, self._driver.fallen_back)
        self._arrived_ns = self._service.arrived_ns = arrived_ns
        return state

    def _silent(self) -> bool:
        return clock.monotonic_ns() - self._arrived_ns > _SILENT_S * 1e9

    def _left_over(self) -> State | None:
        """After silence: a state that was not driven on, to which its plant may want an answer."""
        left = self._driver.lost(silent=True) if self._silent() else None
        if left is None or not self._driver.observe(left):
            return None
        return self._recorded(left, clock.monotonic_ns())

    def _leave(self, state: State | None) -> State | None:
        """Ends a loop, for want of states or with one that is not for it: the next one to drive."""
        self._driver.lost(silent=False)
        gc.collect()
        return state or self._left_over()

    # Lockstep ----------------------------------------------------------------------------------

    def _lockstep(self, first: State) -> State | None:
        """Answers each state, until one comes that is not to be answered so, or none any more."""
        inbox, timing = self.inbox, self._timing
        inbox.spin_s = LOCKSTEP_SPIN_S
        timing.wake_us = 0.0
        state: State | None = first
        while not self._service.stopping:
            if state is not None:
                if state.final or not state.lockstep:
                    break
                self._cycle.answer(state, self._send_in_lockstep, self._limits())
            elif self._silent() or not self._service.plant_there:
                break
            self._service.beat()
            item = inbox.get(HEARTBEAT_S)
            state = None if item is None else self._take(item)
        inbox.spin_s = 0.0
        return self._leave(state)

    def _send_in_lockstep(self, state: State, decision: Decision) -> None:
        """The cycle's messages; new weights are adopted before the next cycle is prepared."""
        self._send(state, decision)
        if self._adoption is not None:
            self._adoption.between_cycles(self._next_cycle)

    # Free-running ------------------------------------------------------------------------------

    def _free_running(self, first: State) -> State | None:
        """Keeps the rate, until a state comes that is not to be driven on, or none for long."""
        schedule = self._schedule
        schedule.start(self._arrived_ns)
        schedule.observe(self._arrived_ns, self._driver.time_s, 0.0)
        self._timing.wake_us = 0.0
        state, fresh, late = first, True, False
        while not self._service.stopping:
            if fresh and (state.final or state.lockstep):
                break
            if self._silent():
                fresh = False
                break
            self._tick(state, late)
            self._serve_others()
            newer = self._late_state()
            late = newer is not None
            if not late:
                self._prepare()
                self._timing.skipped += schedule.advance(clock.monotonic_ns())
                newer = self._next_state()
            fresh = newer is not None
            state = newer or state
        return self._leave(state if fresh else None)

    def _tick(self, state: State, late: bool) -> None:
        """One cycle: decide, send, report; ``late``: a further one after the same release."""
        schedule, timing = self._schedule, self._timing
        timing.released_ns = clock.monotonic_ns()
        if late:
            timing.late_states += 1
            timing.wake_us = timing.prepare_us = 0.0
        budget_s = self._settings.budget * schedule.period_ns * 1e-9
        # What has held up a state on its way is part of its age: hence the schedule's plant time,
        # not the time since this state's own arrival.
        decided_at_s = max(schedule.plant_time_s(timing.released_ns), self._driver.time_s)
        spent_s = (clock.monotonic_ns() - schedule.release_ns) * 1e-9
        limits = self._limits()
        decision = self._cycle.decide(decided_at_s, budget_s, spent_s, limits)
        timing.overruns += clock.monotonic_ns() > self._budget_end_ns
        self._send(state, decision)

    def _serve_others(self) -> None:
        """What has happened meanwhile."""
        if min(self._budget_end_ns, clock.monotonic_ns()) >= self._serve_ns:
            item = self.inbox.poll_queue()
            if item is not None:
                self._serve_ns = clock.monotonic_ns() + _SERVE_NS
                self._service.react(item)
        self._service.check_hold()
        self._service.beat()

    def _late_state(self) -> State | None:
        """The state that was due at this release, if it comes while another cycle still fits.

        Not where several are missing: one of them says little, and a plant that has fallen behind
        needs the CPU to catch up.
        """
        if self._missing() != 1:
            return None
        spent_ns = clock.monotonic_ns() - self._timing.released_ns
        latest_ns = self._budget_end_ns - round(_ROOM * spent_ns)
        while clock.monotonic_ns() < latest_ns:
            if (late := self._newest_state(0)) is not None:
                return late
            clock.sleep(POLL_S)
        return None

    def _prepare(self) -> None:
        """New weights; after a pause (:data:`_WAY`) the preparation of the next cycle, in what is
        left of the budget."""
        if self._adoption is not None:
            self._adoption.between_cycles(self._next_cycle)
        pause_s = min(_WAY * self._schedule.period_ns, _WAY_NS) * 1e-9
        if self._left_s > pause_s:
            clock.sleep(pause_s)
        self._plan_braking()
        if (left_s := self._left_s) > 0:
            until_next_ns = self._schedule.deadline_ns - self._timing.released_ns
            self._cycle.prepare(until_next_ns * 1e-9, left_s)

    def _plan_braking(self) -> None:
        """Sends what the car's guard shall do if nothing more comes."""
        sent_ns = self._braking.sent_ns
        due = sent_ns is None or clock.monotonic_ns() - sent_ns > _BRAKING_NS
        if due and (plan := self._driver.braking(self._braking.next_seq)) is not None:
            self._braking.put(plan, lockstep=False)

    def _next_state(self) -> State | None:
        """Sleeps until shortly before the release, then looks for the state that is due."""
        schedule, period_ns = self._schedule, self._schedule.period_ns
        rehearses = period_ns >= _COLD_NS
        wake_ns = schedule.release_ns - min(round(_LEAD * period_ns), _LEAD_NS)
        wake_ns -= _REHEARSAL_NS if rehearses else 0
        clock.sleep_until_ns(wake_ns)
        self._timing.wake_us = max(clock.monotonic_ns() - wake_ns, 0) * 1e-3
        if rehearses:
            self._rehearse()
        return self._newest_state(
            schedule.window_end_ns if self._missing() else schedule.release_ns
        )

    def _newest_state(self, until_ns: int) -> State | None:
        """The newest state that is there, or comes until then; the one that is due is waited for
        even if an older one is there."""
        fresh: State | None = None
        newest = self._driver.newest
        run = newest.run if newest is not None else None
        for _ in range(NEWEST):  # what came while the loop was held up, but no flood
            waits = fresh is None or self._missing() == 1
            item = self.inbox.poll(until_ns if waits else 0)
            if item is None:
                break
            fresh = self._take(item) or fresh
        if fresh is not None:
            if fresh.run != run:
                self._schedule.start(self._arrived_ns)
            self._schedule.observe(self._arrived_ns, self._driver.time_s, self._driver.interval_s)
        return fresh

    def _rehearse(self) -> None:
        """Uses what the cycle will use, without effect.

        After 20 ms of other work the code and data of a cycle are cold, and everything in it takes
        two to four times as long (docs/decisions/).
        """
        state = self._driver.newest
        if state is not None:
            decode(State, encode(state))
            self._driver.rehearse()
            encode(self._actuation(state, self._driver.decision))

    def _missing(self) -> int:
        """How many states that have not come yet are due by the release."""
        driver = self._driver
        if driver.newest is None:
            return 0
        return self._schedule.missing(driver.time_s, driver.interval_s)

    @property
    def _left_s(self) -> float:
        """Of the budget."""
        return (self._budget_end_ns - clock.monotonic_ns()) * 1e-9

    @property
    def _budget_end_ns(self) -> int:
        """When the budget of the cycles after this release is used up."""
        return self._schedule.release_ns + round(self._settings.budget * self._schedule.period_ns)

    # Both --------------------------------------------------------------------------------------

    def _send(self, state: State, decision: Decision) -> None:
        """The actuation, then how it came about."""
        timing = self._timing
        begin_ns = clock.perf_counter_ns()
        self._actuations.put(self._actuation(state, decision), lockstep=state.lockstep)
        timing.encode_us = (clock.perf_counter_ns() - begin_ns) * 1e-3
        late = clock.monotonic_ns() > self._schedule.deadline_ns
        timing.missed = late and not state.lockstep
        timing.misses += timing.missed
        message = self._cycle.telemetry(self._telemetry.next_seq, state, decision, self._arrived_ns)
        self._telemetry.put(message, lockstep=state.lockstep)

    def _limits(self) -> Environment | None:
        """What limits the car in this cycle."""
        return None if self._adoption is None else self._adoption.limits(self._driver.vx_mps)

    def _actuation(self, state: State, decision: Decision) -> Actuation:
        return self._cycle.actuation(self._actuations.next_seq, state, decision)

    @property
    def _next_cycle(self) -> int:
        """``tick`` of the next release's cycle, unless it is passed over."""
        return self._timing.tick + 1

    def _counters(self) -> dict[str, Scalar]:
        """What the loop has counted, by name."""
        timing, driver = self._timing, self._driver
        return {
            "ticks": timing.ticks,
            "skipped": timing.skipped,
            "deadline_misses": timing.misses,
            "overruns": timing.overruns,
            "late_states": timing.late_states,
            "states_received": driver.numbering.received,
            "states_lost": driver.numbering.lost,
            "states_stale": driver.count("stale"),
            "states_foreign": driver.count("foreign"),
            "readings_left_out": driver.readings_left_out,
            "refused": self._decoder.refused + self._service.hold.decoder.refused,
            "overflowed": self.inbox.overflowed,
            "requests_rejected": self.inbox.requests_rejected,
            "actuations_sent": self._actuations.next_seq,
        }


def main(settings: ControllerSettings, controller: Controller) -> int:
    """Drive until SIGINT or SIGTERM; returns the exit code. Raises InputError at a bad start.

    Call it from the main thread of a process: it takes over the signals.
    """
    die_with_parent(settings.parent_pid)
    settings.endpoints.check_car(settings.name or settings.car.name)
    with open_sessions(settings.endpoints, "controller") as sessions:
        process = ControllerProcess(sessions.current, settings, controller)
        # The control thread gets the interpreter's lock back from another thread this soon.
        sys.setswitchinterval(_SWITCH_S)
        try:
            for refusal in prepare_thread(settings.realtime):
                _log.warning("%s", refusal)
            _log.info(
                "controller of car '%s', plant at %s",
                process.name,
                ", ".join(settings.endpoints.connect) or "(connects to us)",
            )
            with process.inbox.receive_signals():
                process.serve(sessions.renewed)
        finally:
            process.close()
    return 0
