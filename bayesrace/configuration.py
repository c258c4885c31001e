"""``bayesrace.toml``: where the parts of a system are, how they are secured, and what they ask for.

One file serves every machine and every command. The environment variable ``BAYESRACE_CONFIG`` names
it, or the option ``--config``, which sets that variable: so processes that a command starts read
the same file. Options of a command override it.
"""

import itertools
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import BaseModel, Field, ValidationError, model_validator

from bayesrace.defaults import CONFIGURATION_VARIABLE
from bayesrace.errors import InputError, faults_in
from bayesrace.files import parse_toml, read_text
from bayesrace.log_parts import LogSize
from bayesrace.messages import Role
from bayesrace.realtime import RealtimeSettings
from bayesrace.transport.credentials import CERTIFICATE, COVERS, MEMBERS, Credentials
from bayesrace.transport.endpoints import (
    CONTROLLER_ENDPOINT,
    PLANT_ENDPOINT,
    Endpoint,
    Endpoints,
    LinkLimits,
    ZenohSettings,
    address_of,
)
from bayesrace.units import Section

__all__ = [
    "Configuration", "DriveSettings", "NetworkSettings", "TlsSettings", "as_toml", "configured",
    "read_configuration",
]  # fmt: skip

_LISTENERS: Final = "plant", "controller", "shadow", "router"


def _port(endpoint: str) -> tuple[str, int, bool]:
    """What one process alone can listen on."""
    address = address_of(endpoint)
    host = "127.0.0.1" if address.host == "localhost" else address.host
    return host or endpoint, address.port, address.protocol in ("udp", "quic")


class NetworkSettings(Section):
    """Where the processes are: an endpoint is protocol/host:port, a protocol tcp or tls."""

    mode: Literal["direct", "router"] | None = Field(
        None,
        description="direct: all others connect to plant and controller; router: all connect to it "
        "alone; not set: router, if one is named",
    )
    plant: tuple[Endpoint, ...] = Field(
        (PLANT_ENDPOINT,), description="where the plant listens, and the others find it"
    )
    controller: tuple[Endpoint, ...] = Field(
        (CONTROLLER_ENDPOINT,), description="where the controller listens, and the others find it"
    )
    shadow: tuple[Endpoint, ...] = Field(
        (), description="without a router: where a shadow listens, and directors find it"
    )
    router: tuple[Endpoint, ...] = Field(
        (), description="where the router listens, and all others find it"
    )
    hosts: tuple[Annotated[str, Field(pattern=r"^[\w.:/-]+$")], ...] = Field(
        (),
        description="other hosts that may connect, those of directors, say: names, addresses, "
        "networks; for 'bayesrace config firewall'",
    )
    insecure: bool = Field(
        False, description="without certificates: allow endpoints beyond loopback; warns each time"
    )

    @model_validator(mode="after")
    def _router_named(self) -> Self:
        if self.mode == "router" and not self.router:
            raise ValueError("mode 'router' needs an endpoint: name one, as router = [\"tcp/…\"]")
        return self

    def check(self) -> None:
        """InputError if two processes are to listen at one endpoint; by a router, only it does."""
        listening = ("router",) if self.by_router else _LISTENERS
        where = [(one, name) for name in listening for one in getattr(self, name)]
        for (one, name), (other, second) in itertools.combinations(where, 2):
            if _port(one) == _port(other):
                raise InputError(f"{name} and {second} both listen at {one}: give each its own")

    @property
    def by_router(self) -> bool:
        """Whether all connect to a router alone."""
        return bool(self.router) and self.mode != "direct"

    def listens(self, role: Role) -> tuple[str, ...]:
        """Where a process in that role listens; by a router, only it does."""
        own = getattr(self, role) if role in _LISTENERS else ()
        return own if role == "router" or not self.by_router else ()

    @property
    def everyone(self) -> tuple[str, ...]:
        """Endpoints by which every process is reached."""
        return self.router if self.by_router else (*self.plant, *self.controller, *self.shadow)


class TlsSettings(Section):
    """Certificates, as 'bayesrace certs' makes them. With a folder every link is encrypted."""

    folder: Path | None = Field(None, description="holds a folder for each certificate")
    use: dict[Role, str] = Field(
        {}, description="role of a process to its certificate, where it has not the role's name"
    )

    def credentials(self, role: Role) -> Credentials | None:
        """The certificate of a process in that role: its own, or of a role that covers it."""
        if self.folder is None:
            return None
        covering = (one for one, covered in COVERS.items() if role in covered)
        names = [self.use.get(one, one) for one in (role, *reversed(list(covering)))]
        there = (name for name in names if (self.folder / name).is_dir())
        return Credentials.read(self.folder / next(there, names[0]))

    def certificates(self) -> list[Credentials]:
        """Every certificate in the folder; InputError at one that cannot be used."""
        if self.folder is None or not self.folder.is_dir():
            return []
        # One of the two may have been forgotten.
        found = (one for name in (CERTIFICATE, MEMBERS) for one in self.folder.glob(f"*/{name}"))
        return [Credentials.read(folder) for folder in sorted({one.parent for one in found})]


