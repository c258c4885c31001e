"""Opening a Zenoh session with nothing left to defaults, and publishing by the table's rules.

Topology of a run: the plant listens; the controller connects to the plant and listens itself; who
records or directs connects to both, because peers do not forward for each other. Or all of them
connect to a router, which does, between peers of different :data:`Role`. Multicast and gossip are
off, so a process talks to the endpoints it was given and to nobody else.
"""

import json
import os
import re
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final, Generic, Literal, TypeVar, get_args

import zenoh
from pydantic import BaseModel, ConfigDict, Field

from bayesrace.errors import InputError
from bayesrace.messages import Message, Topic, car_key, encode

__all__ = [
    "CONTROLLER_ENDPOINT",
    "PLANT_ENDPOINT",
    "Endpoints",
    "Publisher",
    "Role",
    "free_endpoint",
    "open_session",
]

M = TypeVar("M", bound=Message)

Role = Literal["plant", "controller", "observer"]
"""What a process is in the network: its Zenoh region. A router takes the peers of one region to be
connected among themselves and forwards between regions only; that suits us, as no two plants, no
two controllers and no two observers (whoever else) have anything to tell each other."""

PLANT_ENDPOINT: Final = "tcp/127.0.0.1:7447"
"""Where a plant listens unless told otherwise: loopback only."""

CONTROLLER_ENDPOINT: Final = "tcp/127.0.0.1:7448"
"""Where a controller listens unless told otherwise: loopback only."""

_PROTOCOLS: Final = ("tcp", "udp", "tls", "quic", "ws", "unixsock-stream")
_ENDPOINT: Final = re.compile(rf"({'|'.join(_PROTOCOLS)})/[^\s#?]+([?#]\S*)?")
_INTERNET: Final = re.compile(r"[a-z]+/(\[[^\]]+\]|[^:/\s]+):(\d{1,5})([?#]\S*)?")

# One receiving worker hands over between threads less often than the default of two.
_RUNTIME: Final = "(rx: (worker_threads: 1))"
_LEASE_MS: Final = 5000
"""Without a sign of life for so long a link is given up: a machine may stall for less."""
_HANDSHAKE_MS: Final = 2000
"""For who connects, and for who is connected to and stays silent."""
_MOST_PENDING: Final = 10_000
"""Connections that may be silent at once. With Zenoh's default of 100, a port scan held up the
states of a car that was driving for a second."""
_RETRY: Final = {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5}

# Zenoh's own tools tell no region: they form one more, and clients another.
_FILTERS: Final[list[dict[str, list[str]]]] = [
    *({"modes": ["peer"], "region_names": [role]} for role in get_args(Role)),
    {"modes": ["peer"]},
    {"modes": ["client"]},
]
_ROUTER: Final = {"south": [{"filters": [one]} for one in _FILTERS]}


class Endpoints(BaseModel):
    """Where a process listens and to whom it connects."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    listen: tuple[str, ...] = Field(
        default=(), description="endpoints to listen on, 'tcp/address:port'"
    )
    connect: tuple[str, ...] = Field(
        default=(), description="endpoints to connect to; retried for as long as the process runs"
    )
    low_latency: bool = Field(
        default=False,
        description="send in the calling thread to peers that do so too, without priorities: "
        "for lockstep, where the sender waits for the answer anyway",
    )
    """A link is of this kind if both ends ask for it; other links of the process stay as they are.
    It saves two thread changes a message, but blocks where the table says drop, and carries at
    most 60 kB a message: not for free-running, and not for whoever sends weights."""
    mode: Literal["peer", "router"] = Field(
        default="peer", description="router: forward between those that connect to this process"
    )


def _check_endpoint(endpoint: str) -> None:
    if not _ENDPOINT.fullmatch(endpoint):
        raise InputError(
            f"endpoint '{endpoint}' is not of the form protocol/address, such as "
            f"{PLANT_ENDPOINT}; protocols: {', '.join(_PROTOCOLS)}"
        )
    if endpoint.startswith("unixsock-stream/"):
        return
    internet = _INTERNET.fullmatch(endpoint)
    if internet is None or int(internet[2]) > 65535:
        raise InputError(f"endpoint '{endpoint}' lacks a port from 0 to 65535: {PLANT_ENDPOINT}")


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
    """A Zenoh session that is closed on the way out, whatever happens.

    Raises InputError if an endpoint is malformed or cannot be listened on. A peer that is absent
    is no error here: it is connected to as soon as it appears; see :class:`.Inbox` for waiting
    with a limit.
    """
    os.environ.setdefault("ZENOH_RUNTIME", _RUNTIME)
    for endpoint in (*endpoints.listen, *endpoints.connect):
        _check_endpoint(endpoint)
    for endpoint in endpoints.listen:
        _check_free(endpoint)
    try:
        session = zenoh.open(_config(endpoints, role))
    except zenoh.ZError as error:
        where = ", ".join((*endpoints.listen, *endpoints.connect)) or "no endpoint"
        raise InputError(
            f"cannot open a session on {where}: {_first_line(error)}; "
            "choose another endpoint or end the process that uses it"
        ) from None
    with session:
        yield session


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0][:300]


def _check_free(endpoint: str) -> None:
    """A clearer error than the transport's own for the commonest mistake."""
    internet = _INTERNET.fullmatch(endpoint)
    if internet is None or not endpoint.startswith(("tcp/", "tls/", "ws/")):
        return
    host, port = internet[1].strip("[]"), int(internet[2])
    try:
        family, kind, proto, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        with socket.socket(family, kind, proto) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        raise InputError(
            f"cannot listen on {endpoint}: {error.strerror or error}; "
            "choose another endpoint or end the process that uses it"
        ) from None


def free_endpoint() -> str:
    """A loopback endpoint that nobody listens on at the moment, for runs that start processes."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


class Publisher(Generic[M]):
    """Sends one topic's messages with the table's quality of service, and numbers them."""

    def __init__(
        self, session: Any, topic: Topic[M], car: str, source: str = "", *, waits: bool = True
    ) -> None:
        """``waits`` False: by the wall clock never wait, whatever the table says: for a control
        loop."""
        key = car_key(topic.key, car, source)
        self._blocking = _declare(session, key, topic, blocking=True)
        self._dropping = (
            self._blocking
            if topic.qos.realtime_blocks and waits
            else _declare(session, key, topic, blocking=False)
        )
        self.next_seq = 0
        """``seq`` that the next message must carry."""
        self.sent_ns: int | None = None
        """Monotonic clock when the newest message had been sent."""

    def put(self, message: M, *, lockstep: bool) -> None:
        """Send; in lockstep waits rather than lose it, by the wall clock loses it rather than
        wait (unless the table says otherwise)."""
        (self._blocking if lockstep else self._dropping).put(encode(message))
        self.next_seq = message.seq + 1
        self.sent_ns = time.monotonic_ns()


def _declare(session: Any, key: str, topic: Topic[Any], *, blocking: bool) -> Any:
    control = zenoh.CongestionControl
    reliability = zenoh.Reliability
    return session.declare_publisher(
        key,
        express=topic.qos.express,
        priority=getattr(zenoh.Priority, topic.qos.priority.upper()),
        congestion_control=control.BLOCK if blocking else control.DROP,
        reliability=reliability.RELIABLE,
    )
