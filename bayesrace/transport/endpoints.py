"""Where a process listens and connects, and how its links are limited and secured."""

import ipaddress
import re
import resource
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from tempfile import gettempdir
from typing import Annotated, Any, Final, Literal, NamedTuple

from pydantic import AfterValidator, Field, JsonValue

from bayesrace.errors import InputError
from bayesrace.files import temporary_folder
from bayesrace.strict import StrictModel
from bayesrace.transport.credentials import Credentials

__all__ = [
    "CONTROLLER_ENDPOINT", "PLANT_ENDPOINT", "Address", "Endpoint", "Endpoints", "LinkLimits",
    "ZenohSettings", "address_of", "check_descriptors", "free_endpoint", "leaves",
    "private_endpoints", "unreachable",
]  # fmt: skip

PLANT_ENDPOINT: Final = "tcp/127.0.0.1:7447"
"""Where a plant listens by default: loopback only."""

CONTROLLER_ENDPOINT: Final = "tcp/127.0.0.1:7448"
"""Where a controller listens by default: loopback only."""

_OURS: Final = (
    "mode", "id", "metadata", "listen", "connect", "region_name", "gateway", "access_control",
    "transport/link/tls", "transport/link/protocols", "transport/auth",
    "transport/unicast/lowlatency", "transport/unicast/qos", "scouting", "adminspace", "plugins",
    "plugins_loading",
)  # fmt: skip
"""Zenoh's settings that follow from ours, or that would let others in past them."""

_ENDPOINT: Final = re.compile(
    r"(?P<local>unixsock-stream)/(?P<path>[^\s#?]+)([?#]\S*)?"
    r"|(?P<protocol>tcp|udp|tls|quic|ws)/(?P<host>\[[^\]]+\]|[^:/\s]+):(?P<port>\d{1,5})([?#]\S*)?"
)


_SOCKETS: Final = re.compile(r"[^\s#?]{1,65}")
"""Folders in which sockets can be made; the system allows 108 characters of a socket's name."""

_DESCRIPTORS: Final = 64
"""Files and connections of a process with sessions: a race has up to 40 at once."""


def check_descriptors() -> None:
    """Lets this process, and those that it starts, open as many files and connections as they may.

    InputError if those are too few for a session, where Zenoh would panic.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != hard:
        with suppress(OSError, ValueError):  # the system has another limit yet
            resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
            soft = hard
    if 0 <= soft < _DESCRIPTORS:
        raise InputError(
            f"this process may open {soft} files and connections at once, and needs "
            f"{_DESCRIPTORS}: raise the limit (ulimit -n, or LimitNOFILE of a systemd unit)"
        )


class Address(NamedTuple):
    """Protocol, host and port of an endpoint; of a Unix socket, its path as the host."""

    protocol: str
    host: str = ""
    port: int = 0

    @property
    def loopback(self) -> bool:
        """Whether only processes of this machine reach it; names are not looked up."""
        if self.protocol == "unixsock-stream" or self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False


def address_of(endpoint: str) -> Address:
    """The parts of an endpoint; InputError if it is malformed."""
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or int(match["port"] or 0) > 65535 or not _encodes(match["host"] or ""):
        raise InputError(
            f"endpoint '{endpoint}' is not of the form protocol/address:port, such as "
            f"{PLANT_ENDPOINT}, or unixsock-stream/path; protocols: tcp, udp, tls, quic, ws"
        )
    if match["local"]:
        return Address(protocol=match["local"], host=match["path"])
    host = match["host"].strip("[]")
    return Address(protocol=match["protocol"], host=host, port=int(match["port"]))


def unreachable(endpoint: str) -> str:
    """Why no other machine reaches what listens there, by a name that is loopback on this one, with
    the remedy; empty otherwise."""
    address = address_of(endpoint)
    found: set[str] = set()
    with suppress(OSError):
        if not address.loopback:
            found = {str(one[4][0]) for one in socket.getaddrinfo(address.host, address.port)}
    if not found or any(not ipaddress.ip_address(one).is_loopback for one in found):
        return ""
    return (
        f"{endpoint}: '{address.host}' is {', '.join(sorted(found))} on this machine, which no "
        f"other one reaches: listen at {address.protocol}/0.0.0.0:{address.port} (plant: "
        "--endpoint, controller: --listen), or correct the name in /etc/hosts"
    )


def _encodes(host: str) -> bool:
    """Whether the system takes the name at all; what it does not, such as 'a..b', is no OSError."""
    try:
        host.encode("idna")
    except UnicodeError:
        return False
    return True


def _well_formed(endpoint: str) -> str:
    address_of(endpoint)
    return endpoint


Endpoint = Annotated[str, AfterValidator(_well_formed)]


def leaves(settings: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Nested settings by their paths, as Zenoh has them: 'transport/link/tx/lease'."""
    for name, value in settings.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{name}/")
        else:
            yield f"{prefix}{name}", value


