"""Zenoh sessions with explicit endpoints.

Topology of a run: the plant listens; the controller connects to the plant and listens itself;
recorders and directors connect to both, because peers do not forward for each other. Or all connect
to a router, which forwards between peers of different :data:`Role`. Multicast and gossip are off,
so a process connects to its endpoints only.
"""

import json
import os
import re
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final, Literal, get_args

import zenoh
from pydantic import BaseModel, ConfigDict, Field

from bayesrace.errors import InputError

__all__ = [
    "CONTROLLER_ENDPOINT", "PLANT_ENDPOINT", "Endpoints", "Role", "free_endpoint", "open_session",
]  # fmt: skip

Role = Literal["plant", "controller", "observer"]
"""Zenoh region of a process; an observer is any other process than plant and controller. A router
forwards between regions only, which suffices: processes of one role exchange no messages."""

PLANT_ENDPOINT: Final = "tcp/127.0.0.1:7447"
"""Where a plant listens by default: loopback only."""

CONTROLLER_ENDPOINT: Final = "tcp/127.0.0.1:7448"
"""Where a controller listens by default: loopback only."""

_ENDPOINT: Final = re.compile(
    r"unixsock-stream/[^\s#?]+([?#]\S*)?"
    r"|(tcp|udp|tls|quic|ws)/(\[[^\]]+\]|[^:/\s]+):(?P<port>\d{1,5})([?#]\S*)?"
)

# One receiving worker hands over between threads less often than the default of two.
_RUNTIME: Final = "(rx: (worker_threads: 1))"
_LEASE_MS: Final = 5000
"""A link without traffic for so long is closed; shorter stalls of a machine do no harm."""
_HANDSHAKE_MS: Final = 2000
"""Time limit of a handshake, for both ends."""
_MOST_PENDING: Final = 10_000
"""Connections in their handshake at once. With Zenoh's default of 100, a port scan held up the
states of a driving car for a second."""
_RETRY: Final = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5}

# Zenoh's own tools name no region: they form one more, and clients another.
_FILTERS: Final[list[dict[str, list[str]]]] = [
    *({"modes": ["peer"], "region_names": [role]} for role in get_args(Role)),
    {"modes": ["peer"]},
    {"modes": ["client"]},
]
_ROUTER: Final = {"south": [{"filters": [one]} for one in _FILTERS]}


class Endpoints(BaseModel):
    """Endpoints that a process listens on and connects to."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    listen: tuple[str, ...] = Field(
        default=(), description="endpoints to listen on, 'tcp/address:port'"
    )
    connect: tuple[str, ...] = Field(
        default=(), description="endpoints to connect to; retried as long as the process runs"
    )
    low_latency: bool = Field(
        default=False,
        description="send in the calling thread to peers that do so too, without priorities: "
        "for lockstep, where the sender waits for the answer anyway",
    )
    """Applies to links of which both ends have it. It saves two thread changes a message, but
    blocks where the table says drop, and carries at most 60 kB a message: not for free-running
    processes, and not for senders of weights."""
    mode: Literal["peer", "router"] = Field(
        default="peer", description="router: forward between those that connect to this process"
    )


def _check_endpoint(endpoint: str) -> None:
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or int(match["port"] or 0) > 65535:
        raise InputError(
            f"endpoint '{endpoint}' is not of the form protocol/address:port, such as "
            f"{PLANT_ENDPOINT}, or unixsock-stream/path; protocols: tcp, udp, tls, quic, ws"
        )


def _config(endpoints: Endpoints, role: Role) -> Any:
    config = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": endpoints.mode,
        **({"gateway": _ROUTER} if endpoints.mode == "router" else {"region_name": role}),
        "listen/endpoints": list(endpoints.listen),
        "listen/exit_on_failure": True,
        "connect/endpoints": list(endpoints.connect),
        # -1: try for ever, in the background; 0 would never reconnect.
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": _RETRY,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/link/tx/lease": _LEASE_MS,
        "transport/unicast/open_timeout": _HANDSHAKE_MS,
        "transport/unicast/accept_timeout": _HANDSHAKE_MS,
        "transport/unicast/accept_pending": _MOST_PENDING,
        # Each message of the control path is a batch of its own: with the default of two, a
        # receiver held up for two periods of 500 Hz loses states instead of getting them late.
        "transport/link/tx/queue/size/real_time": 16,
        # Pays only above 3 kB, and leaves segments behind when a process is killed.
        "transport/shared_memory/enabled": False,
        # Zenoh has one or the other.
        "transport/unicast/lowlatency": endpoints.low_latency,
        "transport/unicast/qos/enabled": not endpoints.low_latency,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


@contextmanager
def open_session(endpoints: Endpoints, role: Role = "observer") -> Iterator[Any]:
    """A Zenoh session, closed at the end of the block.

    Raises InputError if an endpoint is malformed or cannot be listened on. An absent peer is no
    error: the session connects as soon as it appears; see :class:`.Inbox` for waiting with a limit.
    """
    os.environ.setdefault("ZENOH_RUNTIME", _RUNTIME)
    for endpoint in (*endpoints.listen, *endpoints.connect):
        _check_endpoint(endpoint)
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


def free_endpoint() -> str:
    """A loopback endpoint that is free at the moment, for runs that start processes."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"
