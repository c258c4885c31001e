"""Opens connections at a rate and lets each handshake of TLS hang; needs no certificate.

    python -m tests.security.half_open HOST PORT RATE WORDS SOURCE...

WORDS: "silence", or "greeting": a valid ClientHello, and then silence. Sources take turns. It
prints "opening" when it begins, and on the end of stdin how many connections it has begun and how
many of them were accepted by the system of the other end.
"""

import select
import socket
import ssl
import sys
import time
from collections import deque
from contextlib import suppress
from itertools import cycle
from typing import Final

from bayesrace.transport.endpoints import check_descriptors

__all__ = ["client_hello"]

_HOLD_S: Final = 3.0
"""Longer than a handshake may take, so that it is the other end that gives up."""
_BATCH_S: Final = 0.002
_MOST_S: Final = 60.0
_NO_PORT: Final = 24
"""IP_BIND_ADDRESS_NO_PORT: the port is chosen when the other end is known."""


def client_hello() -> bytes:
    """A ClientHello."""
    context, out = ssl.create_default_context(), ssl.MemoryBIO()
    begun = context.wrap_bio(ssl.MemoryBIO(), out, server_hostname="plant")
    with suppress(ssl.SSLWantReadError):
        begun.do_handshake()
    return out.read()


def _opened(host: str, port: int, source: str) -> socket.socket:
    one = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
    one.setblocking(False)
    one.setsockopt(socket.IPPROTO_IP, _NO_PORT, 1)
    one.bind((source, 0))
    with suppress(BlockingIOError):
        one.connect((host, port))
    return one


def main(host: str, port: str, rate: str, words: str, *sources: str) -> None:
    """Opens connections until the end of stdin, for a minute at most."""
    check_descriptors()
    greeting = client_hello() if words == "greeting" else b""
    begun, accepted, held = 0, 0, deque[tuple[float, socket.socket]]()
    connecting, turns = dict[int, socket.socket](), cycle(sources)
    poll = select.epoll()
    print("opening", flush=True)  # noqa: T201
    begin = time.monotonic()
    while not select.select([sys.stdin], [], [], _BATCH_S)[0]:
        now = time.monotonic()
        if now - begin > _MOST_S:
            break
        for _ in range(int((now - begin) * float(rate)) - begun):
            one = _opened(host, int(port), next(turns))
            connecting[one.fileno()] = one
            poll.register(one, select.EPOLLOUT)
            held.append((now, one))
            begun += 1
        for number, event in poll.poll(0):
            one = connecting.pop(number)
            poll.unregister(one)
            if not event & (select.EPOLLERR | select.EPOLLHUP):
                accepted += 1
                with suppress(OSError):
                    one.send(greeting)
        while held and now - held[0][0] > _HOLD_S:
            one = held.popleft()[1]
            if connecting.pop(one.fileno(), None) is not None:
                poll.unregister(one)
            one.close()
    print(begun, accepted, flush=True)  # noqa: T201


if __name__ == "__main__":
    main(*sys.argv[1:])
