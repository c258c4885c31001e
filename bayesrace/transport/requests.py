"""The serving side of requests: what a process receives, and how it answers."""

import time
from collections.abc import Callable, Mapping
from typing import Any, Final

import zenoh

from bayesrace.errors import InputError
from bayesrace.messages import Message, Reply, Scalar, Service, car_key, decode, encode

__all__ = ["BUSY", "Request", "declare_service", "decode_request", "in_transport_thread"]

BUSY: Final = "busy: "
"""Beginning of the error that answers a rejected request."""


class Request:
    """A pending request; answer it once."""

    def __init__(self, service: Service[Any, Any], query: Any, max_bytes: int | None) -> None:
        """``max_bytes``: a longer payload is not copied, which would block other threads."""
        self.service = service
        self._query = query
        payload = query.payload
        self.size = 0 if payload is None else len(payload)
        """Bytes of the payload as sent."""
        fits = max_bytes is None or self.size <= max_bytes
        self.payload: bytes = payload.to_bytes() if payload is not None and fits else b""

    def answer(self, message: Message) -> None:
        """Send the answer; it is dropped if the client has gone."""
        self.answer_raw(encode(message))

    def reply(self, accepted: bool, text: str, data: Mapping[str, Scalar] | None = None) -> None:
        """Answer with a :class:`.Reply`."""
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
        self._end(lambda query: query.reply_err(BUSY + why))

    def _end(self, reply: Callable[[Any], None]) -> None:
        query, self._query = self._query, None
        try:
            reply(query)
        except zenoh.ZError:
            pass
        finally:
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

    def on_query(query: Any) -> None:
        on_request(Request(service, query, max_bytes))

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
