"""Asking other processes, and following a run from outside."""

import time
from collections.abc import Callable, Collection, Sequence
from typing import Any, Final, TypeVar

import zenoh

from bayesrace.errors import InputError
from bayesrace.messages import (
    EVENT,
    ROLLBACK,
    RUN,
    STATUS,
    STOP,
    WEIGHTS,
    Event,
    Message,
    Reply,
    RollbackRequest,
    RunRequest,
    Service,
    Status,
    StatusRequest,
    StopRequest,
    car_key,
    decode,
    encode,
)
from bayesrace.transport.inbox import BUSY, Inbox, Kind

__all__ = [
    "Director",
    "RefusedError",
    "ask",
    "ask_all",
    "count_processes",
    "decisive",
    "send_rollback",
    "send_weights",
]

A = TypeVar("A", bound=Message)

_LOST_S: Final = 0.5
"""A question that ends without an answer after this has been lost with its link."""
_AGAIN_S: Final = 0.2
"""Until it is asked again."""


class RefusedError(InputError):
    """A process has answered no."""

    def __init__(self, what: str, reply: Reply) -> None:
        super().__init__(f"{what} refused: {reply.text}")
        self.reply = reply
        """With the numbers that the text is about in its data."""


def ask(
    session: Any,
    service: Service[Any, A],
    car: str,
    request: Message | bytes,
    source: str = "",
    timeout_s: float | None = None,
) -> A:
    """Ask a process and wait for its answer, as long as the table says unless told otherwise.

    Repeats the request if the link broke while it was pending, as when a machine stalls for longer
    than the lease, and the service is repeatable. If several processes answer to one name,
    :func:`decisive` chooses among the valid answers. Raises InputError if there is no valid
    answer in time.
    """
    key = car_key(service.key, car, source)
    limit_s = service.timeout_s if timeout_s is None else timeout_s
    begin = time.monotonic()
    turned_away: list[str] = []
    answers = ask_all(session, (key,), request, limit_s, turned_away=turned_away)[key]
    # Without a process to answer, the first request returns at once and is not repeated.
    lost = service.repeatable and (turned_away or time.monotonic() - begin > _LOST_S)
    while lost and not answers and (left_s := begin + limit_s - time.monotonic()) > _AGAIN_S:
        time.sleep(_AGAIN_S)
        left_s -= _AGAIN_S
        answers = ask_all(session, (key,), request, left_s, turned_away=turned_away)[key]
    answer = decisive(_valid(service.answer, answers))
    if answer is None and turned_away:
        raise InputError(f"the process that answers on {key} is {turned_away[-1][:200]}; try again")
    if answer is None:
        # Who gives a time has it from an option of that name.
        longer = "" if timeout_s is None else " Or wait longer (--timeout)."
        raise InputError(
            f"nobody answered on {key} within {limit_s:g} s; is the process for car '{car}' "
            f"running, and its endpoint among those to connect to?{longer}"
        )
    return answer


def _valid(kind: type[A], answers: Sequence[bytes]) -> list[A]:
    """Those that can be decoded; InputError, that of the first, if there are only others."""
    valid: list[A] = []
    why_not: InputError | None = None
    for data in answers:
        try:
            valid.append(decode(kind, data))
        except InputError as error:
            why_not = why_not or error
    if why_not is not None and not valid:
        raise why_not
    return valid


