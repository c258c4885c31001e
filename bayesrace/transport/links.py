"""Whether a session's links stand, and why not: said in words, and while it runs.

Access control drops what it refuses without a word to the sender. So each secured node answers one
question to whoever has a certificate of the authority: what does it let that name do?
"""

import logging
import socket
import threading
import time
from collections.abc import Sequence
from typing import Any, Final

import zenoh
from pydantic import BaseModel, ValidationError

from bayesrace.transport.access import ACCESS
from bayesrace.transport.credentials import Credentials, Member
from bayesrace.transport.endpoints import Endpoints, address_of
from bayesrace.transport.probe import probe_all
from bayesrace.transport.requests import in_transport_thread

__all__ = ["LinkWatch", "refusals", "serve_access", "unlinked", "wait_linked"]

_log = logging.getLogger("bayesrace.links")

_FIRST_S: Final = 0.2
"""How long a session may take to link before it is asked why it has not."""
_PERIOD_S: Final = 1.0
_ANSWER_S: Final = 0.5
_LOOK_S: Final = 0.02


def unlinked(session: Any, endpoints: Endpoints, among: Sequence[str] | None = None) -> list[str]:
    """Endpoints to connect to, or those ``among`` them, to which there is no link."""
    wanted = list(endpoints.connect if among is None else among)
    if endpoints.low_latency:  # Zenoh 1.10.2 panics where it is asked for the ends of such links
        return [] if len(_nodes(session)) >= len(wanted) else wanted
    ends = {str(link.dst).partition("?")[0].partition("#")[0] for link in session.info.links()}
    return [one for one in wanted if not _is_among(one, ends)]


def _is_among(endpoint: str, ends: set[str]) -> bool:
    address = address_of(endpoint)
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


def wait_linked(session: Any, endpoints: Endpoints, among: Sequence[str], timeout_s: float) -> bool:
    """Whether these endpoints are linked within that time."""
    deadline = time.monotonic() + timeout_s
    while unlinked(session, endpoints, among):
        if time.monotonic() >= deadline:
            return False
        time.sleep(_LOOK_S)
    return True


def serve_access(session: Any, credentials: Credentials) -> Any:
    """Answers what a name may do here; keep what is returned."""
    members = credentials.members

    def on_query(query: Any) -> None:
        name = str(query.parameters.get("name") or "")
        answer = _Access(
            node=credentials.name, member=members.members.get(name),
            revoked=name in members.revoked,
        )  # fmt: skip
        query.reply(query.key_expr, answer.model_dump_json())

    key = ACCESS.format(node=session.info.zid())
    return session.declare_queryable(key, in_transport_thread(on_query))


class _Access(BaseModel):
    """What a node says of a name."""

    node: str
    member: Member | None
    revoked: bool


def refusals(session: Any, credentials: Credentials) -> list[str]:
    """What the nodes at the other ends of the links refuse to this session's certificate."""
    texts = (_refusal(session, node, credentials) for node in _nodes(session))
    return [text for text in texts if text]


def _refusal(session: Any, node: Any, credentials: Credentials) -> str:
    asked = f"{ACCESS.format(node=node)}?name={credentials.name}"
    replies = list(session.get(asked, timeout=_ANSWER_S))
    answers = [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]
    if not answers:
        return ""  # it may have just gone; that it refuses us it would have said
    try:
        known = _Access.model_validate_json(answers[0])
    except ValidationError:
        return ""
    if known.member is not None and known.member == credentials.member:
        return ""
    who = f"'{known.node[:60]}'"
    newest = "copy the newest members.json of 'bayesrace certs' to it and restart it"
    if known.member is not None:
        why = f"as {known.member.role} of car '{known.member.car}', not as its own list says"
        return f"{who} knows certificate '{credentials.name}' {why}: {newest}"
    if known.revoked:
        another = "make another one with 'bayesrace certs add'"
        return f"{who} refuses certificate '{credentials.name}', which is revoked: {another}"
    return f"{who} has no certificate '{credentials.name}' in its list of members: {newest}"


class LinkWatch:
    """Logs why endpoints are not linked, each reason once, until all are; in a thread."""

    def __init__(self, session: Any, endpoints: Endpoints) -> None:
        self._session, self._endpoints = session, endpoints
        self._over = threading.Event()
        self._said: dict[str, str] = {}
        self._thread = threading.Thread(target=self._watch, name="links", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends it."""
        self._over.set()
        self._thread.join()

    def _watch(self) -> None:
        wait_s = _FIRST_S
        while not self._over.wait(wait_s):
            wait_s = _PERIOD_S
            try:
                missing = unlinked(self._session, self._endpoints)
            except zenoh.ZError:  # the session is closed
                return
            if not missing:
                return
            for finding in probe_all(missing, self._endpoints.credentials):
                if self._said.get(finding.endpoint) != finding.text:
                    _log.log(logging.ERROR if finding.lasting else logging.WARNING, finding.text)
                self._said[finding.endpoint] = finding.text
