"""Zenoh sessions with explicit endpoints, TLS, and access control made of the table of messages.

Topology of a run: the plant listens; the controller connects to the plant and listens itself;
recorders and directors connect to both, because peers do not forward for each other. Or all connect
to a router, which forwards between peers of different regions. Multicast and gossip are off, so a
process connects to its endpoints only.

Over secured links every node checks what comes from the other end, and what goes there, by the name
in the other end's certificate. What the table does not allow to that name's role and car is
dropped; a name that is not in the list of members may do nothing.
"""

import errno
import json
import logging
import math
import os
import re
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, nullcontext
from typing import Any, Final

import zenoh

from bayesrace.defaults import MAX_WEIGHTS_BYTES
from bayesrace.errors import PASSING, InputError, RestartError, TransientError
from bayesrace.messages import (
    ALIVE,
    ALIVE_SOURCES,
    EVERYTHING,
    RECORDERS,
    ROLE_OF,
    SERVICES,
    TOPICS,
    Role,
    Source,
)
from bayesrace.realtime import short_slices
from bayesrace.transport.credentials import AUTHORITY, CERTIFICATE, KEY, Credentials, Members
from bayesrace.transport.endpoints import (
    Endpoints,
    address_of,
    check_descriptors,
    leaves,
    unreachable,
)
from bayesrace.transport.links import LINKS, Links, watching
from bayesrace.transport.requests import in_transport_thread

__all__ = [
    "Sessions", "access_control", "check_session", "open_session", "open_sessions", "unlinked",
    "zenoh_config",
]  # fmt: skip

_log = logging.getLogger("bayesrace.links")

_REGIONS: Final = ("plant", "controller", "shadow", "observer")
"""Zenoh region of a process; an observer is any process but these. A router
forwards between regions only, which suffices: processes of one region exchange no messages."""

# One receiving worker hands over between threads less often than the default of two.
_RUNTIME: Final = "(rx: (worker_threads: 1))"
_MESSAGE_BYTES: Final = MAX_WEIGHTS_BYTES + 4096
"""Largest message that is put together of its fragments, with its key and what else it has beside
the payload. Zenoh does so before access control looks at it, so this bounds what any other end of a
link can fill. It drops longer ones silently: senders have to refuse them."""
_RETRY: Final = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5}
_LINK_S: Final = 0.5
"""How long a session waits for its links before the log says that there are none yet."""
_LOOK_S: Final = 0.02
"""Time between two looks at the links of a session."""

_SERVERS: Final[tuple[Role, ...]] = ("plant", "controller", "router")
"""Processes that wait as long as they run, for an endpoint to listen on, too."""
_LISTEN_S: Final = 0.5
"""Time between two attempts to listen."""
_REOPEN_S: Final = 5.0
"""How long they go on where a session is opened anew, before the process starts again."""
_PASSING: Final = (errno.EADDRINUSE, errno.EADDRNOTAVAIL, *PASSING)
"""Why an endpoint cannot be listened on now, and may be later: another process has it or has just
ended, the network of this machine is not up yet, the system is short of something."""

# Zenoh's own tools name no region: they form one more, and clients another.
_FILTERS: Final[list[dict[str, list[str]]]] = [
    *({"modes": ["peer"], "region_names": [region]} for region in _REGIONS),
    {"modes": ["peer"]},
    {"modes": ["client"]},
]
_ROUTER: Final = {"south": [{"filters": [one]} for one in _FILTERS]}

_ANY: Final = "bayesrace/**"
"""What goes to a process is declared to it first. A declaration alone holds no data, and has the
widest key that a process of ours uses."""

_MEANS: Final[dict[str, tuple[tuple[str, str, str], ...]]] = {
    "sends": (("ingress", "put", ""), ("egress", "declare_subscriber", _ANY)),
    "receives": (("ingress", "declare_subscriber", ""), ("egress", "put", "")),
    "subscribes": (("ingress", "declare_subscriber", ""),),
    "asks": (
        ("ingress", "query", ""), ("egress", "reply", ""), ("egress", "declare_queryable", ""),
    ),
    "answers": (
        ("egress", "query", ""), ("ingress", "reply", ""), ("ingress", "declare_queryable", ""),
    ),
    "is seen": (("ingress", "liveliness_token", ""),),
    "sees": (("egress", "liveliness_token", ""),),
    "looks for": (
        ("ingress", "liveliness_query", ""), ("egress", "liveliness_query", _ANY),
        ("ingress", "declare_liveliness_subscriber", ""),
        ("egress", "declare_liveliness_subscriber", _ANY),
    ),
}  # fmt: skip
"""For each right of the process at the other end, the messages that its link may carry: direction
as seen by the node that checks ("ingress": from the other end), kind of message, and key; an empty
key is that of the topic, service or token."""


