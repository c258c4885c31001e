"""Requests that a running controller serves: status, stop, go, new weights; and its heartbeat."""

import threading
from collections.abc import Callable, Mapping
from typing import Any, Final, Protocol

from bayesrace import clock
from bayesrace.controller.driver import Level, Phase
from bayesrace.controller.instruments import Instruments, Measured
from bayesrace.controller.weights.manager import WeightUpdateManager
from bayesrace.messages import (
    COMMAND,
    EVENT,
    ROLLBACK,
    STATUS,
    WEIGHTS,
    Event,
    Scalar,
    Status,
)
from bayesrace.transport import Heartbeat, Inbox, Item, Kind, Publisher, Request, decode_request
from bayesrace.transport.hold import HOLD_MISSING, HoldWatch

__all__ = ["Driven", "Service"]

_REMEDY: Final = "the car stops along the line; look at the sensors, then 'bayesrace go'"
_LEFT_OUT: Final = "the car drives on without it"


class Driven(Measured, Protocol):
    """What drives, here (:class:`.Driver`) or elsewhere (:class:`.RemoteDriver`)."""

    last_error: str
    controller: Any

    @property
    def phase(self) -> Phase:
        """Where in its life it is."""

    @property
    def levels(self) -> list[int]:
        """Cycles so far by level of the fallback."""

    @property
    def faults(self) -> dict[str, int]:
        """States so far by what speaks against them."""

    @property
    def fault(self) -> str:
        """What speaks against the newest state; empty: nothing."""

    @property
    def faulty(self) -> str:
        """The instrument that is not believed; empty: each is."""

    @property
    def fault_text(self) -> str:
        """The fault as a sentence."""

    @property
    def delay_s(self) -> float:
        """Delay that is compensated."""

    def count(self, name: str) -> int:
        """A count of the control cycle by its name."""

    def stop(self) -> None:
        """Slow down to standstill, and stay."""

    def go(self) -> None:
        """Drive."""


