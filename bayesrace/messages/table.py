"""The process boundary in one table: key expression, message, rate, quality of service."""

import re
from dataclasses import dataclass
from typing import Any, Final, Generic, Literal, TypeVar

from bayesrace.errors import InputError
from bayesrace.messages.types import (
    Actuation,
    ClockReading,
    ClockRequest,
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
    "ACTUATION",
    "ALIVE",
    "CLOCK",
    "COMMAND",
    "EVENT",
    "HEARTBEAT",
    "ROLLBACK",
    "RUN",
    "SERVICES",
    "STATE",
    "STATUS",
    "STOP",
    "TELEMETRY",
    "TOPICS",
    "TRUTH",
    "WEIGHTS",
    "Qos",
    "Service",
    "Topic",
    "car_key",
]

M = TypeVar("M", bound=Message)
A = TypeVar("A", bound=Message)

Source = Literal["plant", "controller", "race", "recorder"]

_CAR_NAME = re.compile(r"[A-Za-z0-9_-]{1,40}")


@dataclass(frozen=True)
class Qos:
    """How a topic travels.

    In lockstep every topic blocks the sender rather than lose a message; ``wall_clock_blocks``
    says whether it does so in free-running mode too, where late is late.
    """

    priority: Literal["real_time", "interactive_high", "data", "data_low"]
    express: bool
    """Sent at once, never batched."""
    reliable: bool
    wall_clock_blocks: bool


@dataclass(frozen=True)
class Topic(Generic[M]):
    """One row of the table of published messages."""

    name: str
    key: str
    """Key expression; ``{car}`` and, for events, ``{source}`` are filled in."""
    message: type[M]
    sources: tuple[Source, ...]
    rate: str
    qos: Qos


@dataclass(frozen=True)
class Service(Generic[M, A]):
    """One row of the table of requests. ``request`` None: the payload is a weights file."""

    name: str
    key: str
    request: type[M] | None
    answer: type[A]
    timeout_s: float
    repeatable: bool = True
    """Asked twice, it does what it does once: a question that a link has lost is asked again."""


_CONTROL: Final = Qos("real_time", express=True, reliable=True, wall_clock_blocks=False)
_REPORT: Final = Qos("data_low", express=False, reliable=True, wall_clock_blocks=False)
_NEWS: Final = Qos("data", express=True, reliable=True, wall_clock_blocks=True)

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
    "event",
    "bayesrace/{car}/event/{source}",
    Event,
    ("plant", "controller", "race", "recorder"),
    "when something happens",
    _NEWS,
)
HEARTBEAT: Final = Topic(
    "heartbeat",
    "bayesrace/{car}/status/{source}",
    Status,
    ("plant", "controller"),
    "10 Hz",
    _REPORT,
)
TOPICS: Final[tuple[Topic[Any], ...]] = (STATE, TRUTH, ACTUATION, TELEMETRY, EVENT, HEARTBEAT)

RUN: Final = Service("run", "bayesrace/{car}/plant/run", RunRequest, Reply, 20.0, False)
STOP: Final = Service("stop", "bayesrace/{car}/plant/stop", StopRequest, Reply, 5.0, False)
STATUS: Final = Service("status", "bayesrace/{car}/{source}/status", StatusRequest, Status, 5.0)
WEIGHTS: Final[Service[Message, Reply]] = Service(
    "weights", "bayesrace/{car}/controller/weights", None, Reply, 20.0
)
"""The payload is a weights file (:mod:`bayesrace.gp.weights`). Answered once it is in use, or
refused; waits for a first cycle, for others that sent theirs before, and for the checks."""
ROLLBACK: Final = Service(
    "rollback", "bayesrace/{car}/controller/rollback", RollbackRequest, Reply, 20.0, False
)
COMMAND: Final = Service("command", "bayesrace/{car}/controller/command", Command, Reply, 5.0)
CLOCK: Final = Service("clock", "bayesrace/{car}/{source}/clock", ClockRequest, ClockReading, 2.0)
SERVICES: Final[tuple[Service[Any, Any], ...]] = (
    RUN, STOP, STATUS, WEIGHTS, ROLLBACK, COMMAND, CLOCK
)  # fmt: skip

ALIVE: Final = "bayesrace/{car}/alive/{source}"
"""Liveliness token of a process."""


def car_key(template: str, car: str, source: str = "") -> str:
    """A key expression of the table for one car (and one source, where the key has it)."""
    if not _CAR_NAME.fullmatch(car):
        raise InputError(
            f"car name '{car[:60]}' cannot be part of a key; "
            "use up to 40 letters, digits, '-' or '_'"
        )
    return template.format(car=car, source=source)
