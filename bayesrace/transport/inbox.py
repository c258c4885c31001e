"""One place where a thread waits for everything that can happen to it, with a time limit.

Each topic has a channel of Zenoh's own, which the waiting thread reads itself: one hand-over
between threads less than a callback that fills a queue, which halves the round trip (docs/
decisions/). Requests, the coming and going of other processes and signals are put into a queue by
callbacks. No call waits for several channels and a queue, so the thread looks at all of them and
sleeps between two looks: 0.05 ms at first, longer the longer it has waited.
"""

import logging
import os
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from enum import Enum
from typing import Any, Final, NamedTuple, TypeVar

import zenoh

from bayesrace.errors import InputError
from bayesrace.interrupts import catching_signals
from bayesrace.messages import (
    ALIVE,
    Decoder,
    Message,
    Service,
    Topic,
    car_key,
    decode,
    encode,
)

__all__ = [
    "BUSY",
    "LOCKSTEP_SPIN_S",
    "NEWEST",
    "Inbox",
    "Item",
    "Kind",
    "Request",
    "declare_service",
    "decode_request",
]

M = TypeVar("M", bound=Message)

_CAPACITY: Final = 10_000
"""Items, and messages of a topic, waiting at most; a thread this far behind is broken, and memory
must not follow it. A full channel holds back the senders: those of the wall clock drop, by the
table."""

_REQUESTS: Final = 16
"""At most so many requests wait; more are turned away, so that no backlog builds up."""

BUSY: Final = "busy: "
"""How the error begins that ends a request which is turned away."""

NEWEST: Final = 1024
"""Messages of the control path that wait at most: a thread this far behind wants the newest."""

LOCKSTEP_SPIN_S: Final = 0.002
"""How long a lockstep peer looks for the answer before it sleeps. Waking an idle CPU takes longer
than the answer: measured, the round trip falls from 270 to 90 us."""

_POLL_S: Final = 5e-5
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


class Request:
    """A request under way; answer it once."""

    def __init__(
        self, service: Service[Any, Any], query: Any, most_bytes: int | None = None
    ) -> None:
        """``most_bytes``: a longer payload is not copied, which would hold up other threads."""
        self.service = service
        self._query = query
        payload = query.payload
        self.size = 0 if payload is None else len(payload)
        """Bytes that were sent."""
        fits = most_bytes is None or self.size <= most_bytes
        self.payload: bytes = payload.to_bytes() if payload is not None and fits else b""

    def message(self) -> Any:
        """The decoded request; InputError if it is not a valid one."""
        if self.service.request is None:
            raise TypeError(f"the payload of '{self.service.name}' is not a message")
        return decode(self.service.request, self.payload)

    def answer(self, message: Message) -> None:
        """Send the answer; one that nobody waits for any more is dropped."""
        self.answer_raw(encode(message))

    def answer_raw(self, data: bytes) -> None:
        """The same where the answer is not a message."""
        self._end(lambda query: query.reply(query.key_expr, data))

    def turn_away(self, why: str) -> None:
        """Ends the request with an error in place of an answer: busy, and ``why``."""
        self._end(lambda query: query.reply_err(BUSY + why))

    def _end(self, reply: Callable[[Any], None]) -> None:
        query, self._query = self._query, None
        try:
            reply(query)
        except zenoh.ZError:
            pass
        finally:
            query.drop()


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


class _Stream(NamedTuple):
    """One topic as it arrives."""

    name: str
    key: str
    channel: Any
    decoder: Decoder[Any]


