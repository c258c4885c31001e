"""Which links of a session stand."""

import socket
import time
from collections.abc import Sequence
from typing import Any, Final

from bayesrace.transport.endpoints import Endpoints, address_of

__all__ = ["unlinked", "wait_linked"]

_LOOK_S: Final = 0.02


def unlinked(session: Any, endpoints: Endpoints, among: Sequence[str] | None = None) -> list[str]:
    """Endpoints to connect to, or those ``among`` them, to which there is no link."""
    wanted = list(endpoints.connect if among is None else among)
    if endpoints.low_latency:  # Zenoh 1.10.2 panics where it is asked for the ends of such links
        return [] if len(_nodes(session)) >= len(wanted) else wanted
    ends = {_end(link) for link in session.info.links()}
    return [one for one in wanted if not _is_among(one, ends)]


def wait_linked(session: Any, endpoints: Endpoints, among: Sequence[str], timeout_s: float) -> bool:
    """Whether these endpoints are linked within that time."""
    deadline = time.monotonic() + timeout_s
    while unlinked(session, endpoints, among):
        if time.monotonic() >= deadline:
            return False
        time.sleep(_LOOK_S)
    return True


def _end(link: Any) -> str:
    return str(link.dst).partition("?")[0].partition("#")[0]


def _is_among(endpoint: str, ends: set[str]) -> bool:
    address = address_of(endpoint)
    if address.protocol == "unixsock-stream":
        return endpoint.partition("?")[0].partition("#")[0] in ends
    if address.protocol not in ("tcp", "tls"):
        return any(end.startswith(address.protocol) for end in ends)
    try:
        found = socket.getaddrinfo(address.host, address.port, type=socket.SOCK_STREAM)
    except OSError:
        return False
    hosts = {str(one[4][0]) for one in found}
    named = {f"[{host}]" if ":" in host else host for host in hosts}
    return any(f"{address.protocol}/{host}:{address.port}" in ends for host in named)


def _nodes(session: Any) -> list[Any]:
    """Those at the other ends of all links."""
    return [*session.info.peers_zid(), *session.info.routers_zid()]
