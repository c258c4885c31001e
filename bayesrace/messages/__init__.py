"""Messages between processes.

``rules`` checks one field, ``types`` has the message classes, ``table`` the topics and services,
``codec`` turns messages into bytes and refuses everything else, ``json_form`` into JSON for logs.
"""

from bayesrace.messages.codec import Decoder, decode, encode
from bayesrace.messages.json_form import decode_json, json_schema, to_json
from bayesrace.messages.rules import Scalar
from bayesrace.messages.table import (
    ACTUATION,
    ALIVE,
    ALIVE_SOURCES,
    BRAKING,
    COMMAND,
    EVENT,
    EVERYTHING,
    HEARTBEAT,
    RECORDERS,
    ROLE_OF,
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
    Role,
    Service,
    Source,
    Topic,
    car_key,
    is_car_name,
)
from bayesrace.messages.types import (
    SENSOR_FAULTS,
    Actuation,
    BrakingPlan,
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
    "ACTUATION", "ALIVE", "ALIVE_SOURCES", "BRAKING", "COMMAND", "EVENT", "EVERYTHING", "HEARTBEAT",
    "RECORDERS", "ROLE_OF", "ROLLBACK", "RUN", "SENSOR_FAULTS", "SERVICES", "STATE", "STATUS",
    "STOP", "TELEMETRY", "TOPICS", "TRUTH", "WEIGHTS", "Actuation", "BrakingPlan", "CarSample",
    "Command", "Decoder", "Event", "Message", "Qos", "Reply", "Role", "RollbackRequest",
    "RunRequest", "Scalar", "Service", "Source", "State", "Status", "StatusRequest", "StopRequest",
    "Telemetry", "Topic", "Truth", "car_key", "decode", "decode_json", "encode", "is_car_name",
    "json_schema", "to_json",
]  # fmt: skip
