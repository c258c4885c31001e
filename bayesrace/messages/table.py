"""The table of everything that crosses a process boundary: key, message, rate, quality of service,
and who may send and receive it.

A topic is published; a service is a request with an answer. ``{car}`` and ``{source}`` in a key
stand for the car's name and the process, or the name of a shadow. Who may do what is said by role:
the access control of secured links (:mod:`bayesrace.transport.session`) is generated from these
columns.
"""

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, Generic, Literal, TypeVar

from bayesrace.errors import InputError
from bayesrace.messages.types import (
    Actuation,
    BrakingPlan,
    Command,
    Event,
    GoOnRequest,
    Hold,
    Message,
    Reply,
    RollbackRequest,
    RunRequest,
    State,
    Status,
    StatusRequest,
    StopRequest,
    Telemetry,
    Truth,
)

__all__ = [
    "ACTUATION", "ALIVE", "ALIVE_SOURCES", "BRAKING", "COMMAND", "EVENT", "EVERYTHING", "GO_ON",
    "HEARTBEAT", "HOLD", "RECORDERS", "ROLE_OF", "ROLLBACK", "RUN", "SERVICES",
    "SHADOW_ACTUATION", "SHADOW_TELEMETRY", "STATE", "STATUS", "STOP", "TELEMETRY", "TOPICS",
    "TRUTH", "WEIGHTS", "Qos", "Role", "Service", "Source", "Topic", "car_key", "is_car_name",
    "topic_of",
]  # fmt: skip

M = TypeVar("M", bound=Message)
A = TypeVar("A", bound=Message)

Source = Literal["plant", "controller", "race", "recorder", "director", "shadow"]
"""Part of a process that sends, as named in keys; a shadow has a name of its own there."""

Role = Literal["plant", "controller", "shadow", "learning", "director", "viewer", "router"]
"""What a process may do. A shadow decides as a controller does, and drives nothing; learning sends
weights, a director does that and commands and records, a viewer looks on, a router forwards for the
others."""

ROLE_OF: Final[dict[Source, Role]] = {
    "plant": "plant", "controller": "controller", "race": "director", "recorder": "director",
    "director": "director", "shadow": "shadow",
}  # fmt: skip

_CAR_NAME = re.compile(r"[A-Za-z0-9_-]{1,40}")


@dataclass(frozen=True)
class Qos:
    """Quality of service of a topic; delivery is reliable and in order on each link.

    In lockstep every topic blocks its sender rather than lose a message. ``realtime_blocks``: it
    does so in free-running mode, too, where the others drop what the link cannot take.
    """

    priority: Literal["real_time", "data", "data_low"]
    express: bool
    """Sent at once, never batched."""
    realtime_blocks: bool = False


@dataclass(frozen=True)
class Topic(Generic[M]):
    """One row of the table of published messages."""

    name: str
    key: str
    """Key expression with its placeholders."""
    message: type[M]
    sources: tuple[Source, ...]
    """Who sends it: no other role than theirs may."""
    readers: tuple[Role, ...]
    """Who may receive it."""
    rate: str
    qos: Qos


@dataclass(frozen=True)
class Service(Generic[M, A]):
    """One row of the table of requests. ``request`` None: the payload is a weights file."""

    name: str
    key: str
    request: type[M] | None
    answer: type[A]
    servers: tuple[Source, ...]
    """Who answers it."""
    clients: tuple[Role, ...]
    """Who may send it."""
    timeout_s: float
    repeatable: bool = True
    """Idempotent: a client repeats a request that was lost with its link."""
    urgent: bool = False
    """Served before what else waits, in places of its own."""
    shared: bool = False
    """All requests that wait have one place, and one answer."""


_CONTROL: Final = Qos("real_time", express=True)
_REPORT: Final = Qos("data_low", express=False)
_NEWS: Final = Qos("data", express=True, realtime_blocks=True)

_WATCHING: Final[tuple[Role, ...]] = ("learning", "director", "viewer")