def zenoh_config(endpoints: Endpoints, role: Role, *, peers_follow: bool = False) -> Any:
    """Zenoh's configuration of such a process; InputError for a setting that it does not have.

    ``peers_follow``: the peers start after the session, so that opening it does not wait half a
    second for their answer.
    """
    config = zenoh.Config()
    region = role if role in _REGIONS else "observer"
    limits = endpoints.limits
    settings: dict[str, Any] = {
        "mode": endpoints.mode,
        **({"gateway": _ROUTER} if endpoints.mode == "router" else {"region_name": region}),
        "listen/endpoints": list(endpoints.listen),
        "listen/exit_on_failure": True,
        "connect/endpoints": list(endpoints.connect),
        # -1: try for ever, in the background; 0 would never reconnect.
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": _RETRY,
        "open/return_conditions/connect_scouted": not peers_follow,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/lease": round(1e3 * limits.lease_s),
        "transport/link/rx/max_message_size": _MESSAGE_BYTES,
        "transport/unicast/open_timeout": round(1e3 * limits.handshake_s),
        "transport/unicast/accept_timeout": round(1e3 * limits.handshake_s),
        "transport/unicast/accept_pending": limits.pending,
        "transport/unicast/max_sessions": limits.sessions,
        # Each message of the control path is a batch of its own: with the default of two, a
        # receiver held up for two periods of 500 Hz loses states instead of getting them late.
        "transport/link/tx/queue/size/real_time": 16,
        # Pays only above 3 kB, and leaves segments behind when a process is killed.
        "transport/shared_memory/enabled": False,
        # Zenoh has one or the other.
        "transport/unicast/lowlatency": endpoints.low_latency,
        "transport/unicast/qos/enabled": not endpoints.low_latency,
        **({} if endpoints.credentials is None else _security(endpoints.credentials)),
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    for key, value in leaves(endpoints.zenoh):
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            why = str(error).splitlines()[0][:200]
            raise InputError(f"[zenoh] {key} = {value!r}: {why}; see Zenoh's settings") from None
    return config


def _security(credentials: Credentials) -> dict[str, Any]:
    """Mutual TLS, and access control by the names in the certificates."""
    authority, certificate, key = (
        str(credentials.folder / name) for name in (AUTHORITY, CERTIFICATE, KEY)
    )
    return {
        "transport/link/tls": {
            "root_ca_certificate": authority,
            "listen_certificate": certificate, "listen_private_key": key,
            "connect_certificate": certificate, "connect_private_key": key,
            "enable_mtls": True, "verify_name_on_connect": True, "close_link_on_expiration": True,
        },
        "transport/link/protocols": ["tls"],
        "access_control": access_control(credentials.members),
    }  # fmt: skip


@contextmanager
def open_session(
    endpoints: Endpoints,
    role: Role = "viewer",
    *,
    peers_follow: bool = False,
    reports_absence: bool = True,
) -> Iterator[Any]:
    """A Zenoh session of a process in that role, closed at the end of the block.

    Raises InputError if an endpoint is malformed, open to others without protection, or cannot be
    listened on, or if the certificate is not for the role. An absent peer is no error: the session
    connects as soon as it appears, and the log says that it waits. See :class:`.Inbox` for waiting
    with a limit. Plant, controller and router also wait for an endpoint that they cannot listen on
    now, such as one in use.

    ``peers_follow``: the caller starts the peers itself, just before or after this call. Opening
    the session then does not wait for them, and the log does not say that they are absent.
    ``reports_absence`` False: nor does it where the caller reports that, after a time limit.

    Links of who is not in the list of members, as it is in the folder at any time, are closed.
    Where the process's certificate expires, the main thread gets a SIGINT, and the end of the block
    raises InputError with the reason: RestartError in a plant, controller or router.
    """
    with open_sessions(
        endpoints, role, peers_follow=peers_follow, reports_absence=reports_absence
    ) as sessions:
        yield sessions.current


class Sessions:
    """The session of a process, and the next one, where the process can spare its links."""

    def __init__(self, endpoints: Endpoints, role: Role) -> None:
        self._endpoints, self._role, self._stack = endpoints, role, ExitStack()
        self.links = Links(endpoints.credentials, role)
        # A thread that the system treats as all others, whatever becomes of the calling one.
        self._opener = ThreadPoolExecutor(1)
        if endpoints.credentials is not None and role in _SERVERS:
            self._opener.submit(int)
        self.current: Any = None
        """Open, of Zenoh."""

    def open(self, *, peers_follow: bool = False, patience_s: float) -> None:
        """Opens it; goes on trying for so long where an endpoint cannot be listened on now."""
        links = self.links
        opened = _opened(self._endpoints, self._role, links, peers_follow, patience_s)
        self.current = self._stack.enter_context(opened)

    def close(self) -> None:
        """Closes it."""
        self._stack.close()

    def renewed(self) -> Any:
        """Another one in its place, with the certificate and the list of members that are in the
        folder now; None if they are what this one was opened with.

        What was declared in the session has to be declared again, see :meth:`.Inbox.bind`. Raises
        RestartError if it cannot be opened.
        """
        newest = self.links.newest
        if newest is None or newest == self.links.used:
            return None
        try:
            self._opener.submit(self._reopen, newest).result()
        except InputError as error:
            raise RestartError(str(error)) from error
        _log.info("links are opened anew, with list %d of members", newest.members.number)
        return self.current

    def _reopen(self, newest: Credentials) -> None:
        self.close()
        self.links.used = newest
        self._endpoints = self._endpoints.model_copy(update={"credentials": newest})
        self.open(patience_s=_REOPEN_S)


@contextmanager
def open_sessions(
    endpoints: Endpoints,
    role: Role,
    *,
    peers_follow: bool = False,
    reports_absence: bool = True,
) -> Iterator[Sessions]:
    """The same, for a process that goes on where its certificate or the members change."""
    os.environ.setdefault("ZENOH_RUNTIME", _RUNTIME)
    check_session(endpoints, role)
    if endpoints.exposed:
        _log.warning(
            "INSECURE: links by %s are open to everyone in that network, who could drive the car; "
            "see docs/security.md", ", ".join(endpoints.exposed),
        )  # fmt: skip
    for why in filter(None, map(unreachable, endpoints.listen)):
        _log.warning("%s", why)
    failure = RestartError if role in _SERVERS else InputError
    sessions = Sessions(endpoints, role)
    with (
        nullcontext() if endpoints.credentials is None else watching(sessions.links, failure),
        closing(sessions),
    ):
        patience_s = math.inf if role in _SERVERS else 0.0
        sessions.open(peers_follow=peers_follow, patience_s=patience_s)
        missing: list[str] = []
        if reports_absence and not peers_follow:
            with short_slices():  # Zenoh may start threads for these calls, too
                missing = unlinked(sessions.current, endpoints, _LINK_S)
        if missing:
            _log.warning(
                "no link to %s yet; this goes on trying, and 'bayesrace doctor' says why there is "
                "none", ", ".join(missing),
            )  # fmt: skip
        yield sessions


def check_session(endpoints: Endpoints, role: Role) -> None:
    """InputError for what no session can be opened with: certificate, endpoints, limits.

    For commands with seconds of work before they open one.
    """
    check_descriptors()
    endpoints.check()
    if endpoints.credentials is not None:
        endpoints.credentials.check(role)


def unlinked(session: Any, endpoints: Endpoints, timeout_s: float = 0.0) -> list[str]:
    """Endpoints to connect to that have no link; waits for their links for that time at most."""
    deadline = time.monotonic() + timeout_s
    while (missing := _unlinked(session, endpoints)) and time.monotonic() < deadline:
        time.sleep(_LOOK_S)
    return missing


def _unlinked(session: Any, endpoints: Endpoints) -> list[str]:
    wanted = list(endpoints.connect)
    if endpoints.low_latency:  # Zenoh 1.10.2 panics where it is asked for the ends of such links
        nodes = [*session.info.peers_zid(), *session.info.routers_zid()]
        return [] if len(nodes) >= len(wanted) else wanted
    ends = {_without_settings(str(link.dst)) for link in session.info.links()}
    return [one for one in wanted if not _is_among(one, ends)]


@contextmanager
def _opened(
    endpoints: Endpoints, role: Role, links: Links, peers_follow: bool, patience_s: float
) -> Iterator[Any]:
    said, ends_s = "", time.monotonic() + patience_s
    while True:
        try:
            with short_slices():
                session = zenoh.open(zenoh_config(endpoints, role, peers_follow=peers_follow))
            break
        except zenoh.ZError as error:
            failure = _not_opened(endpoints, error)
        if time.monotonic() >= ends_s or not isinstance(failure, TransientError):
            raise failure
        if (text := str(failure)) != said:
            _log.warning("%s; this goes on trying", text)
        said = text
        time.sleep(_LISTEN_S)
    with session:
        with short_slices():
            on_link = in_transport_thread(links.on_event)
            listener = session.info.declare_link_events_listener(on_link)
        with listener:
            if not endpoints.low_latency:  # as above
                links.standing = session.info.links
            for link in links.standing():
                links.note(link)
            links.tend()
            number = str(session.info.zid())
            LINKS[number] = links
            try:
                yield session
            finally:
                del LINKS[number]
                links.report()
    links.clear()


def _not_opened(endpoints: Endpoints, error: Exception) -> InputError:
    """Why a session could not be opened; TransientError if that may pass."""
    text = re.sub(r" at /\S+", "", str(error).splitlines()[0])  # places in Zenoh's source
    cause = re.search(r"[^:\[]+ \(os error (\d+)\)", text)
    # Without a number: of a host's name, and of a Unix socket in use.
    known = "lookup" in text or "acquire lock" in text
    passes = int(cause[1]) in _PASSING if cause else known
    return (TransientError if passes else InputError)(
        f"cannot listen on {', '.join(endpoints.listen) or 'no endpoint'}: "
        f"{(cause[0] if cause else text[:300]).strip()}; "
        "choose another endpoint or end the process that uses it"
    )


def _without_settings(endpoint: str) -> str:
    return endpoint.partition("?")[0].partition("#")[0]


def _is_among(endpoint: str, ends: set[str]) -> bool:
    """By protocol and port, because names are not looked up."""
    address = address_of(endpoint)
    if address.protocol == "unixsock-stream":
        return _without_settings(endpoint) in ends
    port = f":{address.port}" if address.protocol in ("tcp", "tls") else ""
    return any(end.startswith(f"{address.protocol}/") and end.endswith(port) for end in ends)


def access_control(members: Members) -> dict[str, Any]:
    """Zenoh's setting ``access_control``: deny by default, in both directions."""
    names: dict[tuple[Role, str], list[str]] = defaultdict(list)
    for name, member in members.members.items():
        names[member.role, member.car].append(name)
    rules: list[dict[str, Any]] = []
    subjects: list[dict[str, Any]] = []
    policies: list[dict[str, Any]] = []
    for number, ((role, car), bearers) in enumerate(sorted(names.items())):
        subject = f"{role}-{number}"
        granted = _rules(subject, role, car)
        rules += granted
        subjects.append({"id": subject, "cert_common_names": sorted(bearers)})
        policies.append({"rules": [rule["id"] for rule in granted], "subjects": [subject]})
    return {
        "enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects,
        "policies": policies,
    }  # fmt: skip


def _rules(subject: str, role: Role, car: str) -> list[dict[str, Any]]:
    """One rule for each direction and kind of message that such a process may exchange."""
    keys: dict[tuple[str, str], set[str]] = defaultdict(set)
    for right, key in _rights(role):
        for flow, kind, other in _MEANS[right]:
            keys[flow, kind].add(other or key.format(car=car, source="*"))
    if role == "router":  # forwards everything
        kinds = {kind for means in _MEANS.values() for _, kind, _ in means} | {"delete"}
        keys = {(flow, kind): {_ANY} for flow in ("ingress", "egress") for kind in kinds}
    return [
        {
            "id": f"{subject}-{kind}-{flow}", "permission": "allow", "flows": [flow],
            "messages": [kind], "key_exprs": sorted(some),
        }
        for (flow, kind), some in sorted(keys.items())
    ]  # fmt: skip


def _rights(role: Role) -> Iterator[tuple[str, str]]:
    """What a process of this role may do, and the key for any car."""

    def own(key: str, sources: Iterable[Source]) -> Iterator[str]:
        named = {"shadow": "*"}  # by its user
        ours = (one for one in sources if ROLE_OF[one] == role)
        return (key.replace("{source}", named.get(one, one)) for one in ours)

    for topic in TOPICS:
        yield from (("sends", key) for key in own(topic.key, topic.sources))
        if role in topic.readers:
            yield "receives", topic.key
    if role in RECORDERS:  # they receive of it what they may read
        yield "subscribes", EVERYTHING
    for service in SERVICES:
        yield from (("answers", key) for key in own(service.key, service.servers))
        if role in service.clients:
            yield from (("asks", service.key.replace("{source}", s)) for s in service.servers)
    # Who is there is no secret among members; only that process may say so of itself.
    yield from (("is seen", key) for key in own(ALIVE, ALIVE_SOURCES))
    yield from (("sees", ALIVE.replace("{source}", one)) for one in ALIVE_SOURCES)
    yield "looks for", ALIVE