def _beside_ours(settings: dict[str, Any]) -> dict[str, Any]:
    for written, _ in leaves(settings):
        path = "/".join(filter(None, written.split("/")))  # Zenoh skips what is empty
        if any(path == one or path.startswith(one + "/") for one in _OURS):
            raise ValueError(f"{path} follows from [network] and [tls]; leave it out")
    return settings


ZenohSettings = Annotated[dict[str, JsonValue], AfterValidator(_beside_ours)]
"""Settings of Zenoh, nested or by their paths, but for those that are made of ours."""


class LinkLimits(StrictModel):
    """What links may cost, and how soon a silent one is closed."""

    lease_s: float = Field(
        5.0, gt=0, le=600, description="silence after which a link is closed; shorter stalls pass"
    )
    handshake_s: float = Field(
        2.0, gt=0, le=60, description="time limit of a handshake, for both ends"
    )
    pending: int = Field(
        10_000, ge=1, le=100_000, description="connections in their handshake at once"
    )
    """With Zenoh's default of 100, a port scan held up the states of a driving car for a second."""
    sessions: int = Field(1000, ge=1, le=100_000, description="processes that are linked at once")


class Endpoints(StrictModel):
    """Endpoints that a process listens on and connects to, and what holds for its links."""

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
    credentials: Credentials | None = Field(
        None,
        exclude=True,
        description="certificate of this process; with one, every link is encrypted",
    )
    insecure: bool = Field(
        False, description="without a certificate: allow endpoints beyond loopback all the same"
    )
    limits: LinkLimits = LinkLimits()
    zenoh: ZenohSettings = Field({}, description="Zenoh's own settings, by their paths")

    def check(self) -> None:
        """InputError if an endpoint is malformed, or open to others without protection."""
        for endpoint in (*self.listen, *self.connect):
            address = address_of(endpoint)
            if self.credentials is not None and address.protocol != "tls":
                raise InputError(
                    f"endpoint {endpoint} is not encrypted, and this process has a certificate "
                    f"({self.credentials.folder}): write tls/, or leave the certificate out"
                )
            if self.credentials is not None and "#" in endpoint:
                raise InputError(
                    f"endpoint {endpoint} has settings of its own, which could switch the check of "
                    "certificates off: leave out what follows the '#'"
                )
            if self.credentials is None and address.protocol in ("tls", "quic"):
                raise InputError(
                    f"endpoint {endpoint} needs a certificate: make one with 'bayesrace certs', "
                    "and name its folder in [tls] of bayesrace.toml (docs/security.md)"
                )
        if self.exposed and not self.insecure:
            raise InputError(
                f"{', '.join(self.exposed)}: whoever is in that network could drive the car, since "
                "links without certificates are open; make certificates with 'bayesrace certs' "
                "(docs/security.md), or accept it with --insecure"
            )

    def check_car(self, car: str) -> None:
        """InputError if the certificate is for another car."""
        if self.credentials is not None:
            self.credentials.check_car(car)

    def car_named(self, name: str) -> str:
        """The car that is meant: the one named, or the certificate's; empty: any."""
        if name:
            self.check_car(name)
        return name or (self.credentials.car if self.credentials is not None else "")

    @property
    def exposed(self) -> list[str]:
        """Endpoints beyond loopback, where links are neither encrypted nor authenticated."""
        if self.credentials is not None:
            return []
        return [one for one in (*self.listen, *self.connect) if not address_of(one).loopback]


def free_endpoint(protocol: Literal["tcp", "tls"] = "tcp") -> str:
    """A loopback endpoint that is free at the moment, for runs that start processes."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"{protocol}/127.0.0.1:{probe.getsockname()[1]}"


@contextmanager
def private_endpoints(*names: str) -> Iterator[list[str]]:
    """Unix sockets of these names in a folder that only this user may enter, for the block.

    It is in TMPDIR, or in /tmp if the path of that folder cannot be part of an endpoint.
    """
    fits = _SOCKETS.fullmatch(gettempdir()) is not None
    with temporary_folder(None if fits else "/tmp") as folder:  # noqa: S108 (of one's own)
        yield [f"unixsock-stream/{folder}/{name}" for name in names]
