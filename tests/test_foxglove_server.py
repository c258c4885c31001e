"""A live view over Foxglove's WebSocket protocol: who connects sees the car, also later on."""

import json
import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from bayesrace.errors import InputError
from bayesrace.log import Entry
from bayesrace.messages import Telemetry, to_json
from bayesrace.operation.view.foxglove import serve
from bayesrace.scene import Scene
from bayesrace.tracks import load_track
from bayesrace.vehicles import get_car
from benchmarks.harness import resident_bytes
from tests import sample_messages as messages
from tests.driven import blank
from tests.programs import until

pytestmark = pytest.mark.wall_clock

HOST, PATIENCE_S = "127.0.0.1", 20.0


@contextmanager
def driving() -> Iterator[int]:
    """A car that drives along x at 50 Hz, served; the port."""
    over = threading.Event()
    with serve(HOST, 0) as view:
        view.show(Scene(get_car("orca"), load_track("harbour")))

        def drive() -> None:
            seq = 0
            while not over.wait(0.02):
                seq, now_ns = seq + 1, time.time_ns()
                state = messages.state(seq, x=(0.001 * seq, *(0.0,) * 6))
                view.take([Entry("bayesrace/orca/state", now_ns, now_ns, state)])

        thread = threading.Thread(target=drive)
        thread.start()
        try:
            yield view.port
        finally:
            over.set()
            thread.join()


class Viewer:
    """What a viewer does: it subscribes to all topics, as they are advertised."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self.schemas: dict[str, tuple[str, str, str]] = {}
        self._topics: dict[int, str] = {}

    def messages(self) -> Iterator[tuple[str, int, dict[str, Any]]]:
        """Topic, time and content, for as long as any are awaited."""
        give_up_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < give_up_s:
            got = self._socket.recv(timeout=PATIENCE_S)
            if isinstance(got, bytes):
                code, number, time_ns = struct.unpack_from("<BIQ", got)
                assert code == 1
                yield self._topics[number], time_ns, json.loads(got[13:])
            elif (told := json.loads(got))["op"] == "advertise":
                for one in told["channels"]:
                    self._topics[one["id"]] = one["topic"]
                    form = one["encoding"], one["schemaName"], one["schemaEncoding"]
                    self.schemas[one["topic"]] = form
                    self._subscribe(one["id"])
            elif told["op"] == "status":
                # foxglove-sdk 0.30 advertises a channel a moment before it can be subscribed to.
                text, _, number = told["message"].partition(": ")
                assert text == "Unknown channel ID"
                time.sleep(0.02)
                self._subscribe(int(number))
        raise AssertionError(f"not all has come; there are {sorted(self.schemas)}")

    def _subscribe(self, number: int) -> None:
        wanted = [{"id": number, "channelId": number}]
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))


@contextmanager
def viewer(port: int) -> Iterator[Viewer]:
    with connect(f"ws://{HOST}:{port}", subprotocols=["foxglove.sdk.v1"]) as socket:
        yield Viewer(socket)


def test_each_viewer_sees_scene_and_messages() -> None:
    with driving() as port:
        for _ in range(2):  # the second one comes when all that is constant has been sent
            with viewer(port) as one:
                wanted = {"scene/track", "scene/orca/car", "scene/orca/transform"}
                wanted |= {"scene/orca/pose", "bayesrace/orca/state"}
                found: dict[str, dict[str, Any]] = {}
                for topic, time_ns, content in one.messages():
                    assert abs(time_ns - time.time_ns()) < PATIENCE_S * 1e9
                    found[topic] = content
                    if wanted <= found.keys():
                        break
                assert one.schemas["scene/track"] == ("json", "foxglove.SceneUpdate", "jsonschema")
                assert one.schemas["bayesrace/orca/state"] == ("json", "State", "jsonschema")
                assert found["scene/track"]["entities"][0]["lines"]
                moved = found["scene/orca/transform"]["transforms"][0]["translation"]
                state = found["bayesrace/orca/state"]["x"]
                assert (moved["y"], state["y"]) == (0.0, 0.0)
                assert moved["x"] == pytest.approx(state["x"], abs=0.1)


def test_what_cannot_be_served_is_named() -> None:
    with driving() as port:
        for place in ((HOST, port), (HOST, 80_000), ("nowhere.invalid", 0)):
            with (
                pytest.raises(InputError, match=rf"cannot serve Foxglove at {place[0]}:{place[1]}"),
                serve(*place),
            ):
                pass


def test_nothing_is_left_of_a_view() -> None:
    """Its port is free a moment later: foxglove-sdk's stop does not wait."""

    def served(port: int) -> int:
        with suppress(InputError), serve(HOST, port) as view:
            return view.port
        return 0

    port = served(0)
    until(lambda: served(port) == port, "the port is free")


def test_a_viewer_that_reads_nothing_holds_up_nobody_and_bounded_memory() -> None:
    """foxglove-sdk keeps 1,024 messages for a viewer, and then loses the oldest."""
    plan = tuple(np.random.default_rng(1).normal(size=7 * 400).tolist())
    message = blank(Telemetry, plan_x=plan)
    size, begun, told = len(to_json(message)), threading.Event(), threading.Event()
    with serve(HOST, 0) as view, ExitStack() as stack:

        def send(time_ns: int = 1) -> None:
            view.take([Entry("bayesrace/orca/telemetry", time_ns, time.time_ns(), message)])

        def read(link: ClientConnection) -> None:
            with suppress(ConnectionClosed):
                for data in link:
                    if isinstance(data, bytes) and struct.unpack_from("<BIQ", data)[2] == 2:
                        told.set()

        def send_until_subscribed() -> None:
            while not begun.wait(0.01):
                send()

        def subscribed() -> ClientConnection:
            raw = socket.socket()
            raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            raw.connect((HOST, view.port))
            link = stack.enter_context(
                connect(f"ws://{HOST}:{view.port}", sock=raw, subprotocols=["foxglove.sdk.v1"],
                        max_queue=1, ping_interval=None, close_timeout=0.1)
            )  # fmt: skip
            next(Viewer(link).messages())
            return link

        sender = threading.Thread(target=send_until_subscribed)
        sender.start()
        try:
            subscribed()  # and reads no more
            quick = subscribed()
        finally:
            begun.set()
            sender.join()
        threading.Thread(target=read, args=(quick,), daemon=True).start()
        before = resident_bytes("self")
        for _ in range(4000):
            send()
        held = resident_bytes("self") - before
        send(time_ns=2)
        until(told.is_set, "another viewer is still told")
    assert held < 2.5 * 1024 * size < 0.7 * 4000 * size
