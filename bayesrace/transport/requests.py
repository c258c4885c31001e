"""Requests between processes: how one is sent and its answers judged, and how it is served."""

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final, Generic, TypeVar

import zenoh

from bayesrace.errors import InputError
from bayesrace.messages import (
    ROLLBACK,
    STATUS,
    WEIGHTS,
    Message,
    Reply,
    RollbackRequest,
    Scalar,
    Service,
    StatusRequest,
    car_key,
    decode,
    encode,
)
from bayesrace.transport.links import LINKS, Links

__all__ = [
    "Answers", "Request", "ask", "ask_all", "count_processes", "decisive", "declare_service",
    "decode_request", "in_transport_thread", "send_rollback", "send_weights",
]  # fmt: skip

A = TypeVar("A", bound=Message)

_BUSY: Final = "busy: "
"""Beginning of the error that answers a rejected request."""
_LOST_S: Final = 0.5
"""A request that ends without an answer after this time was lost with its link."""
_REPEAT_S: Final = 0.2
"""Time until it is repeated."""


@dataclass
class Answers(Generic[A]):
    """What came back for one key."""

    valid: list[A] = field(default_factory=list)
    count: int = 0
    """Answers received, those that cannot be decoded included."""
    fault: str = ""
    """Why there is no valid answer: a process is busy, or what is wrong with the first."""

    def add(self, reply: Any, kind: type[A]) -> None:
        """One reply of Zenoh's."""
        if reply.ok is None:
            text = reply.err.payload.to_bytes().decode(errors="replace")
            if text.startswith(_BUSY):  # not an error of Zenoh's own, such as a timeout
                self.fault = text[:200]
            return
        self.count += 1
        try:
            self.valid.append(decode(kind, reply.ok.payload.to_bytes()))
        except InputError as error:
            self.fault = self.fault or str(error)


def ask(
    session: Any,
    service: Service[Any, A],
    car: str,
    request: Message | bytes,
    source: str = "",
    timeout_s: float | None = None,
) -> A:
    """Send a request to a process and wait for its answer; ``timeout_s`` None: the table's.

    Repeats the request if its link broke while it was pending, such as when a machine stalls for
    longer than the lease, and the service is repeatable. If several processes answer under one
    name, :func:`decisive` chooses. Raises InputError if there is no valid answer in time.
    """
    key = car_key(service.key, car, source)
    limit_s = service.timeout_s if timeout_s is None else timeout_s
    begin = time.monotonic()
    answers = ask_all(session, service, (key,), request, limit_s)[key]
    # Without a process to answer, the first request returns at once and is not repeated.
    lost = service.repeatable and (answers.fault or time.monotonic() - begin > _LOST_S)
    while lost and not answers.count and (left_s := begin + limit_s - time.monotonic()) > _REPEAT_S:
        time.sleep(_REPEAT_S)
        answers = ask_all(session, service, (key,), request, left_s - _REPEAT_S)[key]
    answer = decisive(answers.valid)
    if answer is not None:
        return answer
    if answers.fault:
        raise InputError(f"no valid answer on {key}: {answers.fault}")
    # A caller that sets the time has it from the option --timeout.
    longer = "" if timeout_s is None else ", or wait longer (--timeout)"
    raise InputError(
        f"no answer on {key} within {limit_s:g} s; start the process for car '{car}', check the "
        f"endpoints{longer}"
    )


