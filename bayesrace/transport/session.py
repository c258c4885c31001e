"""Zenoh sessions with explicit endpoints.

Topology of a run: the plant listens; the controller connects to the plant and listens itself;
recorders and directors connect to both, because peers do not forward for each other. Or all connect
to a router, which forwards between peers of different regions. Multicast and gossip are off, so a
process connects to its endpoints only.
"""

import json
import logging
import os
import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, Final

import zenoh

from bayesrace.errors import InputError
from bayesrace.messages import Role
from bayesrace.transport.access import access_control
from bayesrace.transport.credentials import AUTHORITY, CERTIFICATE, KEY, Credentials
from bayesrace.transport.endpoints import Endpoints, leaves
from bayesrace.transport.links import LinkWatch, refusals, serve_access, wait_linked
from bayesrace.transport.probe import Finding, probe_all

__all__ = ["check_links", "open_session"]

_log = logging.getLogger("bayesrace.links")

_REGIONS: Final = ("plant", "controller", "observer")
"""Zenoh region of a process; an observer is any other process than plant and controller. A router
forwards between regions only, which suffices: processes of one region exchange no messages."""

# One receiving worker hands over between threads less often than the default of two.
_RUNTIME: Final = "(rx: (worker_threads: 1))"
_RETRY: Final = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5}
_LINK_S: Final = 0.7
"""How long a secured session waits for the links that its handshakes have shown to be possible."""

# Zenoh's own tools name no region: they form one more, and clients another.
_FILTERS: Final[list[dict[str, list[str]]]] = [
    *({"modes": ["peer"], "region_names": [region]} for region in _REGIONS),
    {"modes": ["peer"]},
    {"modes": ["client"]},
]
_ROUTER: Final = {"south": [{"filters": [one]} for one in _FILTERS]}


def _config(endpoints: Endpoints, role: Role) -> Any:
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
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/lease": round(1e3 * limits.lease_s),
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
    endpoints: Endpoints, role: Role = "viewer", *, explains: bool = True
) -> Iterator[Any]:
    """A Zenoh session of a process in that role, closed at the end of the block.

    Raises InputError if an endpoint is malformed, open to others without protection, or cannot be
    listened on; if the certificate is not for the role; if a link is refused, here or at its other
    end. An absent peer is no error: the session connects as soon as it appears, and says in the log
    that it waits, unless it is not to ``explains`` because it has just started its peers itself;
    see :class:`.Inbox` for waiting with a limit.
    """
    os.environ.setdefault("ZENOH_RUNTIME", _RUNTIME)
    credentials, absent = endpoints.credentials, check_links(endpoints, role)
    if endpoints.exposed:
        _log.warning(
            "INSECURE: links by %s are open to everyone in that network, who could drive the car; "
            "see docs/security.md", ", ".join(endpoints.exposed),
        )  # fmt: skip
    if credentials is not None and (warning := credentials.expires_soon()):
        _log.warning("%s", warning)
    with ExitStack() as stack:
        session = stack.enter_context(_opened(endpoints, role))
        if credentials is not None:
            access = serve_access(session, credentials)
            stack.callback(access.undeclare)  # a process with a queryable hangs at its exit
            missing = {finding.endpoint for finding in absent}
            possible = [one for one in endpoints.connect if one not in missing]
            wait_linked(session, endpoints, possible, _LINK_S)
            if refused := refusals(session, credentials):
                raise InputError("; ".join(refused))
        if endpoints.connect and explains:
            stack.callback(LinkWatch(session, endpoints).close)
        yield session


def check_links(endpoints: Endpoints, role: Role) -> list[Finding]:
    """Where nobody is now, for a secured process; InputError for what waiting cannot help.

    :func:`open_session` does so first; for commands that have seconds of other work before.
    """
    endpoints.check()
    if endpoints.credentials is None:
        return []
    endpoints.credentials.check(role)
    found = probe_all(endpoints.connect, endpoints.credentials)
    if lasting := [finding.text for finding in found if finding.lasting]:
        raise InputError("; ".join(lasting))
    return found


@contextmanager
def _opened(endpoints: Endpoints, role: Role) -> Iterator[Any]:
    try:
        session = zenoh.open(_config(endpoints, role))
    except zenoh.ZError as error:
        text = re.sub(r" at /\S+", "", str(error).splitlines()[0])  # places in Zenoh's source
        cause = re.search(r"[^:\[]+ \(os error \d+\)", text)
        raise InputError(
            f"cannot listen on {', '.join(endpoints.listen) or 'no endpoint'}: "
            f"{(cause[0] if cause else text[:300]).strip()}; "
            "choose another endpoint or end the process that uses it"
        ) from None
    with session:
        yield session
