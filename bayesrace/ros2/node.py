"""A node of a ROS 2 network of rmw_zenoh, which publishes, subscribes, and is seen by its tools.

Its session is a Zenoh client of the network's router, apart from all sessions of ours.
"""

import json
import logging
import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from hashlib import blake2b
from itertools import count
from typing import Any, Final

import zenoh
import zenoh.ext

from bayesrace.errors import InputError
from bayesrace.messages import LARGEST_BYTES, Decoder
from bayesrace.ros2.naming import Topic, attachment, token
from bayesrace.ros2.settings import Ros2Settings
from bayesrace.ros2.types import TYPES, made
from bayesrace.transport.requests import in_transport_thread

__all__ = ["Node", "open_node"]

_log = logging.getLogger("bayesrace.ros2")

_CONNECT_S: Final = 2.0
_HEARTBEAT_S: Final = 0.5
"""Of rmw_zenoh's latched publishers, by which subscriptions notice a lost message."""
_EARLY: Final = 0.25
"""Share of a period by which a message may come early and be published."""


class _Reader(Decoder[Any]):
    """Decodes CDR by a topic's type, and lets ``read`` take the message."""

    def __init__(self, topic: Topic, read: Callable[[Any], None]) -> None:
        super().__init__(Any, _log)
        self._topic, self._read = topic, read

    def _decoded(self, data: bytes) -> Any:
        try:
            self._read(message := TYPES.deserialize_cdr(data, self._topic.kind))
        except Exception as error:  # of bytes from outside, by a library that is not ours
            text = f"{self._topic.name}: {type(error).__name__}: {error}"
            raise InputError(text[:200]) from None
        return message


class Node:
    """Publishers and subscriptions of one node, over an open session."""

    def __init__(self, session: Any, settings: Ros2Settings, name: str) -> None:
        self._session, self._settings = session, settings
        self._entity = str(session.info.zid()), settings.domain_id, settings.absolute(name)
        self._numbers = count()  # 0: the node
        self._declared: list[Any] = []
        """References: Zenoh undeclares what is no longer referenced."""
        self._readers: list[_Reader] = []
        self._announce()

    @property
    def refused(self) -> int:
        """Messages that could not be used."""
        return sum(one.refused for one in self._readers)

    def publisher(
        self, topic: str, kind: str, rate_hz: float = math.inf, latched: bool = False
    ) -> Callable[[Callable[[], dict[str, Any]]], None]:
        """Publishes messages of the fields that its argument makes (:func:`.made`), at most so
        often; at 0 never. ``latched``: later subscriptions get the newest, too."""
        if not rate_hz:
            return lambda _: None
        named = self._topic(topic, kind)
        key = named.key(self._settings.domain_id)
        if latched:
            misses = zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=_HEARTBEAT_S)
            publisher: Any = zenoh.ext.declare_advanced_publisher(
                self._session, key, cache=zenoh.ext.CacheConfig(1), publisher_detection=True,
                sample_miss_detection=misses,
            )  # fmt: skip
        else:
            publisher = self._session.declare_publisher(key)
        self._declared.append(publisher)
        # rmw_zenoh takes another hash of the token (XXH3); who receives only compares it.
        gid = blake2b(self._announce("MP", named, latched).encode(), digest_size=16).digest()
        numbers, period_s, due_s = count(1), 1 / rate_hz, 0.0

        def publish(fields: Callable[[], dict[str, Any]]) -> None:
            nonlocal due_s
            now_s = time.monotonic()
            if now_s >= due_s - _EARLY * period_s:
                due_s = max(due_s + period_s, now_s + period_s / 2)
                message = made(kind, **fields())
                data = bytes(TYPES.serialize_cdr(message, kind, little_endian=True))
                publisher.put(data, attachment=attachment(next(numbers), time.time_ns(), gid))

        return publish

    def subscribe(self, topic: str, kind: str, read: Callable[[Any], None]) -> None:
        """Calls ``read`` with each message, in the transport's thread.

        What is no such message, and what ``read`` raises an error at, is counted, and logged at a
        limited rate.
        """
        named = self._topic(topic, kind)
        self._readers.append(reader := _Reader(named, read))
        handler = in_transport_thread(lambda sample: reader(sample.payload.to_bytes()))
        key = named.key(self._settings.domain_id)
        self._declared.append(self._session.declare_subscriber(key, handler))
        self._announce("MS", named)

    def _topic(self, topic: str, kind: str) -> Topic:
        return Topic(self._settings.absolute(topic), kind, TYPES.hash_rihs01(kind))

    def _announce(self, entity: str = "NN", *of: Any) -> str:
        """Declares the token of the node, or of its publisher or subscription."""
        key = token(*self._entity, entity, next(self._numbers), *of)
        self._declared.append(self._session.liveliness().declare_token(key))
        return key


@contextmanager
def open_node(settings: Ros2Settings, name: str) -> Iterator[Node]:
    """A node over a session of its own, for the block; links that break are opened again.

    Raises InputError if there is no router at the settings' endpoint.
    """
    config = zenoh.Config()
    for key, value in {
        "mode": "client",
        "connect/endpoints": [settings.endpoint],
        "connect/timeout_ms": round(1e3 * _CONNECT_S),
        "scouting/multicast/enabled": False,
        "timestamping/enabled": True,  # without, no message is kept for later subscriptions
        "transport/link/rx/max_message_size": LARGEST_BYTES,  # longer ones are dropped
        "transport/shared_memory/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    remedy = "start 'ros2 run rmw_zenoh_cpp rmw_zenohd', or give its endpoint (--ros-endpoint)"
    try:
        session = zenoh.open(config)
    except zenoh.ZError:
        raise InputError(f"no router of a ROS network at {settings.endpoint}: {remedy}") from None
    with session:
        if not list(session.info.routers_zid()):
            raise InputError(f"{settings.endpoint} is no router, but a plant, say: {remedy}")
        yield Node(session, settings, name)