def ask_all(
    session: Any,
    service: Service[Any, A],
    keys: Collection[str],
    request: Message | bytes,
    timeout_s: float,
) -> dict[str, Answers[A]]:
    """Every answer to one request, by key; sent to all keys of the service at once.

    Returns when all have answered or the time is over. Several answers on a key come from several
    processes under one name.
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
            # A dropped request is never answered: on a loaded machine that ended a race.
            congestion_control=zenoh.CongestionControl.BLOCK,
            source_info=zenoh.SourceInfo(session.id, 0),
        )
        for key in keys
    }
    answers: dict[str, Answers[A]] = {key: Answers() for key in pending}
    for key, replies in pending.items():
        for reply in replies:
            answers[key].add(reply, service.answer)
    return answers


def decisive(answers: Sequence[A]) -> A | None:
    """Of several answers under one name, a refusal if there is one; None if there are none.

    An acceptance by one of two processes is no acceptance by both.
    """
    refusals = (one for one in answers if isinstance(one, Reply) and not one.accepted)
    return next(refusals, answers[0] if answers else None)


def count_processes(
    session: Any, car: str, source: str, timeout_s: float = STATUS.timeout_s
) -> int:
    """How many processes answer as the ``source`` of a car, as far as this session sees them."""
    key = car_key(STATUS.key, car, source)
    request = StatusRequest(seq=0, source_time_ns=time.monotonic_ns())
    return ask_all(session, STATUS, (key,), request, timeout_s)[key].count


def send_weights(session: Any, car: str, data: bytes, timeout_s: float | None = None) -> Reply:
    """The controller's answer to new weights (the file's bytes), accepted or refused.

    Accepted weights drive from now on. ``data`` of the answer: ``version``, ``number`` (of
    acceptance, rising), ``cycle`` (tick of the first cycle with them), ``probation`` (too few
    samples to compare), and the comparison: ``samples``, ``error_new_vx``, ``error_old_vx``,
    ``error_nominal_vx`` and so on, one-step prediction errors (RMSE) of the new weights, the
    previous ones, and the uncorrected model. ``again`` is True if the reason of a refusal is
    temporary, such as a controller that is shutting down.
    """
    return ask(session, WEIGHTS, car, data, timeout_s=timeout_s)


def send_rollback(session: Any, car: str, text: str, timeout_s: float | None = None) -> Reply:
    """The controller's answer to a request for its previous weights; ``text``: the reason.

    ``data`` of the answer: ``version`` and ``number`` of the weights in use from ``cycle`` on,
    ``from_version`` and ``from_number`` of the withdrawn ones.
    """
    request = RollbackRequest(seq=0, source_time_ns=time.monotonic_ns(), text=text[:2000])
    return ask(session, ROLLBACK, car, request, timeout_s=timeout_s)


class Request:
    """A pending request, with those that have joined it; answer it once."""

    def __init__(
        self,
        service: Service[Any, Any],
        query: Any,
        max_bytes: int | None,
        links: Links | None = None,
    ) -> None:
        """``max_bytes``: a longer payload is not copied, which would block other threads.

        ``links``: of the session that it came by.
        """
        self.service = service
        self._links = links
        self._queries = [query]
        payload = query.payload
        self.size = 0 if payload is None else len(payload)
        """Bytes of the payload as sent."""
        fits = max_bytes is None or self.size <= max_bytes
        self.payload: bytes = payload.to_bytes() if payload is not None and fits else b""

    @property
    def sender(self) -> str:
        """See :meth:`.Links.sender`; empty once it is answered."""
        return self._links.sender(self._queries[0]) if self._links and self._queries else ""

    @property
    def by(self) -> dict[str, Scalar]:
        """The sender, for the data of an event; nothing without certificates."""
        return {"by": sender} if (sender := self.sender) else {}

    def join(self, other: "Request", most: int) -> bool:
        """Let ``other`` have the same answer; False if ``most`` requests have it already."""
        if len(self._queries) >= most:
            return False
        self._queries += other._queries
        return True

    def answer(self, message: Message) -> None:
        """Send the answer; it is dropped if the client has gone."""
        self.answer_raw(encode(message))

    def reply(self, accepted: bool, text: str, data: Mapping[str, Scalar] | None = None) -> None:
        """Answer with a :class:`.Reply`; what is accepted is logged with its sender."""
        if accepted and self._links is not None and (sender := self.sender):
            self._links.accepted(f"{self.service.name} by '{sender}': {text}")
        self.answer(
            Reply(
                seq=0,
                source_time_ns=time.monotonic_ns(),
                accepted=accepted,
                text=text[:2000],
                data=data or {},
            )
        )

    def answer_raw(self, data: bytes) -> None:
        """The same where the answer is not a message."""
        self._end(lambda query: query.reply(query.key_expr, data))

    def reject(self, why: str) -> None:
        """Answer with the error that the process is too busy, and ``why``."""
        self.refuse(_BUSY + why)

    def refuse(self, why: str) -> None:
        """Answer with an error."""
        self._end(lambda query: query.reply_err(why))

    def _end(self, reply: Callable[[Any], None]) -> None:
        queries, self._queries = self._queries, []
        try:
            for query in queries:
                with suppress(zenoh.ZError):
                    reply(query)
        finally:
            for query in queries:  # whatever has failed: its client would wait for the end
                query.drop()


def declare_service(
    session: Any,
    service: Service[Any, Any],
    car: str,
    on_request: Callable[[Request], None],
    max_bytes: int | None = None,
    source: str = "",
) -> Any:
    """Calls ``on_request`` with each request in the transport's thread, so it must be quick.

    For threads without an inbox. Keep what is returned; ``max_bytes`` as in :class:`Request`.
    """

    links = LINKS.get(str(session.info.zid()))

    def on_query(query: Any) -> None:
        request = Request(service, query, max_bytes, links)
        if links is None or links.admits(query):
            on_request(request)
        else:
            request.refuse("a request names its session, which is a member's with a link here")

    key = car_key(service.key, car, source)
    return session.declare_queryable(key, in_transport_thread(on_query))


def decode_request(request: Request) -> tuple[Any, str]:
    """The request's message and "", or None and why it is refused."""
    kind = request.service.request
    if kind is None:
        raise TypeError(f"the payload of '{request.service.name}' is not a message")
    try:
        return decode(kind, request.payload), ""
    except InputError as error:
        return None, str(error)


def in_transport_thread(callback: Callable[[Any], None]) -> Any:
    """Handler that runs in the receiving thread; another one would cost as much as the network."""
    return zenoh.handlers.Callback(callback, indirect=False)
