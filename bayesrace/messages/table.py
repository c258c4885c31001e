"""The table of everything that crosses a process boundary: key, message, rate, quality of service.

A topic is published; a service is a request with an answer. ``{car}`` and ``{source}`` in a key
stand for the car's name and the process.
"""

import re
from dataclasses import dataclass
from typing import Any, Final, Generic, Literal, TypeVar

from bayesrace.errors import InputError
from bayesrace.messages.types import (
    Actuation,
    Command,
    Event,
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
    "ACCEPTED", "ACTUATION", "ALIVE", "COMMAND", "EVENT", "HEARTBEAT", "ROLLBACK", "RUN",
    "SERVICES", "STATE", "STATUS", "STOP", "TELEMETRY", "TOPICS", "TRUTH", "WEIGHTS",
    "Qos", "Service", "Topic", "car_key", "is_car_name",
]  # fmt: skip

M = TypeVar("M", bound=Message)
A = TypeVar("A", bound=Message)

Source = Literal["plant", "controller", "race", "recorder"]

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
    rate: str
    qos: Qos


@dataclass(frozen=True)
class Service(Generic[M, A]):
    """One row of the table of requests.

    ``request`` or ``answer`` None: the payload is no message, but a weights file with or without a
    header.
    """

    name: str
    key: str
    request: type[M] | None
    answer: type[A] | None
    timeout_s: float
    repeatable: bool = True
    """Idempotent: a client repeats a request that was lost with its link."""


_CONTROL: Final = Qos("real_time", express=True)
_REPORT: Final = Qos("data_low", express=False)
_NEWS: Final = Qos("data", express=True, realtime_blocks=True)

STATE: Final = Topic(
    "state", "bayesrace/{car}/state", State, ("plant",), "each period (50 Hz by default)", _CONTROL
)
TRUTH: Final = Topic("truth", "bayesrace/{car}/truth", Truth, ("plant",), "each state", _REPORT)
ACTUATION: Final = Topic(
    "actuation", "bayesrace/{car}/actuation", Actuation, ("controller",), "each cycle", _CONTROL
)
TELEMETRY: Final = Topic(
    "telemetry", "bayesrace/{car}/telemetry", Telemetry, ("controller",), "each cycle", _REPORT
)
EVENT: Final = Topic(
    "event", "bayesrace/{car}/event/{source}", Event, ("plant", "controller", "race", "recorder"),
    "when something happens", _NEWS,
)  # fmt: skip
HEARTBEAT: Final = Topic(
    "heartbeat", "bayesrace/{car}/status/{source}", Status, ("plant", "controller"), "10 Hz",
    _REPORT,
)  # fmt: skip
TOPICS: Final[tuple[Topic[Any], ...]] = (STATE, TRUTH, ACTUATION, TELEMETRY, EVENT, HEARTBEAT)

RUN: Final = Service("run", "bayesrace/{car}/plant/run", RunRequest, Reply, 20.0, False)
STOP: Final = Service("stop", "bayesrace/{car}/plant/stop", StopRequest, Reply, 5.0, False)
STATUS: Final = Service("status", "bayesrace/{car}/{source}/status", StatusRequest, Status, 5.0)
WEIGHTS: Final[Service[Message, Reply]] = Service(
    "weights", "bayesrace/{car}/controller/weights", None, Reply, 20.0
)
"""The payload is a weights file (:mod:`bayesrace.gp.weights`). The answer comes when the weights
are in use or refused: after a first cycle, earlier requests, and the checks."""
ROLLBACK: Final = Service(
    "rollback", "bayesrace/{car}/controller/rollback", RollbackRequest, Reply, 20.0, False
)
ACCEPTED: Final[Service[Message, Message]] = Service(
    "accepted", "bayesrace/{car}/controller/accepted", None, None, 2.0
)
"""Request without payload, from a controller that starts later. The answer
(``controller/latecomer.py``) holds the file of the weights in use, its time of acceptance, and the
digests of withdrawn weights; empty without any."""
COMMAND: Final = Service("command", "bayesrace/{car}/controller/command", Command, Reply, 5.0)
SERVICES: Final[tuple[Service[Any, Any], ...]] = (
    RUN, STOP, STATUS, WEIGHTS, ROLLBACK, ACCEPTED, COMMAND
)  # fmt: skip

ALIVE: Final = "bayesrace/{car}/alive/{source}"
"""Liveliness token of a process."""


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