class Service:
    """Serves the inbox's other items between two cycles; for the control thread."""

    def __init__(
        self,
        session: Any,
        inbox: Inbox,
        name: str,
        rate_hz: float,
        driver: Driven,
        counters: Callable[[], Mapping[str, Scalar]],
        presence: Callable[[], Mapping[str, Any]],
    ) -> None:
        """``counters``: counts of the loop, for each status; ``presence``: as :class:`Inbox`'s."""
        self._rate_hz = rate_hz
        self._driver = driver
        self._controller = driver.controller
        self._instruments = Instruments(driver)
        self._counters = counters
        self._presence = presence
        self.weights: WeightUpdateManager | None = None
        """Serves requests about weights, where the controller takes any."""
        self._events = Publisher(session, EVENT, name, "controller", waits=False)
        self._heartbeat = Heartbeat(session, name, "controller")
        self.hold = HoldWatch(session, name)
        self._holds_lost = 0
        self._stopped = self._let_go = False
        """The car is stopped on request; for want of its director."""
        self._text = "waiting for the plant"
        self._publishing = threading.Lock()
        self._weights_refused = 0
        self._fault_reported = ("", "")
        self.stopping = False
        """The process has received a signal to end."""
        self.plant_there = True
        """Its liveliness token has not gone; without a token, its states show that it is there."""
        self.arrived_ns: int | None = None
        """Monotonic clock when the newest state arrived."""
        inbox.serve(STATUS, "controller")
        inbox.serve(COMMAND)
        if self._controller.port is None:
            inbox.serve(WEIGHTS)
            inbox.serve(ROLLBACK)

    def beat(self) -> None:
        """Publishes the status when it is due."""
        self._heartbeat.beat(self.status)

    def renew(self, renewed: Callable[[], Any]) -> Any:
        """The next session if there is one, see :meth:`.Sessions.renewed`; else None."""
        with self._publishing:  # nobody publishes while there is none
            if (session := renewed()) is not None:
                self._events.bind(session)
                self._heartbeat.bind(session)
                self.hold.bind(session)
        return session

    def report_fault(self) -> None:
        """Publishes that states are not believed any more, or are again."""
        fault, faulty = self._driver.fault, self._driver.faulty
        before, of = self._fault_reported
        if bool(fault) == bool(before) and faulty == of:
            return
        self._fault_reported = fault, faulty
        if fault:
            data = {"fault": fault, "instrument": faulty}
            self.announce("sensor_fault", f"{fault}: {self._driver.fault_text}", data)
        else:
            self.announce("sensor_recovered", "what is measured is believed again", {})

    def check_hold(self) -> None:
        """Stops the car of a held run whose director is missing: until ``go``, or another run."""
        newest, driver = self._driver.newest, self._driver
        if newest is None:
            return
        if (newest.epoch, newest.run) != self.hold.run:
            self.hold.follow((newest.epoch, newest.run))
            if self._let_go:
                driver.go()
                self._let_go, self._text = False, f"run {newest.run} has begun"
        elif self.hold.missing and self._drives:
            driver.stop()
            self._let_go = True
            self._holds_lost += 1
            self._text = f"stopped: {HOLD_MISSING}"
            self.announce("hold_lost", self._text, self._next_cycle)

    @property
    def _drives(self) -> bool:
        """Whether the car drives and no stop is requested. The phase alone would be late: that of
        a controller in another process changes only when the car stands."""
        stopped = self._stopped or self._let_go
        return self._driver.phase in (Phase.DRIVING, Phase.FALLBACK) and not stopped

    def react(self, item: Item) -> None:
        """Serves an item that is no message."""
        if item.kind is Kind.SIGNAL:
            self.stopping = True
        elif item.kind is Kind.GONE:
            self.plant_there = False
            self._text = "the plant vanished: killed or unreachable"
        elif item.kind is Kind.ALIVE:
            self.plant_there = True
            self._text = "the plant is there"
        elif item.kind is Kind.REQUEST:
            self._answer(item.value)

    def status(self, seq: int = 0) -> Status:
        """The process's state at this moment."""
        driver, newest = self._driver, self._driver.newest
        now_ns = clock.monotonic_ns()
        age_s = -1.0 if self.arrived_ns is None else (now_ns - self.arrived_ns) * 1e-9
        lockstep = newest is not None and newest.lockstep
        return Status(
            seq=seq,
            source_time_ns=now_ns,
            source="controller",
            phase=driver.phase.value,
            epoch=0 if newest is None else newest.epoch,
            run=0 if newest is None else newest.run,
            text=self._words()[:2000],
            weights_version=self._controller.weights_version,
            track=self._controller.track[:200],
            rate_hz=0.0 if lockstep else self._rate_hz,
            state_age_s=age_s,
            delay_s=driver.delay_s,
            counters=self._count(),
            **self._presence(),
        )

    def _words(self) -> str:
        driver, words = self._driver, [self._text]
        if said := self._instruments.words():
            words.append(said)
        if fault := driver.fault:
            drives = driver.faulty and driver.phase is Phase.DRIVING
            remedy = _LEFT_OUT if drives else _REMEDY
            words.append(f"sensor fault '{fault}': {driver.fault_text}; {remedy}")
        failed = driver.count("failed")
        if failed:
            words.append(f"{failed} step(s) failed, the last {driver.last_error}")
        if self.weights is not None and self.weights.text:
            words.append(self.weights.text)
        return "; ".join(words)

    def _answer(self, request: Request) -> None:
        if request.service is STATUS:
            request.answer(self.status())
        elif request.service is COMMAND:
            self._command(request)
        else:
            self._weights_refused += 1
            request.reply(False, "this controller takes no weights while it drives")

    def _command(self, request: Request) -> None:
        command, why_not = decode_request(request)
        if command is None:
            request.reply(False, why_not)
            return
        self._let_go, self._stopped = False, command.command == "stop"
        if self._stopped:
            self._driver.stop()
            self._text = f"stopped on request: {command.text}"
        else:
            self._driver.go()
            self._text = f"driving on request: {command.text}"
        self.announce(command.command, self._text, request.by | self._next_cycle)
        request.reply(True, self._text)

    @property
    def _next_cycle(self) -> dict[str, Scalar]:
        """Data of an event: the ``seq`` of the first telemetry that it acts on."""
        return {"telemetry_seq": self._counters()["ticks"]}

    def announce(self, kind: str, text: str, data: Mapping[str, Scalar]) -> None:
        """Publishes an event; from any thread."""
        now_ns = clock.monotonic_ns()
        newest = self._driver.newest
        run = 0 if newest is None else newest.run
        with self._publishing:
            seq = self._events.next_seq
            event = Event(
                seq=seq,
                source_time_ns=now_ns,
                run=run,
                source="controller",
                kind=kind,
                text=text[:2000],
                data=dict(data),
            )
            self._events.put(event, lockstep=newest is None or newest.lockstep)

    def _count(self) -> dict[str, Scalar]:
        driver, levels, weights = self._driver, self._driver.levels, self.weights
        return {
            **self._counters(),
            "solution": levels[Level.SOLUTION],
            "shifted_plan": levels[Level.SHIFTED_PLAN],
            "brake": levels[Level.BRAKE],
            "stop": levels[Level.STOP],
            "holds_lost": self._holds_lost,
            "raised": driver.count("failed"),
            "second_starts": driver.count("second_starts"),
            "creeping": driver.count("creeping"),
            "cost_jumps": driver.count("cost_jumps"),
            **{f"sensor_{name}": count for name, count in driver.faults.items() if count},
            **{
                f"readings_{what}_{name}": count
                for name, one in driver.instruments.items()
                for what in ("refused", "lost", "left_out")
                if (count := getattr(one, what))
            },
            **(weights.status() if weights else {"weights_refused": self._weights_refused}),
        }