class DriveSettings(Section):
    """How runs are driven."""

    hold_to_run: bool = Field(
        False,
        description="dead man's switch: 'drive' holds its runs, the plant refuses those of others",
    )
    max_log: LogSize | None = Field(
        None,
        description="size of the log that 'drive' writes at most, as \"500MB\": it goes on in new "
        "files, and the oldest are deleted; not set: no limit",
    )


class Configuration(Section):
    """Everything in the file; what is left out has its default."""

    network: NetworkSettings = NetworkSettings()
    tls: TlsSettings = TlsSettings()
    drive: DriveSettings = DriveSettings()
    realtime: RealtimeSettings = RealtimeSettings()
    limits: LinkLimits = LinkLimits()
    zenoh: ZenohSettings = Field(
        {}, description='Zenoh\'s own settings, such as "transport/link/tx/queue/size/data" = 4'
    )

    def endpoints(
        self,
        role: Role,
        *,
        listen: Sequence[str] = (),
        connect: Sequence[str] = (),
        low_latency: bool = False,
    ) -> Endpoints:
        """Where a process in that role listens and connects; what is given overrides the file."""
        network = self.network
        driven = (*network.plant, *network.controller)
        own: dict[Role, tuple[str, ...]]
        own = {"plant": (), "controller": network.plant, "shadow": driven}
        connects = network.everyone if network.by_router else own.get(role, network.everyone)
        return Endpoints(
            listen=tuple(listen or network.listens(role)),
            connect=tuple(connect or (() if role == "router" else connects)),
            low_latency=low_latency,
            mode="router" if role == "router" else "peer",
            credentials=self.tls.credentials(role),
            insecure=network.insecure,
            limits=self.limits,
            zenoh=self.zenoh,
        )

    def plain(self, plant: str, controller: str) -> Self:
        """The same for simulations on one machine whose processes meet there: without certificates
        and dead man's switch."""
        network = NetworkSettings(plant=(plant,), controller=(controller,))
        return self.model_copy(
            update={"network": network, "tls": TlsSettings(), "drive": DriveSettings()}
        )


def configured() -> Configuration:
    """The configuration of this process: the file in the environment variable, or the defaults."""
    name = os.environ.get(CONFIGURATION_VARIABLE, "")
    return read_configuration(Path(name)) if name else Configuration()


def read_configuration(path: Path) -> Configuration:
    """A file's content; paths in it are relative to its folder. InputError names every fault."""
    remedy = "write one with 'bayesrace config example'"
    content = parse_toml(read_text(path, "configuration", remedy), path, remedy)
    try:
        found = Configuration.model_validate(content)
    except ValidationError as error:
        faults = faults_in(error, "the file", Configuration)
        raise InputError(f"{path}: {faults}; all are in 'bayesrace config example'") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    folder = found.tls.folder
    if folder is None:
        return found
    folder = path.absolute().parent / folder.expanduser()
    tls = found.tls.model_copy(update={"folder": folder})
    return found.model_copy(update={"tls": tls})


def as_toml(configuration: Configuration, explained: bool = False) -> str:
    """The content of a file with these settings; ``explained``: to be filled in.

    That has what each setting means, and the settings as comments: what is added below them cannot
    be there twice.
    """
    lines: list[str] = []
    mark = "#" if explained else ""
    for name, field in Configuration.model_fields.items():
        section = getattr(configuration, name)
        fields = type(section).model_fields if isinstance(section, BaseModel) else {}
        if explained:
            words = field.description or (type(section).__doc__ or "").splitlines()[0]
            lines += [f"# {words}"]
        lines += [f"{mark}[{name}]"]
        for key, value in dict(section).items():
            if explained and key in fields:
                lines += [f"# {fields[key].description}"]
            setting = key if key in fields else _value(key)
            # TOML has no null: what is not set is a comment.
            lines += [f"#{key} =" if value is None else f"{mark}{setting} = {_value(value)}"]
        lines += [""]
    return "\n".join(lines[:-1]) + "\n"


def _value(value: Any) -> str:
    """A value in TOML. Texts are those of JSON, but for what JSON writes as two surrogates."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{_value(k)} = {_value(v)}" for k, v in value.items()) + "}"
    if isinstance(value, tuple | list):
        return "[" + ", ".join(map(_value, value)) + "]"
    return json.dumps(value, ensure_ascii=False, default=str)
