"""A bad link: a relay between an endpoint of its own and another one, by TCP or UDP.

It delays and loses what passes, holds it up as a partition does, or breaks its connections. What is
lost by TCP arrives late, and holds up what comes after it; by UDP it does not arrive, and datagrams
overtake each other. It needs nothing of the system, where not every kernel emulates networks.
"""

import math
import queue
import random
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Final, NamedTuple

from bayesrace.transport.endpoints import address_of, free_endpoint

__all__ = ["IDEAL", "Link", "Relay", "Way"]

_AGAIN: Final = 4
"""After so many times the delay, two round trips, TCP sends again what was lost."""
_DATAGRAM: Final = 1 << 16

Receive = Callable[[], bytes]
Send = Callable[[bytes], object]


class Link(NamedTuple):
    """What happens to the messages of one direction."""

    delay_s: float = 0.0
    jitter_s: float = 0.0
    """Time on the way is uniform in ``delay_s`` ± ``jitter_s``."""
    loss: float = 0.0
    """Probability."""
    ordered: bool = True
    """As TCP: what is lost arrives later, and holds up what comes after it. Otherwise as UDP: it
    does not arrive, and later messages overtake earlier ones."""


IDEAL: Final = Link()


def _address(endpoint: str) -> tuple[str, int]:
    address = address_of(endpoint)
    return address.host, address.port


class Way:
    """One direction over a link."""

    def __init__(self, seed: str) -> None:
        self.link, self.lost = IDEAL, 0
        self._chance = random.Random(seed)  # noqa: S311 (no secret)

    def loses(self) -> bool:
        """Whether the next message is lost, which is counted."""
        lost = self._chance.random() < self.link.loss
        self.lost += lost
        return lost

    def way_s(self, lost: bool) -> float:
        """Time on the way, at least 0; of one that was ``lost`` until it has come once more."""
        link = self.link
        way_s = link.delay_s + self._chance.uniform(-link.jitter_s, link.jitter_s)
        return max(way_s + (_AGAIN * link.delay_s if lost else 0.0), 0.0)


class _RelayedWay(Way):
    """That can be held up."""

    def __init__(self, seed: str) -> None:
        super().__init__(seed)
        self.open = threading.Event()
        self.open.set()


class Relay:
    """Relays to the endpoint ``target`` whatever connects to :attr:`endpoint`.

    Directions: ``forth`` is from the target, ``back`` to it.
    """

    def __init__(self, target: str, bytes_per_s: float = math.inf) -> None:
        """``bytes_per_s``: how fast it takes what is sent by TCP, in each direction."""
        self._bytes_per_s = bytes_per_s
        self._protocol = target.partition("/")[0]
        self.endpoint = free_endpoint().replace("tcp", self._protocol)
        self._target = target
        self._lock = threading.Lock()
        self._sockets: list[socket.socket] = []
        self._listener: socket.socket | None = None
        self._ways = {name: _RelayedWay(name) for name in ("forth", "back")}
        self.join()

    def set(self, delay_s: float = 0.0, jitter_s: float = 0.0, loss: float = 0.0) -> None:
        """Of both directions: see :class:`Link`, whose order is that of the protocol."""
        for direction in self._ways:
            self.set_way(direction, Link(delay_s, jitter_s, loss))

    def set_way(self, direction: str, link: Link) -> None:
        """The same of one direction."""
        self._ways[direction].link = link

    def hold(self, direction: str = "") -> None:
        """Nothing gets through any more; both directions without one."""
        for way in self._chosen(direction):
            way.open.clear()

    def release(self, direction: str = "") -> None:
        """The end of that."""
        for way in self._chosen(direction):
            way.open.set()

    def _chosen(self, direction: str) -> list[_RelayedWay]:
        return [self._ways[direction]] if direction else list(self._ways.values())

    @property
    def lost(self) -> dict[str, int]:
        """Losses by direction."""
        return {name: way.lost for name, way in self._ways.items()}

    def join(self) -> None:
        """Listen (again)."""
        if self._protocol == "udp":
            self._relay_datagrams()
            return
        self._listener = socket.create_server(_address(self.endpoint))
        threading.Thread(target=self._accept, args=(self._listener,), daemon=True).start()

    def cut(self) -> None:
        """Break all connections; new ones are refused."""
        self.release()
        if self._listener is not None:
            # Closing alone would not wake the thread that accepts.
            with suppress(OSError):
                self._listener.shutdown(socket.SHUT_RDWR)
            self._listener.close()
        self._listener = None
        with self._lock:
            broken, self._sockets = self._sockets, []
        for one in broken:
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)

    def __enter__(self) -> "Relay":
        return self

    def __exit__(self, *_: object) -> None:
        self.cut()

    def _accept(self, listener: socket.socket) -> None:
        with suppress(OSError):
            while True:
                near, _ = listener.accept()
                try:
                    far = socket.create_connection(_address(self._target))
                except OSError:
                    near.close()
                    continue
                with self._lock:
                    self._sockets += [near, far]
                self._relay_bytes("back", near, far)
                self._relay_bytes("forth", far, near)

    def _relay_bytes(self, direction: str, source: socket.socket, sink: socket.socket) -> None:
        source.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        slow = math.isfinite(self._bytes_per_s)

        def receive() -> bytes:
            data = source.recv(1 << (10 if slow else 16))
            time.sleep(len(data) / self._bytes_per_s)
            return data

        def end() -> None:
            for one in (source, sink):
                with suppress(OSError):
                    one.shutdown(socket.SHUT_RDWR)
            source.close()

        self._start(direction, receive, sink.sendall, end)

    def _relay_datagrams(self) -> None:
        """For one client, the last that has sent something."""
        near, far = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        near.bind(_address(self.endpoint))
        far.bind(("127.0.0.1", 0))
        self._sockets += [near, far]
        client: list[tuple[str, int]] = []

        def from_client() -> bytes:
            data, sender = near.recvfrom(_DATAGRAM)
            client[:] = [sender]
            return data

        target = _address(self._target)
        self._pass_on("back", from_client, lambda data: far.sendto(data, target))
        self._pass_on("forth", lambda: far.recv(_DATAGRAM), lambda data: near.sendto(data, *client))

    def _pass_on(self, direction: str, receive: Receive, send: Send) -> None:
        """Each datagram takes its own time."""
        way = self._ways[direction]

        def deliver(data: bytes) -> None:
            with suppress(OSError):  # the relay is gone
                send(data)

        def take() -> None:
            with suppress(OSError):
                while data := receive():
                    if not way.loses() and way.open.is_set():
                        later = threading.Timer(way.way_s(lost=False), deliver, (data,))
                        later.daemon = True
                        later.start()

        threading.Thread(target=take, daemon=True).start()

    def _start(self, direction: str, receive: Receive, send: Send, end: Callable[[], None]) -> None:
        """Relays a stream in its order, until there is nothing to receive any more."""
        way, waiting = self._ways[direction], queue.Queue[tuple[float, bytes]](10_000)

        def take() -> None:
            due_s = 0.0
            with suppress(OSError):
                while data := receive():
                    due_s = max(due_s, time.monotonic() + way.way_s(way.loses()))
                    waiting.put((due_s, data))
            waiting.put((0.0, b""))

        def deliver() -> None:
            with suppress(OSError):
                while True:
                    due_s, data = waiting.get()
                    if not data:
                        break
                    time.sleep(max(due_s - time.monotonic(), 0.0))
                    way.open.wait()
                    send(data)
            end()

        for work in (take, deliver):
            threading.Thread(target=work, daemon=True).start()
