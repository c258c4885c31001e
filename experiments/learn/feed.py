"""Everything that can happen to the learning job, in one queue for its one thread."""

import queue
from collections.abc import Callable, Iterator
from enum import Enum
from typing import Any, Final, NamedTuple

import zenoh

from bayesrace.messages import ACTUATION, ALIVE, EVENT, STATE, TELEMETRY, Topic, car_key

__all__ = ["Feed", "Item", "What"]

_CAPACITY: Final = 20_000
"""Messages that wait at most; what comes beyond is lost, and shows as a gap in the samples."""


class What(Enum):
    """What an item tells."""

    STATE = "state"
    TELEMETRY = "telemetry"
    ACTUATION = "actuation"
    EVENT = "event"
    PRESENCE = "presence"
    """``value``: (source, whether it is there)."""
    OUTCOME = "outcome"
    """``value``: what :mod:`.trainer` gives."""
    ANSWER = "answer"
    """``value``: what :mod:`.desk` made of the controller's answer."""
    END = "end"
    """A signal to end."""


class Item(NamedTuple):
    """Something that happened."""

    what: What
    value: Any


_TOPICS: Final[dict[What, Topic[Any]]] = {
    What.STATE: STATE,
    What.TELEMETRY: TELEMETRY,
    What.ACTUATION: ACTUATION,
    What.EVENT: EVENT,
}


class Feed:
    """Follows one car over an open session; :meth:`put` adds what comes from elsewhere.

    In the transport's threads messages are only queued, as bytes: following a car costs its plant
    and its controller one more receiver, no more.
    """

    def __init__(self, session: Any, car: str) -> None:
        self._items: queue.SimpleQueue[Item] = queue.SimpleQueue()
        self.lost = 0
        """Messages that found no room."""
        self._declared = [
            session.declare_subscriber(car_key(topic.key, car, "*"), self._taking(what))
            for what, topic in _TOPICS.items()
        ]
        for source in ("plant", "controller"):
            self._declared.append(
                session.liveliness().declare_subscriber(
                    car_key(ALIVE, car, source), self._noting(source), history=True
                )
            )

    def put(self, what: What, value: Any = None) -> None:
        """From any thread, and from signal handlers."""
        self._items.put(Item(what, value))

    def next(self, timeout_s: float) -> Item | None:
        """The next item; None if nothing happens in time."""
        try:
            return self._items.get(timeout=timeout_s)
        except queue.Empty:
            return None

    def waiting(self) -> Iterator[Item]:
        """The items that are there by now, without those that come meanwhile."""
        for _ in range(self._items.qsize()):
            yield self._items.get()

    def _taking(self, what: What) -> Any:
        def on_sample(sample: Any) -> None:
            if self._items.qsize() >= _CAPACITY:
                self.lost += 1
            else:
                self.put(what, sample.payload.to_bytes())

        return _direct(on_sample)

    def _noting(self, source: str) -> Any:
        def on_token(sample: Any) -> None:
            self.put(What.PRESENCE, (source, sample.kind == zenoh.SampleKind.PUT))

        return _direct(on_token)


def _direct(callback: Callable[[Any], None]) -> Any:
    return zenoh.handlers.Callback(callback, indirect=False)
