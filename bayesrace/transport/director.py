"""Starting and following runs of one car from outside."""

import logging
import time
from collections.abc import Callable, Collection
from typing import Any, Final

from bayesrace.errors import InputError
from bayesrace.messages import (
    EVENT,
    GO_ON,
    HOLD,
    RUN,
    STATUS,
    STOP,
    Event,
    GoOnRequest,
    Hold,
    Reply,
    RunRequest,
    Status,
    StatusRequest,
    StopRequest,
)
from bayesrace.realtime import SUSPENDED_S, suspension
from bayesrace.transport.hold import HOLD_PERIOD_S
from bayesrace.transport.inbox import Inbox, Item, Kind
from bayesrace.transport.publisher import Publisher
from bayesrace.transport.requests import ask, send_weights

__all__ = ["Director", "RefusedError", "apart"]

_log = logging.getLogger("bayesrace.director")

_ALONE: Final = "end all but one, or give each car a name of its own (--name)"

_AFTER_SUSPENSION: Final = (
    "a run in real time goes on, one in lockstep has to be started again if links have expired"
)
_LOOK_S: Final = 0.1
"""Time between two looks whether processes see each other."""


class RefusedError(InputError):
    """A process has refused a request."""

    def __init__(self, what: str, reply: Reply) -> None:
        super().__init__(f"{what} refused: {reply.text}")
        self.reply = reply
        """Its ``data`` has the numbers of the text."""


def apart(plant: Status, controller: Status) -> str:
    """Why a run would not be one of these two, with the remedy; empty if each sees the other, and
    no other process of that kind."""
    pair, blind = ((plant, controller), (controller, plant)), []
    for one, other in pair:
        if strangers := [end for node, end in one.seen.items() if node != other.node]:
            return (
                f"the {one.source} sees another {other.source} ({', '.join(strangers)}) beside "
                f"that at {', '.join(other.listens)}: {_ALONE}"
            )
        if other.node not in one.seen:
            blind.append(f"the {one.source} does not see the {other.source}")
    if not blind:
        return ""
    return (
        f"{', '.join(blind)}: the controller connects to {', '.join(controller.connects)}, the "
        f"plant listens at {', '.join(plant.listens)}: correct the controller's --endpoint or "
        "[network] plant, or ask 'bayesrace doctor' on its machine what is between them"
    )


