"""Zenoh, wrapped thinly: sessions with explicit endpoints, publishers, one inbox per thread."""

from bayesrace.transport.client import (
    Director,
    RefusedError,
    ask,
    ask_all,
    count_processes,
    decisive,
    send_rollback,
    send_weights,
)
from bayesrace.transport.heartbeat import HEARTBEAT_S, Heartbeat
from bayesrace.transport.inbox import (
    LOCKSTEP_SPIN_S,
    NEWEST,
    Inbox,
    Item,
    Kind,
    Request,
    declare_service,
    decode_request,
)
from bayesrace.transport.numbering import Numbering
from bayesrace.transport.session import (
    CONTROLLER_ENDPOINT,
    PLANT_ENDPOINT,
    Endpoints,
    Publisher,
    free_endpoint,
    open_session,
)

__all__ = [
    "CONTROLLER_ENDPOINT",
    "HEARTBEAT_S",
    "LOCKSTEP_SPIN_S",
    "NEWEST",
    "PLANT_ENDPOINT",
    "Director",
    "Endpoints",
    "Heartbeat",
    "Inbox",
    "Item",
    "Kind",
    "Numbering",
    "Publisher",
    "RefusedError",
    "Request",
    "ask",
    "ask_all",
    "count_processes",
    "decisive",
    "declare_service",
    "decode_request",
    "free_endpoint",
    "open_session",
    "send_rollback",
    "send_weights",
]