def ask_all(
    session: Any,
    keys: Collection[str],
    request: Message | bytes,
    timeout_s: float,
    turned_away: list[str] | None = None,
) -> dict[str, list[bytes]]:
    """Every answer to one request, by key; all keys are asked at once.

    Returns when all have answered or the time is over. A key nobody answers on has none; one with
    several answers belongs to several processes. Puts into ``turned_away`` why the request was not
    looked at, where a process was too busy.
    """
    payload = request if isinstance(request, bytes) else encode(request)
    pending = {
        key: session.get(
            key,
            payload=payload,
            timeout=timeout_s,
            target=zenoh.QueryTarget.ALL,
            # Two processes under one name would otherwise be one answer.
            consolidation=zenoh.ConsolidationMode.NONE,
            # Dropped, a question is never answered: on a loaded machine that ended a race.
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
        for key in keys
    }
    answers: dict[str, list[bytes]] = {key: [] for key in pending}
    for key, replies in pending.items():
        for one in replies:
            if one.ok is not None:
                answers[key].append(one.ok.payload.to_bytes())
            elif turned_away is not None and one.err is not None:
                text = one.err.payload.to_bytes().decode(errors="replace")
                if text.startswith(BUSY):  # not an error of Zenoh's own, such as a timeout
                    turned_away.append(text)
    return answers


def count_processes(
    session: Any, car: str, source: str, timeout_s: float = STATUS.timeout_s
) -> int:
    """How many processes answer as the ``source`` of a car, as far as this session sees them."""
    key = car_key(STATUS.key, car, source)
    request = StatusRequest(0, time.monotonic_ns())
    return len(_valid(Status, ask_all(session, (key,), request, timeout_s)[key]))


def decisive(answers: Sequence[A]) -> A | None:
    """Of several answers under one name, a refusal if there is one; None if there are none.

    A name that two processes answer to must not pass for a yes of both.
    """
    refusals = (one for one in answers if isinstance(one, Reply) and not one.accepted)
    return next(refusals, answers[0] if answers else None)


def send_weights(session: Any, car: str, data: bytes, timeout_s: float | None = None) -> Reply:
    """The controller's answer to new weights (the file's bytes), accepted or not.

    Accepted, it drives with them from now on. ``data`` of the answer: ``version``, ``number`` (of
    acceptance, rising), ``cycle`` (tick of the first cycle that they drive), ``probation`` (too few
    samples to compare), and what was compared: ``samples``, ``error_new_vx``, ``error_old_vx``,
    ``error_nominal_vx`` and so on, one-step prediction errors (RMSE) of the new weights, those
    before, and the uncorrected model. Of a refusal whose reason passes (the controller ends, say):
    ``again``, True.
    """
    return ask(session, WEIGHTS, car, data, timeout_s=timeout_s)


def send_rollback(session: Any, car: str, text: str, timeout_s: float | None = None) -> Reply:
    """Back to the weights before those in use; ``text``: why. The answer, accepted or not.

    ``data`` of the answer: ``version`` and ``number`` of those in use from ``cycle`` on,
    ``from_version`` and ``from_number`` of those before.
    """
    request = RollbackRequest(0, time.monotonic_ns(), text[:2000])
    return ask(session, ROLLBACK, car, request, timeout_s=timeout_s)


class Director:
    """Starts and follows runs of one car; for one thread."""

    def __init__(self, session: Any, car: str) -> None:
        self._session = session
        self._car = car
        self.inbox = Inbox(session, car)
        self.inbox.subscribe(EVENT)
        self.inbox.watch("plant")
        self.inbox.watch("controller")
        # The plant ends a run whose director is gone for long.
        self.inbox.announce("director")

    def wait_for(self, sources: Collection[str], timeout_s: float) -> None:
        """Wait until these processes are there and know of this one's subscriptions."""
        deadline = time.monotonic() + timeout_s
        with self.inbox.catching_signals():
            while missing := set(sources) - self.inbox.alive:
                left_s = deadline - time.monotonic()
                if left_s <= 0:
                    raise InputError(
                        f"no {' and no '.join(sorted(missing))} for car '{self._car}' within "
                        f"{timeout_s:g} s; start it, or check the endpoints"
                    )
                self._raise_on_signal(self.inbox.get(left_s))
        # What was declared before a request is known to who has answered it.
        for source in sources:
            self.status(source)

    def wait_until_gone(self, source: str, timeout_s: float) -> None:
        """Wait until a process that has ended is no longer taken for present."""
        deadline = time.monotonic() + timeout_s
        while source in self.inbox.alive and (left_s := deadline - time.monotonic()) > 0:
            self.inbox.get(left_s)

    def status(self, source: str) -> Status:
        """What the process says of itself."""
        request = StatusRequest(0, time.monotonic_ns())
        return ask(self._session, STATUS, self._car, request, source)

    def check_alone(self) -> None:
        """InputError if several plants or controllers of this name are there.

        Their messages cannot be told apart: each would drive, or be driven, now and then.
        """
        for source in ("plant", "controller"):
            if (count := count_processes(self._session, self._car, source)) > 1:
                raise InputError(
                    f"{count} processes are the {source} of car '{self._car}'; end all but one, or "
                    "give each car a name of its own (--name)"
                )

    def start(self, request: RunRequest) -> Reply:
        """Start a run; InputError with the plant's reason if it refuses."""
        return self._accepted("run", ask(self._session, RUN, self._car, request))

    def stop(self, text: str) -> Reply:
        """End the run under way."""
        return ask(self._session, STOP, self._car, StopRequest(0, time.monotonic_ns(), text))

    def send_weights(self, data: bytes) -> Reply:
        """:func:`send_weights`; RefusedError with the reasons if they are refused."""
        return self._accepted("weights", send_weights(self._session, self._car, data))

    def rollback(self, text: str) -> Reply:
        """:func:`send_rollback`; RefusedError if there is nothing to go back to."""
        return self._accepted("rollback", send_rollback(self._session, self._car, text))

    def wait_for_end(
        self,
        run: int,
        timeout_s: float,
        absence_s: float = 1.0,
        trouble: Callable[[], str] = str,
    ) -> Event:
        """The ``run_ended`` event of a run.

        In lockstep the plant ends the run itself when the controller vanishes; by the wall clock
        it brakes and goes on. A process, or the link to it, may be away for ``absence_s``.
        ``trouble``: why it makes no sense to wait on, such as a log that cannot be written; empty
        while it does. Raises InputError if one is away for longer, the time is over, or of that
        trouble; KeyboardInterrupt on a signal.
        """
        deadline = last = time.monotonic() + timeout_s
        lost: dict[str, str] = {}
        with self.inbox.catching_signals():
            while (left_s := deadline - time.monotonic()) > 0:
                item = self.inbox.get(min(left_s, 1.0))
                if why_not := trouble():
                    raise InputError(f"run {run} is broken off: {why_not}")
                if item is None:
                    continue
                self._raise_on_signal(item)
                if item.kind is Kind.GONE:
                    lost[item.name] = f"the {item.name} of car '{self._car}' vanished"
                    deadline = min(deadline, time.monotonic() + absence_s)
                if item.kind is Kind.ALIVE and item.name in lost:
                    del lost[item.name]
                    deadline = deadline if lost else last
                event = item.value
                if isinstance(event, Event) and (event.run, event.kind) == (run, "run_ended"):
                    return event
        if lost:
            raise InputError(f"{' and '.join(lost.values())} during run {run}")
        raise InputError(f"run {run} of car '{self._car}' did not end in {timeout_s:g} s")

    @staticmethod
    def _accepted(what: str, reply: Reply) -> Reply:
        if not reply.accepted:
            raise RefusedError(what, reply)
        return reply

    @staticmethod
    def _raise_on_signal(item: Any) -> None:
        if item is not None and item.kind is Kind.SIGNAL:
            raise KeyboardInterrupt
