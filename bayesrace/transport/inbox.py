"""One place where a thread waits, with a time limit, for everything that can happen to it.

Messages of the control path wait in channels of Zenoh's own, one for each topic, which the waiting
thread polls: that saves a hand-over between threads and halves the round trip (docs/decisions/).
All else arrives in one queue: other messages, requests, liveliness tokens, signals. Queue and
channels take turns, so a flood of requests delays a state by one request at most. No call waits
for channels and a queue at once, so the thread looks at all of them and sleeps between two looks:
0.05 ms at first, longer the longer it has waited. An inbox without channels sleeps in its queue.
"""

import logging
import os
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from enum import Enum
from functools import partial
from typing import Any, Final, NamedTuple, TypeVar

import zenoh

from bayesrace import clock
from bayesrace.messages import ALIVE, Decoder, Message, Service, Topic, car_key
from bayesrace.processes import catching_signals
from bayesrace.transport.endpoints import Endpoints
from bayesrace.transport.requests import Request, declare_service, in_transport_thread

__all__ = ["LOCKSTEP_SPIN_S", "NEWEST", "POLL_S", "Inbox", "Item", "Kind"]

M = TypeVar("M", bound=Message)

_CAPACITY: Final = 10_000
"""Items that wait at most; a thread this far behind is broken, and memory must not follow it."""

_NODES: Final = 16
"""Processes of one source that are told apart at most."""

_REQUESTS: Final = 16
"""Requests that wait at most, urgent and other ones, and that share an answer; more are rejected,
so that no backlog builds up. Measured, 16 answers at once take as long as one, 0.2 to 0.3 ms."""

NEWEST: Final = 1024
"""Messages of the control path that wait at most; a thread this far behind needs the newest."""

LOCKSTEP_SPIN_S: Final = 0.002
"""How long a lockstep peer polls for an answer that is due before it sleeps. Waking an idle CPU
takes longer than the answer: measured, the round trip falls from 270 to 90 us."""

_AHEAD_S: Final = 1e-4
"""A lockstep peer sleeps until this long before the earliest answer that it expects, because
polling takes CPU time from the process that computes the answer. A sleep ends some 0.06 ms late."""
_LATER: Final = 2e-6
"""Largest increase of the expected time from one message to the next [s]."""
_SOONER: Final = 0.9
"""Factor on the expected time if a message had arrived before the sleep ended."""

POLL_S: Final = 5e-5
"""Shortest sleep between two looks ..."""
_IDLE_S: Final = 2e-3
"""... and the longest: how late a thread that has waited for long may notice something. 500 looks a
second take 2 % of a CPU."""
_SHARE: Final = 0.125
"""Length of a sleep between these two, as a share of the time waited so far."""


class Kind(Enum):
    """What an item is."""

    MESSAGE = "message"
    REQUEST = "request"
    ALIVE = "alive"
    GONE = "gone"
    SIGNAL = "signal"


class Item(NamedTuple):
    """Something that happened."""

    kind: Kind
    name: str
    """Topic, service or source; empty for signals."""
    value: Any
    """MESSAGE: the message, None if the topic's decoder has refused it; REQUEST: :class:`Request`;
    SIGNAL: its number; else None."""
    received_ns: int
    """Own monotonic clock on arrival."""
    key: str = ""
    """Key of a token, without the session's id, or of a message from the queue."""


class _Channel(NamedTuple):
    """A topic that the thread polls."""

    name: str
    key: str
    try_recv: Callable[[], Any]
    decoder: Decoder[Any]


