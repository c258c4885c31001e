"""One place where a thread waits for everything that can happen to it, with a time limit.

Messages, requests, the coming and going of other processes, and signals arrive as items of one
queue, in order. Zenoh's channels have no receive with a time limit, so the items are put there by
callbacks that run on the receiving thread and do nothing else; measured, that is as fast.
"""

import queue
import signal
import time
from collections.abc import Callable
from enum import Enum
from types import FrameType
from typing import Any, Final, NamedTuple

import zenoh

from bayesrace.errors import InputError
from bayesrace.messages import (
    ALIVE,
    Message,
    Service,
    Topic,
    car_key,
    decode,
    encode,
)

__all__ = ["Inbox", "Item", "Kind", "Request", "decode_request"]

_CAPACITY: Final = 100_000
"""Items waiting at most; a thread this far behind is broken, and memory must not follow it."""


class Kind(Enum):
    """What an item is."""

    MESSAGE = "message"
    REQUEST = "request"
    ALIVE = "alive"
    GONE = "gone"
    SIGNAL = "signal"


class Request:
    """A request under way; answer it once."""

    def __init__(self, service: Service[Any, Any], query: Any) -> None:
        self.service = service
        self._query = query
        payload = query.payload
        self.payload: bytes = b"" if payload is None else payload.to_bytes()

    def message(self) -> Any:
        """The decoded request; InputError if it is not a valid one."""
        if self.service.request is None:
            raise TypeError(f"the payload of '{self.service.name}' is not a message")
        return decode(self.service.request, self.payload)

    def answer(self, message: Message) -> None:
        """Send the answer; one that nobody waits for any more is dropped."""
        query, self._query = self._query, None
        try:
            query.reply(query.key_expr, encode(message))
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
    """MESSAGE: bytes; REQUEST: :class:`Request`; SIGNAL: its number; else None."""
    received_ns: int
    """Own monotonic clock on arrival."""


class Inbox:
    """Items for one thread. Declare what may arrive, then :meth:`get`.

    What is declared lives as long as the inbox, so keep it; the session must be closed (``with``),
    or the process would not end.
    """

    def __init__(self, session: Any, car: str) -> None:
        self._session = session
        self._car = car
        self._items: queue.SimpleQueue[Item] = queue.SimpleQueue()
        self._declared: list[Any] = []
        self.alive: set[str] = set()
        """Sources whose liveliness token is there, as of the items taken so far."""
        self.overflowed = 0
        """Items lost because nobody took them."""

    def subscribe(self, topic: Topic[Any], source: str = "*") -> None:
        """Let the topic's messages arrive, as bytes, under the topic's name."""
        key = car_key(topic.key, self._car, source)
        handler = _direct(self._putter(Kind.MESSAGE, topic.name, _payload))
        self._declared.append(self._session.declare_subscriber(key, handler))

    def serve(self, service: Service[Any, Any], source: str = "") -> None:
        """Let the service's requests arrive."""
        key = car_key(service.key, self._car, source)
        handler = _direct(
            self._putter(Kind.REQUEST, service.name, lambda query: Request(service, query))
        )
        self._declared.append(self._session.declare_queryable(key, handler))

    def announce(self, source: str) -> None:
        """Declare own liveliness token: last, when everything else is in place."""
        token = self._session.liveliness().declare_token(car_key(ALIVE, self._car, source))
        self._declared.append(token)

    def watch(self, source: str) -> None:
        """Let the coming and going of another process arrive, its presence now included."""
        items = self._items

        def on_token(sample: Any) -> None:
            there = sample.kind == zenoh.SampleKind.PUT
            items.put(Item(Kind.ALIVE if there else Kind.GONE, source, None, time.monotonic_ns()))

        key = car_key(ALIVE, self._car, source)
        self._declared.append(
            self._session.liveliness().declare_subscriber(key, _direct(on_token), history=True)
        )

    def catch_signals(self) -> None:
        """Let SIGINT and SIGTERM arrive as items; main thread only."""

        def on_signal(number: int, _frame: FrameType | None) -> None:
            self._items.put(Item(Kind.SIGNAL, "", number, time.monotonic_ns()))

        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, on_signal)

    def get(self, timeout_s: float = 0.0) -> Item | None:
        """The next item; None if nothing arrives in time."""
        try:
            item = self._items.get(timeout_s > 0, timeout_s)
        except queue.Empty:
            return None
        if item.kind is Kind.ALIVE:
            self.alive.add(item.name)
        elif item.kind is Kind.GONE:
            self.alive.discard(item.name)
        return item

    def _putter(self, kind: Kind, name: str, convert: Callable[[Any], Any]) -> Any:
        items = self._items

        def on_arrival(thing: Any) -> None:
            if items.qsize() >= _CAPACITY:
                self.overflowed += 1
                return
            items.put(Item(kind, name, convert(thing), time.monotonic_ns()))

        return on_arrival


def _payload(sample: Any) -> bytes:
    content: bytes = sample.payload.to_bytes()
    return content


def _direct(callback: Callable[[Any], None]) -> Any:
    """Run on the receiving thread: a second hand-over would cost as much as the network."""
    return zenoh.handlers.Callback(callback, indirect=False)


def decode_request(request: Request) -> tuple[Any, str]:
    """The request's message and "", or None and why it is refused."""
    try:
        return request.message(), ""
    except InputError as error:
        return None, str(error)
