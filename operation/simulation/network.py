"""Sessions of a simulated network: what the loops use of Zenoh's, and a link between two of them
that delays, loses, holds up and reorders.

Between all others messages take no time. What a link does is what the relay does for processes
(:mod:`bayesrace.transport.relay`).
"""

from collections import deque
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import zenoh

from bayesrace.operation.simulation.scheduler import Scheduler
from bayesrace.transport import NEWEST
from bayesrace.transport.relay import Way

__all__ = ["Direction", "Network", "Session"]


class Direction(Way):
    """One way between two sessions."""

    def __init__(self, scheduler: Scheduler, seed: str) -> None:
        super().__init__(seed)
        self._scheduler, self.held = scheduler, False
        self._free_ns = 0
        """When the last ordered message arrives."""
        self._waiting: deque[Callable[[], None]] = deque()

    def send(self, deliver: Callable[[], None]) -> None:
        """Calls ``deliver`` when the message arrives, if it does."""
        ordered, now_ns, lost = self.link.ordered, self._scheduler.monotonic_ns(), self.loses()
        if not ordered and (lost or self.held):
            self.lost += not lost
            return
        arrives_ns = now_ns + round(1e9 * self.way_s(lost))
        if ordered:
            arrives_ns = self._free_ns = max(self._free_ns, arrives_ns)
        self._scheduler.call_at(arrives_ns, lambda: self._arrive(deliver))

    def _arrive(self, deliver: Callable[[], None]) -> None:
        if self.held:
            self._waiting.append(deliver)
        else:
            deliver()

    def hold(self) -> None:
        """Nothing gets through any more."""
        self.held = True

    def release(self) -> None:
        """The end of that: what has waited arrives."""
        self.held = False
        while self._waiting:
            self._scheduler.call_at(0, self._waiting.popleft())


class _Sample:
    """A message or a token as handlers get it; also its own payload."""

    def __init__(self, key: str, data: bytes, kind: Any = zenoh.SampleKind.PUT) -> None:
        self.key_expr, self.kind, self._data = key, kind, data
        self.payload = self

    def to_bytes(self) -> bytes:
        return self._data

    def __len__(self) -> int:
        return len(self._data)


class Query(_Sample):
    """A request; :attr:`answer` is what came back, None so far."""

    answer: bytes | None = None

    def reply(self, _key: str, data: bytes) -> None:
        """Of the process that serves it."""
        self.answer = data

    def reply_err(self, text: str) -> None:
        """Of a process that is too busy."""
        raise RuntimeError(f"simulated process: {text}")

    def drop(self) -> None:
        """There is no other copy of it."""


class _Declared:
    """A subscriber, or what serves requests."""

    def __init__(self, session: "Session", key: str, handler: Any) -> None:
        self._session, self._key = session, zenoh.KeyExpr(key)
        self._newest: deque[_Sample] = deque(maxlen=NEWEST)
        self.take = getattr(handler, "callback", None) or self._newest.append
        self.handler = SimpleNamespace(try_recv=self._try_recv)

    def _try_recv(self) -> _Sample | None:
        return self._newest.popleft() if self._newest else None

    def wants(self, key: str) -> bool:
        return bool(self._key.intersects(zenoh.KeyExpr(key)))

    def offer(self, sample: _Sample) -> None:
        if self in self._session.declared and not self._session.closed:
            self.take(sample)

    def undeclare(self) -> None:
        if self in self._session.declared:
            self._session.declared.remove(self)
            self._session.network.changed()


class Session:
    """What a process has in place of a session of Zenoh's."""

    def __init__(self, network: "Network", name: str, number: int) -> None:
        self.network, self.name, self.closed = network, name, False
        self.declared: list[_Declared] = []
        self.info = SimpleNamespace(zid=lambda: f"{name}{number}", links=tuple)

    def declare_publisher(self, key: str, **_: Any) -> Any:
        """Any quality of service: the network is never congested."""
        return SimpleNamespace(put=lambda data: self.network.publish(self, key, data))

    def declare_subscriber(self, key: str, handler: Any) -> _Declared:
        """``handler``: Zenoh's callback, or channel of the newest."""
        self.declared.append(declared := _Declared(self, key, handler))
        self.network.changed()
        return declared

    def declare_queryable(self, key: str, handler: Any) -> Callable[[_Sample], None]:
        """Serves requests."""
        self.network.served[key] = self, handler.callback
        return lambda _: None

    def liveliness(self) -> Any:
        """Tokens reach everybody at once."""
        return SimpleNamespace(declare_token=self._appear, declare_subscriber=self._watch)

    def _appear(self, key: str) -> str:
        self.network.appear(self, key)
        return key

    def _watch(self, key: str, handler: Any, history: bool) -> _Declared:
        declared = _Declared(self, key, handler)
        self.network.watch(declared, history)
        return declared


class Network:
    """Carries what its sessions publish."""

    def __init__(self, scheduler: Scheduler, ends: tuple[str, str], seed: int) -> None:
        """``ends``: names of the two sessions with the link between them."""
        self._scheduler, self._sessions = scheduler, list[Session]()
        self.ways = {
            to: Direction(scheduler, f"{seed} {sender} {to}") for sender, to in (ends, ends[::-1])
        }
        """Between these two, by who receives."""
        self.served: dict[str, tuple[Session, Callable[[Query], None]]] = {}
        self._tokens: dict[str, Session] = {}
        self._watching: list[_Declared] = []
        self._readers: dict[str, list[tuple[Session, _Declared]]] = {}

    def session(self, name: str) -> Session:
        """A new one; two of one name are two processes."""
        self._sessions.append(session := Session(self, name, len(self._sessions)))
        return session

    def close(self, session: Session) -> None:
        """As the links of a process that has ended: nothing of it goes on, and all notice."""
        session.closed = True
        self.changed()
        self._watching = [one for one in self._watching if one._session is not session]
        for key in [key for key, owner in self._tokens.items() if owner is session]:
            del self._tokens[key]
            self._show(key, zenoh.SampleKind.DELETE)

    def changed(self) -> None:
        """Who reads what."""
        self._readers.clear()

    def publish(self, sender: Session, key: str, data: bytes) -> None:
        """To all that have subscribed to it."""
        if sender.closed:
            return
        if (readers := self._readers.get(key)) is None:
            readers = self._readers[key] = [
                (session, one)
                for session in self._sessions if not session.closed
                for one in session.declared if one.wants(key)
            ]  # fmt: skip
        sample = _Sample(key, data)
        for session, one in readers:
            if session is not sender:
                self._carry(sender, session, one, sample)

    def _carry(self, sender: Session, to: Session, one: _Declared, sample: _Sample) -> None:
        if {sender.name, to.name} == self.ways.keys():
            self.ways[to.name].send(lambda: one.offer(sample))
        else:
            one.offer(sample)

    def ask(self, key: str, data: bytes) -> Query:
        """Hands the request to the process that serves the key; it answers when it gets to it."""
        session, take = self.served[key]
        query = Query(key, data)
        if not session.closed:
            take(query)
        return query

    def appear(self, session: Session, key: str) -> None:
        """A token is there."""
        self._tokens[key] = session
        self._show(key, zenoh.SampleKind.PUT)

    def watch(self, declared: _Declared, history: bool) -> None:
        """Shows tokens that come and go from now on, and those that are there."""
        self._watching.append(declared)
        for key in self._tokens if history else ():
            if declared.wants(key):
                declared.take(_Sample(key, b""))

    def _show(self, key: str, kind: Any) -> None:
        for one in self._watching:
            if one.wants(key):
                one.take(_Sample(key, b"", kind))
