"""Messages between processes.

``rules`` checks one field, ``types`` has the message classes, ``table`` the topics and services,
``codec`` turns messages into bytes and refuses everything else.
"""

from bayesrace.messages.codec import Decoder, decode, encode, json_schema
from bayesrace.messages.rules import Scalar
from bayesrace.messages.table import (
    ACCEPTED,
    ACTUATION,
    ALIVE,
    COMMAND,
    EVENT,
    HEARTBEAT,
    ROLLBACK,
    RUN,
    SERVICES,
    STATE,
    STATUS,
    STOP,
    TELEMETRY,
    TOPICS,
    TRUTH,
    WEIGHTS,
    Qos,
    Service,
    Topic,
    car_key,
    is_car_name,
)
from bayesrace.messages.types import (
    Actuation,
    CarSample,
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
    "SERVICES", "STATE", "STATUS", "STOP", "TELEMETRY", "TOPICS", "TRUTH", "WEIGHTS", "Actuation",
    "CarSample", "Command", "Decoder", "Event", "Message", "Qos",
    "Reply", "RollbackRequest", "RunRequest", "Scalar", "Service", "State", "Status",
    "StatusRequest", "StopRequest", "Telemetry", "Topic", "Truth", "car_key", "decode", "encode",
    "is_car_name", "json_schema",
]  # fmt: skip
