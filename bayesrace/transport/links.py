"""The links of a session: who is at their other ends, and an end to those of who is no member.

Zenoh reads certificates and access rules when a session is opened, and no list of revoked ones. So
each new link is looked at before anything is received over it, and all are when the list changes.
"""

import logging
import socket
import struct
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

import zenoh

from bayesrace.transport.credentials import MEMBERS, Members

__all__ = ["LINKS", "Links"]

_log = logging.getLogger("bayesrace.links")

_CHUNK: Final = 1 << 16
_MOST_ACCEPTED: Final = 1000


class _Link(NamedTuple):
    node: str
    """Zenoh's number of the session at the other end."""
    name: str
    """In the certificate of the other end."""


class Links:
    """Those of one session, by the events of Zenoh."""

    def __init__(self, members: Members | None) -> None:
        """``members``: those that the session is opened with; None: it has no certificate."""
        self._begun = self._newest = members
        self._links: dict[tuple[str, str], _Link] = {}
        """By own end and other end, as Zenoh writes them."""
        self._reported: set[str] = set()
        self._accepted: deque[str] = deque(maxlen=_MOST_ACCEPTED)

    def on_event(self, event: Any) -> None:
        """A link that begins or ends; in the transport's thread, before messages come over it."""
        if event.kind == zenoh.SampleKind.DELETE:
            self._links.pop(_ends(event.link), None)
        else:
            self.note(event.link)
        self.tend()

    def note(self, link: Any) -> None:
        """A link that stands."""
        self._links[_ends(link)] = _Link(str(link.zid), link.auth_identifier or "")

    def update(self, members: Members) -> None:
        """Closes the links of those who are not in a newer list, or do something else now."""
        self._newest = members
        self.tend()

    def sender(self, query: Any) -> str:
        """The name in the certificate of who sent a request; of a router, if it came over one.

        By what the request says of itself: a member could name the session of another one that has
        a link here, whose number it would have to know. Empty without certificates.
        """
        if self._begun is None:
            return ""
        names = {link.node: link.name for link in tuple(self._links.values())}
        source = query.source_info
        if source is not None and (node := str(source.source_id.zid)) in names:
            return names[node]
        members = self._begun.members
        routers = [
            one for one in names.values() if one in members and members[one].role == "router"
        ]
        return f"somebody at {', '.join(routers)}" if routers else "somebody"

    def accepted(self, text: str) -> None:
        """Something for the log, which the control loop does not wait for."""
        self._accepted.append(text)

    def report(self) -> None:
        """Writes it; for another thread."""
        while self._accepted:
            _log.info("%s", self._accepted.popleft())

    def tend(self) -> None:
        """Closes links that may not be, and switches off the linger of all sockets.

        Zenoh lets each of its TCP sockets linger for 10 s, in a thread that serves all links: where
        the other end has stopped reading, closing its link would hold up the messages of all others
        for so long (eclipse-zenoh/zenoh#2350). The system still delivers what was sent.
        """
        unwanted = {ends for ends, one in tuple(self._links.items()) if not self._wanted(one.name)}
        for one in _sockets():
            with suppress(OSError):  # without such an option, or closed since
                if struct.unpack("ii", one.getsockopt(socket.SOL_SOCKET, socket.SO_LINGER, 8))[0]:
                    one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 0, 0))
                if unwanted and (_text(one.getsockname()), _text(one.getpeername())) in unwanted:
                    _close(one)

    def _wanted(self, name: str) -> bool:
        if self._begun is None or self._newest is None:
            return True
        now = self._newest.members.get(name)
        if now is not None and self._begun.members.get(name, now) == now:
            return True
        if name not in self._reported:
            self._reported.add(name)
            why = "is not in" if now is None else "has another role or car in"
            number = self._newest.number
            _log.warning("links of '%s', who %s %s %d, are closed", name, why, MEMBERS, number)
        return False


LINKS: Final[dict[str, Links]] = {}
"""Those of each open session, by its number."""


def _ends(link: Any) -> tuple[str, str]:
    return str(link.src).partition("/")[2], str(link.dst).partition("/")[2]


def _text(address: Any) -> str:
    """A socket's address as Zenoh writes it."""
    if not isinstance(address, tuple):
        return str(address)
    host, port = address[:2]
    if len(address) == 4 and address[3]:  # of one cable, as IPv6 has them
        host += f"%{address[3]}"
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def _sockets() -> Iterator[socket.socket]:
    """Those of this process, which other threads may close meanwhile."""
    try:
        paths = list(Path("/dev/fd").iterdir())
    except OSError:  # a flood of connections has all descriptors: at the next link
        return
    for path in paths:
        try:
            one = socket.socket(fileno=int(path.name))
        except OSError:  # no socket, or closed since
            continue
        try:
            yield one
        finally:
            one.detach()


def _close(one: socket.socket) -> None:
    """Ends a connection, and takes what has arrived out of Zenoh's reach."""
    with suppress(BlockingIOError):
        while one.recv(_CHUNK, socket.MSG_DONTWAIT):
            pass
    one.shutdown(socket.SHUT_RDWR)
