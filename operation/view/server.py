"""The page over HTTP, and what is new for it over a WebSocket, on one port of this machine.

Each page has a thread of its own, which sends what the page has not seen yet, then looks again. A
page that takes its messages slowly is told more at once, later: nothing queues up for it. One that
takes none is left, and can connect again.
"""

import http
import logging
import secrets
import socket
import struct
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any, Final, Self
from urllib.parse import parse_qs, urlsplit

import msgspec
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.server import Server, ServerConnection, serve

from bayesrace.errors import InputError
from bayesrace.log import Entry
from bayesrace.operation.view.page import whole_page
from bayesrace.operation.view.sources import Source

__all__ = ["Viewer", "in_url"]

_LOOK_S: Final = 0.1
"""Between two looks for what is new."""
_QUIET_S: Final = 3.0
"""A page is told something at least so often, if only nothing: it knows a dead link by that."""
_PATIENCE_S: Final = 20
"""With a page that takes not a byte of what waits for it."""
_MOST_PAGES: Final = 32
_POLICY: Final = (
    "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; "
    "connect-src 'self'; form-action 'none'; base-uri 'none'; frame-ancestors 'none'"
)
_LOCAL: Final = ("127.0.0.1", "localhost", "::1")


def in_url(host: str) -> str:
    """A host as it stands in an address: of IPv6, in brackets."""
    return f"[{host}]" if ":" in host else host


class Viewer:
    """Serves a source, which may be replaced, until the end of the block."""

    def __init__(self, host: str = "127.0.0.1", port: int = 8866) -> None:
        """InputError if the port cannot be listened on. Beyond loopback a page needs the token
        that is in :attr:`address`."""
        self._lock, self._number = threading.Lock(), 0
        self._source: Source | None = None
        self._token = "" if host in _LOCAL else secrets.token_urlsafe(16)
        self._places = threading.BoundedSemaphore(_MOST_PAGES)
        # Each message whole: a page shows all of it at once, or nothing.
        limits = {"max_size": 1 << 12, "max_queue": 4, "compression": None}
        where = {
            "family": socket.AF_INET6 if ":" in host else socket.AF_INET,
            "dualstack_ipv6": host == "::" and socket.has_dualstack_ipv6(),
        }
        try:
            self._server: Server = serve(
                self._told, host, port, process_request=self._answered, **limits, **where
            )
        except OSError as error:
            raise InputError(
                f"cannot serve the page on {host}:{port}: {error.strerror}; give another --port, "
                "or an address of this machine (--host)"
            ) from None
        self._port = self._server.socket.getsockname()[1]
        self._hosts = {f"{in_url(one)}:{self._port}" for one in (*_LOCAL, host)}
        self._hosts |= {*map(in_url, _LOCAL)} if self._port == 80 else set()  # browsers omit it
        query = f"/?token={self._token}" if self._token else "/"
        self.address = f"http://{in_url(host)}:{self._port}{query}"
        """Of the page."""
        self._thread = threading.Thread(target=self._server.serve_forever, name="view", daemon=True)
        logging.getLogger("websockets").setLevel(logging.CRITICAL)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()

    def show(self, source: Source) -> None:
        """Pages begin anew with this source."""
        with self._lock:
            self._source, self._number = source, self._number + 1

    def read(self) -> list[Entry[Any]]:
        """Takes in what has been added to the source's log, and returns it. InputError once no
        page can connect any more."""
        if not self._thread.is_alive():
            raise InputError(
                "no page can connect any more, as where file descriptors run out (ulimit -n): "
                "start it again"
            )
        with self._lock:
            return [] if self._source is None else self._source.read()

    def _answered(self, link: ServerConnection, request: Request) -> Response | None:
        """A request for the page, or one that is refused; None: a WebSocket, which goes on."""
        where = urlsplit(request.path)
        origin = request.headers.get("Origin")
        strange = not self._token and request.headers.get("Host", "") not in self._hosts
        if strange or (origin and urlsplit(origin).netloc != request.headers.get("Host")):
            # Another site's page in the same browser must not read what the car does.
            return link.respond(http.HTTPStatus.FORBIDDEN, "this page is for this machine\n")
        given = parse_qs(where.query).get("token", [""])[0]
        if not secrets.compare_digest(given.encode(), self._token.encode()):
            return link.respond(http.HTTPStatus.FORBIDDEN, "the token is missing or wrong\n")
        if where.path == "/updates":
            return None
        if where.path != "/":
            return link.respond(http.HTTPStatus.NOT_FOUND, "there is only the page: /\n")
        response = link.respond(http.HTTPStatus.OK, whole_page())
        del response.headers["Content-Type"]
        response.headers["Content-Type"] = "text/html; charset=utf-8"
        response.headers["Cache-Control"] = "no-store"
        response.headers["Content-Security-Policy"] = _POLICY
        return response

    def _told(self, link: ServerConnection) -> None:
        """A page's thread."""
        if not self._places.acquire(blocking=False):
            link.close(1013, "too many pages")
            return
        # A blocking send ends with an error after that time, which closes the link.
        patience = struct.pack("@ll", _PATIENCE_S, 0)
        try:
            link.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, patience)
            self._tell(partial(link.send, text=True), link.recv)
        except ConnectionClosed:
            pass
        finally:
            self._places.release()

    def _tell(self, send: Callable[[bytes], None], receive: Callable[..., Any]) -> None:
        number, known, fault = 0, dict[str, tuple[int, int, int, str]](), ""
        told_s = time.monotonic()
        while True:
            with self._lock:
                new: list[Any] = []
                if self._source is not None:
                    if number != self._number:
                        number, known, fault = self._number, {}, ""
                        new = [self._source.course()]
                    new += self._source.runs.updates(known)
                    if self._source.fault != fault:
                        fault = self._source.fault
                        new.append({"kind": "fault", "text": fault})
            data = msgspec.json.encode(new)
            if new or time.monotonic() - told_s > _QUIET_S:
                new.clear()  # a slow page may hold this thread up, but not what is forgotten
                send(data)
                told_s = time.monotonic()
            try:
                receive(_LOOK_S)  # nothing is expected; it ends when the page goes away
            except TimeoutError:
                continue
