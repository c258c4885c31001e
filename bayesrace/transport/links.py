"""The links of a process: who is at their other ends, an end to those of who is no member, and the
end of all with the certificate.

Zenoh reads certificates and access rules when a session is opened, and no list of revoked ones. So
each new link is looked at before anything is received over it, and all are when the list changes.
"""

import logging
import math
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final, NamedTuple

import zenoh

from bayesrace.errors import InputError
from bayesrace.messages import Role
from bayesrace.processes import interrupt
from bayesrace.transport.credentials import (
    AUTHORITY,
    CERTIFICATE,
    KEY,
    MEMBERS,
    Credentials,
    Members,
)

__all__ = ["LINKS", "Links", "watching"]

_log = logging.getLogger("bayesrace.links")

_CHUNK: Final = 1 << 16
_MOST_ACCEPTED: Final = 1000

_REMINDER_S: Final = 86400.0
_LOOK_S: Final = 1.0
"""Longest time between two looks at the folder, and at the calendar, which somebody may set."""
_AGAIN_S: Final = 10.0
"""Time until a folder that cannot be used, and does not change, is read again: it may be the clock
that passes."""

_interrupting: Final = threading.Lock()
"""Held once an expiry interrupts the process, which may have several sessions with one certificate;
until the process, which has not ended, opens another session."""


class _Link(NamedTuple):
    node: str
    """Zenoh's number of the session at the other end."""
    name: str
    """In the certificate of the other end."""


class Links:
    """Those of the current session, by the events of Zenoh, and what is in the folder of the
    certificate while the process runs."""

    def __init__(self, own: Credentials | None, role: Role = "viewer") -> None:
        """``own``: None: the process has no certificate."""
        self.used = self.newest = own
        """With which the session was opened, and with which the next one can be."""
        self._members = Members() if own is None else own.members
        """The newest list, of a folder whose certificate may not be usable."""
        self._role = role
        self._stamps, self._again_s, self._said = tuple[Any, ...](), 0.0, ""
        self._links: dict[tuple[str, str], _Link] = {}
        """By own end and other end, as Zenoh writes them."""
        self.standing: Callable[[], Iterable[Any]] = tuple
        """All that the session has now, as far as it can say so."""
        self._reported: set[str] = set()
        self._accepted: deque[str] = deque(maxlen=_MOST_ACCEPTED)

    def look(self) -> None:
        """Reads the folder again if a file has changed; the log says what cannot be used."""
        self.report()
        if self.used is None:
            return
        folder, now_s = self.used.folder, time.monotonic()
        before, self._stamps = self._stamps, _stamps(folder)
        if before == self._stamps and now_s < self._again_s:
            return
        self._again_s = math.inf
        try:
            now = Credentials.read(folder)
            now.members.check_newer(self._members.number, folder / MEMBERS)
            if now.members != self._members:
                self._members = now.members
                self.tend()
            now.check(self._role)
        except (OSError, ValueError) as error:
            self._again_s = now_s + _AGAIN_S
            if (text := str(error)) != self._said:
                _log.warning("%s; what was read before stays in use", text)
            self._said = text
            return
        self.newest = now

    def outlasted(self, over: threading.Event) -> str:
        """Looks at the folder until the certificate in use expires: what to say then; empty if it
        is over before."""
        remind_s = 0.0
        while self.used and self.newest and (left_s := self.used.ends_s - time.time()) > 0:
            if time.monotonic() >= remind_s and (warning := self.newest.expires_soon()):
                _log.warning("%s", warning)
                remind_s = time.monotonic() + _REMINDER_S
            if over.wait(min(left_s, _LOOK_S)):
                return ""
            self.look()
        return self.expired()

    def expired(self) -> str:
        """What to say if the certificate in use has expired; else empty."""
        return self.used.expired() if self.used and self.used.ends_s <= time.time() else ""

    def clear(self) -> None:
        """The session, and so all links, have ended."""
        self._links.clear()
        self.standing = tuple

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

    def sender(self, query: Any) -> str:
        """The name in the certificate of who sent a request; of a router, if it came over one.

        By what the request says of itself: a member could name the session of another one that has
        a link here, whose number it would have to know. Empty without certificates, and for who has
        no link here that may be.
        """
        if self.used is None:
            return ""
        names = {link.node: link.name for link in tuple(self._links.values())}
        source = query.source_info
        name = "" if source is None else names.get(str(source.source_id.zid), "")
        if name:
            return name if self._wanted(name) else ""
        members = self.used.members.members
        routers = [
            one for one in names.values() if one in members and members[one].role == "router"
        ]
        return f"somebody at {', '.join(routers)}" if routers else ""

    def admits(self, query: Any) -> bool:
        """Whether a request may be served; in the transport's thread.

        A link that may not be is closed as soon as it is noticed, but on a loaded machine a request
        over it can be here before, or after it has gone.
        """
        if self.used is None or self.sender(query):
            return True
        for link in self.standing():  # one that has not been noticed yet
            self.note(link)
        return bool(self.sender(query))

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
        if self.used is None:
            return True
        now = self._members.members.get(name)
        if now is not None and self.used.members.members.get(name, now) == now:
            return True
        if name not in self._reported:
            self._reported.add(name)
            why = "is not in" if now is None else "has another role or car in"
            number = self._members.number
            _log.warning("links of '%s', who %s %s %d, are closed", name, why, MEMBERS, number)
        return False


LINKS: Final[dict[str, Links]] = {}
"""Those of each open session, by its number."""


@contextmanager
def watching(links: Links, failure: type[InputError] = InputError) -> Iterator[None]:
    """For the block, a thread looks at the folder once a second.

    The expiry of the certificate in use interrupts the main thread; then the end of the block
    raises ``failure`` with the reason, which the command line also says where the interrupt
    strikes outside of the block, as while a session is opened. Zenoh closes such links, but opens
    them again.

    In a thread other than the main one it interrupts nothing, and logs the reason instead. The log
    warns of the expiry each day for two weeks before.
    """
    in_main = threading.current_thread() is threading.main_thread()
    if in_main and _interrupting.locked():
        _interrupting.release()
    over, reasons = threading.Event(), list[str]()

    def wait() -> None:
        if not (reason := links.outlasted(over)):
            return
        reasons.append(reason)
        if not in_main:
            _log.error("%s", reason)
        elif _interrupting.acquire(blocking=False):
            interrupt(failure(reason))

    thread = threading.Thread(target=wait, name="expiry", daemon=True)
    thread.start()
    try:
        try:
            yield
        finally:
            over.set()
            thread.join()
    except (InputError, KeyboardInterrupt) as error:
        # Looked at once more: on a busy machine the closed links may be noticed before the expiry.
        if reason := (reasons or [links.expired()])[0]:
            raise failure(reason) from error
        raise
    if reasons:
        raise failure(reasons[0])


def _stamps(folder: Path) -> tuple[Any, ...]:
    """What differs as soon as a file does."""
    stamps = []
    for name in (AUTHORITY, CERTIFICATE, KEY, MEMBERS):
        with suppress(OSError):
            status = (folder / name).stat()
            stamps.append((name, status.st_ino, status.st_ctime_ns))
    return tuple(stamps)


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