class Director:
    """Starts and follows runs of one car; for one thread."""

    def __init__(self, session: Any, car: str) -> None:
        self._session = session
        self._car = car
        self._holds = Publisher(session, HOLD, car)
        self._held: tuple[int, int] | None = None
        self._hold_due_s = 0.0
        self.inbox = Inbox(session, car)
        self.inbox.subscribe(EVENT)
        self.inbox.watch("plant")
        self.inbox.watch("controller")
        # The plant ends a run whose director is away for too long.
        self.inbox.announce("director")

    def wait_for(self, sources: Collection[str], timeout_s: float) -> None:
        """Wait until these processes are present, see each other, and know this one's
        subscriptions; InputError if they do not in time."""
        deadline = time.monotonic() + timeout_s
        with self.inbox.receive_signals():
            while missing := set(sources) - self.inbox.alive:
                left_s = deadline - time.monotonic()
                if left_s <= 0:
                    raise InputError(
                        f"no {' and no '.join(sorted(missing))} for car '{self._car}' within "
                        f"{timeout_s:g} s; start it, or check the endpoints with 'bayesrace doctor'"
                    )
                _raise_on_signal(self.inbox.get(left_s))
        # A process that answers a request knows all that was declared before it.
        while True:
            known = {source: self.status(source) for source in sources}
            why = apart(known["plant"], known["controller"]) if len(known) > 1 else ""
            if not why:
                return
            if time.monotonic() > deadline:
                raise InputError(f"car '{self._car}': {why}")
            time.sleep(_LOOK_S)

    def wait_until_gone(self, source: str, timeout_s: float) -> None:
        """Wait until the liveliness token of a process that has ended is gone."""
        deadline = time.monotonic() + timeout_s
        while source in self.inbox.alive and (left_s := deadline - time.monotonic()) > 0:
            self.inbox.get(left_s)

    def status(self, source: str) -> Status:
        """The process's status."""
        request = StatusRequest(seq=0, source_time_ns=time.monotonic_ns())
        return ask(self._session, STATUS, self._car, request, source)

    def check_alone(self) -> None:
        """InputError if several plants or controllers have this name.

        Nothing distinguishes their messages: each would drive, or be driven, now and then.
        """
        for source in ("plant", "controller"):
            if (count := len(self.inbox.nodes(source))) > 1:
                raise InputError(
                    f"{count} processes are the {source} of car '{self._car}'; {_ALONE}"
                )

    def start(self, request: RunRequest) -> Reply:
        """Start a run, which :meth:`wait_for_end` holds if it is to be held; InputError with the
        plant's reason if it refuses."""
        epoch = self.status("plant").epoch if request.held else 0
        reply = _accepted("run", ask(self._session, RUN, self._car, request))
        self._held = (epoch, request.run) if request.held else None
        return reply

    def stop(self, text: str) -> Reply:
        """End the current run."""
        request = StopRequest(seq=0, source_time_ns=time.monotonic_ns(), text=text)
        return ask(self._session, STOP, self._car, request)

    def send_weights(self, data: bytes) -> Reply:
        """:func:`send_weights`; RefusedError with the reasons if they are refused."""
        return _accepted("weights", send_weights(self._session, self._car, data))

    def wait_for_end(
        self,
        run: int,
        timeout_s: float,
        absence_s: float = 1.0,
        trouble: Callable[[], str] = str,
        paused: Callable[[Event], None] = lambda _: None,
    ) -> Event:
        """The ``run_ended`` event of a run.

        In lockstep the plant ends the run itself when the controller disappears; in real time it
        brakes and goes on. A process, or the link to it, may be away for ``absence_s``.
        ``trouble``: a reason to stop waiting, such as a log that cannot be written; empty without.
        ``paused``: called at each ``pause`` event of a run in lockstep, which goes on after it; its
        duration does not count, and signals wait for its end.
        Raises InputError for such a reason, after an absence or the timeout; KeyboardInterrupt on a
        signal.
        """
        deadline = last = time.monotonic() + timeout_s
        lost: set[str] = set()
        returned = False
        with self.inbox.receive_signals():
            while (left_s := deadline - time.monotonic()) > 0:
                item, passed_s = self._next(min(left_s, self._hold()))
                if why_not := trouble():
                    raise InputError(f"run {run} is aborted: {why_not}")
                _raise_on_signal(item)
                if item is None:
                    if returned:
                        self._check_running(run)
                    returned = False
                elif item.kind is Kind.GONE:
                    lost.add(item.name)
                    deadline = min(deadline, time.monotonic() + absence_s)
                elif item.kind is Kind.ALIVE:
                    returned |= item.name == "plant" and item.name in lost
                    lost.discard(item.name)
                    deadline = deadline if lost else last
                elif isinstance(item.value, Event) and item.value.run == run:
                    if item.value.kind == "run_ended":
                        return item.value
                    passed_s += self._pause(item.value, paused)
                deadline, last = deadline + passed_s, last + passed_s
        if lost:
            gone = " and ".join(f"the {one} of car '{self._car}' vanished" for one in sorted(lost))
            raise InputError(f"{gone} during run {run}")
        raise InputError(f"run {run} of car '{self._car}' did not end in {timeout_s:g} s")

    def _next(self, waits_s: float) -> tuple[Item | None, float]:
        """What comes in that time, if anything; and how long the machine slept meanwhile [s]."""
        begin_s = time.monotonic()
        item = self.inbox.get(waits_s)
        if (late_s := time.monotonic() - begin_s - waits_s) <= SUSPENDED_S:
            return item, 0.0
        _log.warning("%s; %s", suspension(late_s), _AFTER_SUSPENSION)
        return item, late_s

    def _pause(self, event: Event, paused: Callable[[Event], None]) -> float:
        """What is to be done in a pause of the run, after which it goes on; its duration [s]."""
        if event.kind != "pause":
            return 0.0
        begin_s = time.monotonic()
        paused(event)
        request = GoOnRequest(seq=0, source_time_ns=time.monotonic_ns(), run=event.run)
        reply = ask(self._session, GO_ON, self._car, request)
        if not reply.accepted and self.status("plant").phase == "running":
            raise InputError(f"run {event.run} does not go on: {reply.text}")
        return time.monotonic() - begin_s  # refused, and over: its end follows

    def _hold(self) -> float:
        """Holds the run, if that is due; how long the loop that follows it may wait now [s]."""
        if self._held is None:
            return 1.0
        now_s = time.monotonic()
        if now_s >= self._hold_due_s:
            self._hold_due_s = now_s + HOLD_PERIOD_S
            seq, now_ns, (epoch, run) = self._holds.next_seq, time.monotonic_ns(), self._held
            hold = Hold(seq=seq, source_time_ns=now_ns, epoch=epoch, run=run)
            self._holds.put(hold, lockstep=False)
        return self._hold_due_s - now_s

    def _check_running(self, run: int) -> None:
        """InputError if the run has ended while the link to the plant was down, with its event."""
        status = self.status("plant")
        if (status.run, status.phase) != (run, "running"):
            raise InputError(f"run {run} ended while the link to the plant was down: {status.text}")


def _accepted(what: str, reply: Reply) -> Reply:
    if not reply.accepted:
        raise RefusedError(what, reply)
    return reply


def _raise_on_signal(item: Item | None) -> None:
    if item is not None and item.kind is Kind.SIGNAL:
        raise KeyboardInterrupt