class Inbox:
    """Items for one thread: declare what may arrive, then :meth:`get` it.

    Declarations live as long as the inbox, so keep it.
    """

    def __init__(self, session: Any, car: str | None, capacity: int = _CAPACITY) -> None:
        """``car``: None for all cars, to receive only. ``capacity``: of the queue."""
        self._session = session
        self._car = car
        self._capacity = capacity
        self._queue: queue.SimpleQueue[Item] = queue.SimpleQueue()
        self._declarations: list[Callable[[], Any]] = []
        self._declared: list[Any] = []
        self._decoders: dict[str, Decoder[Any]] = {}
        self._channels: deque[_Channel] = deque()
        """In the order in which they are looked at next."""
        self._stamping = False
        self._queue_was_last = False
        self.alive: set[str] = set()
        """Sources of which a liveliness token is there, as of the items taken so far."""
        self._nodes: dict[str, frozenset[str]] = {}
        """Ids of the sessions that have one now, by its key."""
        self._node = ""
        self._seen: dict[str, str] = {}
        """Those of :meth:`presence`, with the other ends of their links."""
        self._lock = threading.Lock()
        """Of the following, which the transport's threads change, too."""
        self._urgent: deque[Item] = deque()
        self._others: deque[Item] = deque()
        """Requests that wait. The queue has as many of their items, and so wakes the owner."""
        self._shared: dict[str, Request] = {}
        """By the service's name, the request that waits and that others may join."""
        self.overflowed = 0
        """Items lost because the queue was full."""
        self.requests_rejected = 0
        """Requests rejected because too many waited."""
        self.spin_s = 0.0
        """How long :meth:`get` polls before it sleeps; 0 wherever others need the CPU."""
        self._expected_s = 0.0
        """After how long the earliest message is expected, in lockstep."""

    def subscribe(
        self,
        topic: Topic[M],
        source: str = "*",
        newest: int | None = None,
        logger: logging.Logger | None = None,
    ) -> Decoder[M]:
        """Receive the topic's messages, decoded, under its name; any number of topics.

        ``newest``: they wait in a channel that the thread polls, of which the newest so many are
        kept; otherwise in the queue. Returns the topic's decoder, which counts what it refuses;
        ``logger`` as in :class:`Decoder`.
        """
        decoder = self._decoders[topic.name] = Decoder(topic.message, logger)
        key = self._key(topic.key, source)

        def declare() -> Any:
            if newest is None:
                return self._into_queue(topic.name, key)
            channel: Any = zenoh.handlers.RingChannel(newest)
            subscriber = self._session.declare_subscriber(key, channel)
            take = subscriber.handler.try_recv
            self._channels.append(_Channel(topic.name, key, take, decoder))
            return subscriber

        self._declare(declare)
        return decoder

    def serve(self, service: Service[Any, Any], source: str = "") -> None:
        """Receive the service's requests; those beyond the limit are rejected and counted.

        Viewers may send requests of ``shared`` services alone. Those share one place, so they
        cannot use up the places of others. Requests of ``urgent`` services are taken first.
        """

        def on_request(request: Request) -> None:
            if not self._admit(service, request):
                self.requests_rejected += 1
                request.reject(f"{_REQUESTS} requests are waiting; try again")

        car = self._car or ""
        self._declare(
            lambda: declare_service(self._session, service, car, on_request, source=source)
        )

    def announce(self, source: str) -> None:
        """Declare this process's liveliness token: last, when everything else is in place."""

        def declare() -> Any:
            self._node = str(self._session.info.zid())
            key = self._key(ALIVE, source).replace("*", self._node)
            return self._session.liveliness().declare_token(key)

        self._declare(declare)

    def watch(self, source: str = "*") -> None:
        """Receive the appearance of the first process of each source, and the disappearance of the
        last one; those present now included."""

        def on_token(session: Any, sample: Any) -> None:
            key, _, node = str(sample.key_expr).rpartition("/")
            with self._lock:
                if session is not self._session:  # of before
                    return
                before = self._nodes.get(key, frozenset())
                now = before - {node} if sample.kind == zenoh.SampleKind.DELETE else before | {node}
                if len(now) <= _NODES:
                    self._nodes[key] = now
                if bool(before) != bool(now):
                    kind = Kind.ALIVE if now else Kind.GONE
                    self._offer(kind, key.rpartition("/")[2], None, key)

        def declare() -> Any:
            handler = in_transport_thread(partial(on_token, self._session))
            tokens = self._session.liveliness()
            return tokens.declare_subscriber(self._key(ALIVE, source), handler, history=True)

        self._declare(declare)

    def bind(self, session: Any) -> None:
        """Receive the same over this session from now on; that of before is closed."""
        self._channels.clear()
        with self._lock:
            self._session = session
            for key, nodes in self._nodes.items():
                if nodes:
                    self._offer(Kind.GONE, key.rpartition("/")[2], None, key)
            self._nodes.clear()
        self._seen = {}  # their links are others now
        self._declared = [declare() for declare in self._declarations]

    def _declare(self, declare: Callable[[], Any]) -> None:
        self._declarations.append(declare)
        self._declared.append(declare())

    def nodes(self, source: str) -> frozenset[str]:
        """Ids of the sessions that are there now as a source that is watched."""
        return self._nodes.get(self._key(ALIVE, source).removesuffix("/*"), frozenset())

    def presence(self, endpoints: Endpoints, other: str) -> dict[str, Any]:
        """Fields of this process's :class:`~bayesrace.messages.Status`: where it is, and who it
        sees of the source ``other``, which it watches."""
        if (nodes := self.nodes(other)) != self._seen.keys():
            # Zenoh 1.10.2 panics where it is asked for the ends of low-latency links.
            links = () if endpoints.low_latency else self._session.info.links()
            ends = {str(one.zid): f"{one.dst} {one.auth_identifier or ''}"[:200] for one in links}
            self._seen = {node: ends.get(node, "").strip() for node in sorted(nodes)}
        here = {"listens": endpoints.listen, "connects": endpoints.connect}
        return {
            "node": self._node, "seen": self._seen, "calendar_s": time.time(),
            **{name: tuple(one[:200] for one in some[:8]) for name, some in here.items()},
        }  # fmt: skip

    def receive_signals(self) -> AbstractContextManager[None]:
        """For the block, SIGINT and SIGTERM arrive as items; no effect off the main thread."""
        return catching_signals(
            lambda number: self.put(Item(Kind.SIGNAL, "", number, clock.monotonic_ns()))
        )

    def put(self, item: Item) -> None:
        """Add an item of this process itself, whatever waits; from any thread or signal handler."""
        self._queue.put(item)

    def get(self, timeout_s: float = 0.0) -> Item | None:
        """The next item, of queue and channels in turn; None after the timeout."""
        if self._stamping:
            self._empty_channels()
        if self._stamping or not self._channels:
            return self._from_queue(timeout_s)
        begin, misses, rested_s = clock.monotonic(), 0, 0.0
        while (item := self._in_turn()) is None:
            waited_s, misses = clock.monotonic() - begin, misses + 1
            if waited_s >= timeout_s:
                return None
            if misses == 1 and self.spin_s and self._expected_s > _AHEAD_S:
                rested_s = min(self._expected_s - _AHEAD_S, timeout_s)
                clock.sleep(rested_s)
            elif waited_s - rested_s < self.spin_s:
                os.sched_yield()  # the thread that receives may be waiting for this very CPU
            else:
                sleep_s = min(max(_SHARE * waited_s, POLL_S), _IDLE_S)
                clock.sleep(min(sleep_s, timeout_s - waited_s))
        if misses and self.spin_s and item.kind is Kind.MESSAGE:
            if misses == 1 and rested_s:
                self._expected_s *= _SOONER
            else:
                self._expected_s = min(clock.monotonic() - begin, self._expected_s + _LATER)
        return item

    def poll(self, until_ns: int) -> Item | None:
        """The next message of the channels, looked for until the monotonic clock is ``until_ns``.

        For fixed-rate loops: notices a message within a tenth of a millisecond without another
        thread's help, and leaves the CPU to the thread that receives it (docs/decisions/). Looks at
        least once.
        """
        while (item := self._from_channels()) is None:
            if clock.monotonic_ns() >= until_ns:
                return None
            clock.sleep(POLL_S)
        return item

    @property
    def queued(self) -> int:
        """Items that wait in the queue now."""
        return self._queue.qsize()

    def poll_queue(self) -> Item | None:
        """The next item of the queue; does not wait."""
        return self._from_queue(0.0)

    @contextmanager
    def stamped(self) -> Iterator[None]:
        """For the block, the messages of channels go through the queue, too.

        The transport's thread takes them as they arrive, so that ``received_ns`` is right even
        while the owner sleeps.
        """
        self._stamping = True
        try:
            with ExitStack() as stack:
                for channel in self._channels:
                    stack.callback(self._into_queue(channel.name, channel.key).undeclare)
                yield
        finally:
            self._empty_channels()
            self._stamping = False

    def _key(self, template: str, source: str) -> str:
        if self._car is None:
            return template.format(car="*", source=source)
        return car_key(template, self._car, source)

    def _into_queue(self, name: str, key: str) -> Any:
        def on_sample(sample: Any) -> None:
            data: bytes = sample.payload.to_bytes()
            self._offer(Kind.MESSAGE, name, data, str(sample.key_expr))

        return self._session.declare_subscriber(key, in_transport_thread(on_sample))

    def _admit(self, service: Service[Any, Any], request: Request) -> bool:
        """In the transport's thread."""
        with self._lock:
            if waiting := self._shared.get(service.name):
                return waiting.join(request, _REQUESTS)
            requests = self._urgent if service.urgent else self._others
            if len(requests) >= _REQUESTS:
                return False
            if service.shared:
                self._shared[service.name] = request
            item = Item(Kind.REQUEST, service.name, request, clock.monotonic_ns())
            requests.append(item)
        self.put(item)
        return True

    def _next_request(self) -> Item:
        """The request to serve now, an urgent one first; later ones do not share its answer."""
        with self._lock:
            item = (self._urgent or self._others).popleft()
            self._shared.pop(item.name, None)
        return item

    def _offer(self, kind: Kind, name: str, value: Any, key: str = "") -> None:
        """In the transport's thread: another process must not fill the memory."""
        if self._queue.qsize() < self._capacity:
            self._queue.put(Item(kind, name, value, clock.monotonic_ns(), key))
        else:
            self.overflowed += 1

    def _empty_channels(self) -> None:
        """Drops what the queue has as well: each message there keeps a buffer of the transport."""
        for channel in self._channels:
            while channel.try_recv() is not None:
                pass

    def _in_turn(self) -> Item | None:
        """An item of the channels if the last one was of the queue, and the other way round."""
        if self._queue_was_last or self._queue.empty():
            self._queue_was_last = False
            item = self._from_channels()
            if item is not None or self._queue.empty():
                return item
        self._queue_was_last = True
        return self.poll_queue()

    def _from_channels(self) -> Item | None:
        """The next message of those that are there, beginning with the topic after the last one."""
        channels = self._channels
        for _ in range(len(channels)):
            channel = channels[0]
            channels.rotate(-1)
            sample = channel.try_recv()
            if sample is not None:
                now_ns = clock.monotonic_ns()
                message = channel.decoder(sample.payload.to_bytes())
                return Item(Kind.MESSAGE, channel.name, message, now_ns)
        return None

    def _from_queue(self, timeout_s: float) -> Item | None:
        try:
            item = self._queue.get(timeout_s > 0, max(timeout_s, 0.0))
        except queue.Empty:
            return None
        if item.kind is Kind.MESSAGE:
            return item._replace(value=self._decoders[item.name](item.value))
        if item.kind is Kind.ALIVE:
            self.alive.add(item.name)
        elif item.kind is Kind.GONE:
            self.alive.discard(item.name)
        elif item.kind is Kind.REQUEST:
            return self._next_request()
        return item