class Inbox:
    """Items for one thread. Declare what may arrive, then :meth:`get`.

    What is declared lives as long as the inbox, so keep it.
    """

    def __init__(self, session: Any, car: str) -> None:
        self._session = session
        self._car = car
        self._items: queue.SimpleQueue[Item] = queue.SimpleQueue()
        self._declared: list[Any] = []
        self._streams: deque[_Stream] = deque()
        """In the order in which they are looked at next."""
        self._stamping = False
        self.alive: set[str] = set()
        """Sources whose liveliness token is there, as of the items taken so far."""
        self._room = threading.Semaphore(_REQUESTS)
        self.overflowed = 0
        """Items lost because nobody took them."""
        self.turned_away = 0
        """Requests that were not answered because too many waited."""
        self.spin_s = 0.0
        """How long :meth:`get` polls before it sleeps; 0 wherever others need the CPU."""

    def subscribe(
        self,
        topic: Topic[M],
        source: str = "*",
        newest: int | None = None,
        logger: logging.Logger | None = None,
    ) -> Decoder[M]:
        """Let the topic's messages arrive, decoded, under the topic's name; any number of topics.

        ``newest``: of those waiting, only so many are kept, the newest; the others are let go.
        Returns the topic's decoder, which counts what it refuses; ``logger`` as in
        :class:`Decoder`.
        """
        key = car_key(topic.key, self._car, source)
        channel: Any = zenoh.handlers.FifoChannel(_CAPACITY)
        if newest is not None:
            channel = zenoh.handlers.RingChannel(newest)
        subscriber = self._session.declare_subscriber(key, channel)
        decoder = Decoder(topic.message, logger)
        self._declared.append(subscriber)
        self._streams.append(_Stream(topic.name, key, subscriber.handler, decoder))
        return decoder

    def serve(self, service: Service[Any, Any], source: str = "") -> None:
        """Let the service's requests arrive; what comes when many wait is turned away, counted."""

        def arrived(request: Request) -> None:
            if not self._room.acquire(blocking=False):
                self.turned_away += 1
                request.turn_away(f"{_REQUESTS} requests wait already")
                return
            self._enqueue(Item(Kind.REQUEST, service.name, request, time.monotonic_ns()))

        self._declared.append(
            declare_service(self._session, service, self._car, arrived, source=source)
        )

    def announce(self, source: str) -> None:
        """Declare own liveliness token: last, when everything else is in place."""
        token = self._session.liveliness().declare_token(car_key(ALIVE, self._car, source))
        self._declared.append(token)

    def watch(self, source: str) -> None:
        """Let the coming and going of another process arrive, its presence now included."""

        def on_token(sample: Any) -> None:
            there = sample.kind == zenoh.SampleKind.PUT
            kind = Kind.ALIVE if there else Kind.GONE
            self._enqueue(Item(kind, source, None, time.monotonic_ns()))

        key = car_key(ALIVE, self._car, source)
        self._declared.append(
            self._session.liveliness().declare_subscriber(key, _direct(on_token), history=True)
        )

    @contextmanager
    def catching_signals(self) -> Iterator[None]:
        """For the block, let SIGINT and SIGTERM arrive as items; nothing off the main thread."""

        def arrived(number: int) -> None:
            self._items.put(Item(Kind.SIGNAL, "", number, time.monotonic_ns()))

        with catching_signals(arrived):
            yield

    def get(self, timeout_s: float = 0.0) -> Item | None:
        """The next item, the topics in turn; None if nothing arrives in time."""
        if self._stamping:
            self._empty_channels()
        if self._stamping or not self._streams:
            return self._from_queue(timeout_s)
        begin = time.monotonic()
        while True:
            item = self._from_channels() if self._items.empty() else self.other()
            if item is not None:
                return item
            waited_s = time.monotonic() - begin
            if waited_s >= timeout_s:
                return None
            if waited_s < self.spin_s:
                os.sched_yield()  # the thread that receives may be waiting for this very CPU
                continue
            sleep_s = min(max(_SHARE * waited_s, _POLL_S), _IDLE_S)
            time.sleep(min(sleep_s, timeout_s - waited_s))

    def poll(self, until_ns: int) -> Item | None:
        """The next message, looked for until the monotonic clock says ``until_ns``.

        For fixed-rate loops: wakes to the tenth of a millisecond without another thread's help, and
        leaves the CPU to the thread that brings the message (docs/decisions/). Looks at least once.
        """
        while (item := self._from_channels()) is None:
            if time.monotonic_ns() >= until_ns:
                return None
            time.sleep(_POLL_S)
        return item

    def other(self) -> Item | None:
        """The next item that is no message, of those that are there; does not wait."""
        return self._from_queue(0.0)

    @contextmanager
    def stamped(self) -> Iterator[None]:
        """For the block, the transport's own thread takes the messages as they arrive, so that
        ``received_ns`` is right even if the owner sleeps meanwhile."""

        def stamping(name: str) -> Any:
            def on_sample(sample: Any) -> None:
                data: bytes = sample.payload.to_bytes()
                self._enqueue(Item(Kind.MESSAGE, name, data, time.monotonic_ns()))

            return _direct(on_sample)

        self._stamping = True
        try:
            with ExitStack() as stack:
                for stream in self._streams:
                    subscriber = self._session.declare_subscriber(stream.key, stamping(stream.name))
                    stack.callback(subscriber.undeclare)
                yield
        finally:
            self._empty_channels()
            self._stamping = False

    def _empty_channels(self) -> None:
        """Lets go of what was stamped: each message there keeps a buffer of the transport's."""
        for stream in self._streams:
            while stream.channel.try_recv() is not None:
                pass

    def _from_channels(self) -> Item | None:
        """The next message of those that are there, beginning with the topic after the last one."""
        streams = self._streams
        for _ in range(len(streams)):
            stream = streams[0]
            streams.rotate(-1)
            sample = stream.channel.try_recv()
            if sample is not None:
                now_ns = time.monotonic_ns()
                message = stream.decoder(sample.payload.to_bytes())
                return Item(Kind.MESSAGE, stream.name, message, now_ns)
        return None

    def _from_queue(self, timeout_s: float) -> Item | None:
        try:
            item = self._items.get(timeout_s > 0, max(timeout_s, 0.0))
        except queue.Empty:
            return None
        if item.kind is Kind.MESSAGE:
            decoder = next(one.decoder for one in self._streams if one.name == item.name)
            return item._replace(value=decoder(item.value))
        if item.kind is Kind.ALIVE:
            self.alive.add(item.name)
        elif item.kind is Kind.GONE:
            self.alive.discard(item.name)
        elif item.kind is Kind.REQUEST:
            self._room.release()
        return item

    def _enqueue(self, item: Item) -> None:
        """From another thread."""
        if self._items.qsize() >= _CAPACITY:
            self.overflowed += 1
            return
        self._items.put(item)


def _direct(callback: Callable[[Any], None]) -> Any:
    """Run on the receiving thread: a second hand-over would cost as much as the network."""
    return zenoh.handlers.Callback(callback, indirect=False)


def declare_service(
    session: Any,
    service: Service[Any, Any],
    car: str,
    on_request: Callable[[Request], None],
    most_bytes: int | None = None,
    source: str = "",
) -> Any:
    """Calls ``on_request`` with each request in the transport's own thread, so it must be quick.

    For a thread that has no inbox. Keep what is returned; ``most_bytes`` as in :class:`Request`.
    """

    def on_query(query: Any) -> None:
        on_request(Request(service, query, most_bytes))

    return session.declare_queryable(car_key(service.key, car, source), _direct(on_query))


def decode_request(request: Request) -> tuple[Any, str]:
    """The request's message and "", or None and why it is refused."""
    try:
        return request.message(), ""
    except InputError as error:
        return None, str(error)
