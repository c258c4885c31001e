"""A TCP connection that can be broken: a relay between a port of its own and another one."""

import math
import socket
import threading
import time
from contextlib import suppress

from bayesrace.transport import free_endpoint

__all__ = ["Proxy"]


def _address(endpoint: str) -> tuple[str, int]:
    host, port = endpoint.removeprefix("tcp/").rsplit(":", 1)
    return host, int(port)


class Proxy:
    """Relays to the endpoint ``target`` whatever connects to :attr:`endpoint`."""

    def __init__(self, target: str, bytes_per_s: float = math.inf) -> None:
        """``bytes_per_s``: how fast it takes what is sent, in each direction."""
        self._bytes_per_s = bytes_per_s
        self.endpoint = free_endpoint()
        self._target = target
        self._lock = threading.Lock()
        self._sockets: list[socket.socket] = []
        self._listener: socket.socket | None = None
        self.join()

    def join(self) -> None:
        """Listen (again)."""
        self._listener = socket.create_server(_address(self.endpoint))
        threading.Thread(target=self._accept, args=(self._listener,), daemon=True).start()

    def cut(self) -> None:
        """Break all connections; new ones are refused."""
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

    def __enter__(self) -> "Proxy":
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
                for source, sink in ((near, far), (far, near)):
                    source.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    threading.Thread(target=self._relay, args=(source, sink), daemon=True).start()

    def _relay(self, source: socket.socket, sink: socket.socket) -> None:
        slow = math.isfinite(self._bytes_per_s)
        with suppress(OSError):
            while data := source.recv(1 << (10 if slow else 16)):
                sink.sendall(data)
                time.sleep(len(data) / self._bytes_per_s)
        for one in (source, sink):
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
        source.close()
