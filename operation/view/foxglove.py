"""The same view in Foxglove, Lichtblick and what else speaks Foxglove's WebSocket protocol: the
topics of a log, as they come."""

import json
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import foxglove

from bayesrace.errors import InputError
from bayesrace.log import Entry
from bayesrace.messages import json_schema, to_json
from bayesrace.scene import Scene, schema_name, schema_text

__all__ = ["FoxgloveView", "serve"]


class FoxgloveView(foxglove.ServerListener):  # type: ignore[misc]  # the package has no types here
    """What viewers are sent. A slow one loses the oldest messages, and holds up nobody."""

    def __init__(self) -> None:
        self.context = foxglove.Context()
        self.port = 0
        self._scene: Scene | None = None
        self._channels: dict[str, foxglove.Channel] = {}
        self._asked = threading.Event()
        """A viewer has begun to look at a topic, and needs what is constant."""

    def on_subscribe(self, client: Any, channel: Any) -> None:
        """Called in a thread of the server."""
        self._asked.set()

    def show(self, scene: Scene | None) -> None:
        """What follows is drawn in this scene; None: it is not drawn."""
        self._scene = scene

    def take(self, entries: Iterable[Entry[Any]]) -> None:
        """New messages, which viewers are sent as they are, and drawn."""
        for entry in entries:
            kind, time_ns = type(entry.message), entry.log_time_ns
            channel = self._channel(entry.key, kind.__name__, partial(_schema_of, kind))
            if channel.has_sinks():  # else nobody looks at the topic
                channel.log(to_json(entry.message), log_time=time_ns)
            if self._scene is None:
                continue
            if self._asked.is_set():
                self._asked.clear()
                self._scene.begin()
            for drawn in self._scene.of(entry.key, entry.message, time_ns):
                of = type(drawn.message)
                channel = self._channel(drawn.topic, schema_name(of), partial(schema_text, of))
                if channel.has_sinks():
                    channel.log(drawn.json, log_time=time_ns)

    def _channel(self, topic: str, name: str, schema: Callable[[], bytes]) -> foxglove.Channel:
        if topic not in self._channels:
            self._channels[topic] = foxglove.Channel(
                topic,
                schema=foxglove.Schema(name=name, encoding="jsonschema", data=schema()),
                message_encoding="json",
                context=self.context,
            )
        return self._channels[topic]

    def close(self) -> None:
        """Its topics are there no more."""
        for channel in self._channels.values():
            channel.close()


def _schema_of(kind: Any) -> bytes:
    return json.dumps(json_schema(kind)).encode()


@contextmanager
def serve(host: str, port: int) -> Iterator[FoxgloveView]:
    """Viewers connect to ``ws://host:port`` for the block; port 0: any that is free.

    Who connects may look on, and nothing else: keep ``host`` a loopback address where others share
    the network. InputError if the address cannot be used.
    """
    view = FoxgloveView()
    try:
        server = foxglove.start_server(
            name="bayesrace", host=host, port=port, server_listener=view, context=view.context
        )
    except (RuntimeError, OverflowError) as error:
        raise InputError(
            f"cannot serve Foxglove at {host}:{port}: {error}; give an address of this machine and "
            "a free port"
        ) from None
    view.port = int(server.port)
    try:
        yield view
    finally:
        view.close()
        server.stop()