STATE: Final = Topic(
    "state", "bayesrace/{car}/state", State, ("plant",),
    ("controller", "shadow", *_WATCHING), "each period (50 Hz by default)", _CONTROL,
)  # fmt: skip
TRUTH: Final = Topic(
    "truth", "bayesrace/{car}/truth", Truth, ("plant",), ("director", "viewer"), "each state",
    _REPORT,
)  # fmt: skip
ACTUATION: Final = Topic(
    "actuation", "bayesrace/{car}/actuation", Actuation, ("controller",),
    ("plant", "shadow", *_WATCHING), "each cycle", _CONTROL,
)  # fmt: skip
TELEMETRY: Final = Topic(
    "telemetry", "bayesrace/{car}/telemetry", Telemetry, ("controller",), _WATCHING, "each cycle",
    _REPORT,
)  # fmt: skip
BRAKING: Final = Topic(
    "braking", "bayesrace/{car}/braking", BrakingPlan, ("controller",), ("plant", *_WATCHING),
    "each cycle in real time, at most one a stage", _CONTROL,
)  # fmt: skip
EVENT: Final = Topic(
    "event", "bayesrace/{car}/event/{source}", Event, ("plant", "controller", "race", "recorder"),
    _WATCHING, "when something happens", _NEWS,
)  # fmt: skip
HEARTBEAT: Final = Topic(
    "heartbeat", "bayesrace/{car}/status/{source}", Status, ("plant", "controller"), _WATCHING,
    "10 Hz", _REPORT,
)  # fmt: skip
HOLD: Final = Topic(
    "hold", "bayesrace/{car}/hold", Hold, ("director",), ("plant", "controller"),
    "20 Hz in a held run", _CONTROL,
)  # fmt: skip
SHADOW_ACTUATION: Final = Topic(
    "shadow_actuation", "bayesrace/{car}/shadow/{source}/actuation", Actuation, ("shadow",),
    ("director", "viewer"), "each actuation of the controller, which alone is carried out", _REPORT,
)  # fmt: skip
SHADOW_TELEMETRY: Final = Topic(
    "shadow_telemetry", "bayesrace/{car}/shadow/{source}/telemetry", Telemetry, ("shadow",),
    ("director", "viewer"), "the same", _REPORT,
)  # fmt: skip
TOPICS: Final[tuple[Topic[Any], ...]] = (
    STATE, TRUTH, ACTUATION, BRAKING, TELEMETRY, EVENT, HEARTBEAT, HOLD, SHADOW_ACTUATION,
    SHADOW_TELEMETRY,
)  # fmt: skip

RUN: Final = Service(
    "run", "bayesrace/{car}/plant/run", RunRequest, Reply, ("plant",), ("director",), 20.0, False,
    urgent=True,
)  # fmt: skip
"""Urgent as its stop is, which must not overtake it."""
STOP: Final = Service(
    "stop", "bayesrace/{car}/plant/stop", StopRequest, Reply, ("plant",), ("director",), 5.0, False,
    urgent=True,
)  # fmt: skip
GO_ON: Final = Service(
    "go_on", "bayesrace/{car}/plant/go_on", GoOnRequest, Reply, ("plant",), ("director",), 5.0,
    False, urgent=True,
)  # fmt: skip
STATUS: Final = Service(
    "status", "bayesrace/{car}/{source}/status", StatusRequest, Status, ("plant", "controller"),
    ("plant", *_WATCHING), 5.0, shared=True,
)  # fmt: skip
"""The plant's certificate may ask for 'bayesrace doctor' on its machine."""
WEIGHTS: Final[Service[Message, Reply]] = Service(
    "weights", "bayesrace/{car}/controller/weights", None, Reply, ("controller",),
    ("learning", "director"), 20.0,
)  # fmt: skip
"""The payload is a weights file (:mod:`bayesrace.gp.weights`). The answer comes when the weights
are in use or refused: after a first cycle, earlier requests, and the checks."""
ROLLBACK: Final = Service(
    "rollback", "bayesrace/{car}/controller/rollback", RollbackRequest, Reply, ("controller",),
    ("learning", "director"), 20.0, False,
)  # fmt: skip
COMMAND: Final = Service(
    "command", "bayesrace/{car}/controller/command", Command, Reply, ("controller",),
    ("director",), 5.0, urgent=True,
)  # fmt: skip
SERVICES: Final[tuple[Service[Any, Any], ...]] = (
    RUN, STOP, GO_ON, STATUS, WEIGHTS, ROLLBACK, COMMAND
)  # fmt: skip

ALIVE: Final = "bayesrace/{car}/alive/{source}/*"
"""Liveliness tokens, which everyone may see: each process has one, with the id of its session in
place of the last part. Two processes of one name are two tokens."""
ALIVE_SOURCES: Final[tuple[Source, ...]] = ("plant", "controller", "director")
"""Who has one."""

EVERYTHING: Final = "bayesrace/{car}/**"
"""What a recorder subscribes to; it receives what its role may read."""
RECORDERS: Final[tuple[Role, ...]] = ("director", "viewer")
"""Who may."""

_FIXED: Final = {tuple(topic.key.split("/")[2::2]): topic for topic in TOPICS}
"""By the parts of their keys that stand for nothing else."""


def is_car_name(name: str) -> bool:
    """Whether a car of this name can have keys: up to 40 letters, digits, '-' or '_'."""
    return _CAR_NAME.fullmatch(name) is not None


def car_key(template: str, car: str, source: str = "") -> str:
    """A key of the table for one car and, where it has one, source; InputError at a bad name."""
    if not is_car_name(car):
        raise InputError(
            f"car name '{car[:60]}' cannot be part of a key; "
            "use up to 40 letters, digits, '-' or '_'"
        )
    return template.format(car=car, source=source)


@lru_cache(512)
def topic_of(key: str) -> Topic[Any] | None:
    """The table's row for a key such as ``bayesrace/orca/state``; None for any other key."""
    parts = key.split("/")
    topic = _FIXED.get(tuple(parts[2::2])) if parts[0] == "bayesrace" else None
    if topic is None or len(parts) != len(topic.key.split("/")):
        return None
    if len(parts) == 3 or parts[3] in topic.sources:
        return topic
    return topic if topic.sources == ("shadow",) and is_car_name(parts[3]) else None
