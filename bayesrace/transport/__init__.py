"""Zenoh, wrapped thinly.

``session`` opens a session with explicit endpoints; ``publisher`` sends messages, ``inbox`` is the
one subscriber, with ``requests`` for what it serves; ``client`` sends requests, ``director`` starts
and follows runs; ``numbering`` counts losses.
"""

from bayesrace.transport.client import (
    Answers,
    ask,
    ask_all,
    count_processes,
    decisive,
    fetch_all,
    send_rollback,
    send_weights,
)
from bayesrace.transport.director import Director, RefusedError
from bayesrace.transport.inbox import LOCKSTEP_SPIN_S, NEWEST, Inbox, Item, Kind
from bayesrace.transport.numbering import Numbering
from bayesrace.transport.publisher import HEARTBEAT_S, Heartbeat, Publisher
from bayesrace.transport.requests import Request, declare_service, decode_request
from bayesrace.transport.session import (
    CONTROLLER_ENDPOINT,
    PLANT_ENDPOINT,
    Endpoints,
    free_endpoint,
    open_session,
)

__all__ = [
    "CONTROLLER_ENDPOINT", "HEARTBEAT_S", "LOCKSTEP_SPIN_S", "NEWEST", "PLANT_ENDPOINT", "Answers",
    "Director", "Endpoints", "Heartbeat", "Inbox", "Item", "Kind", "Numbering", "Publisher",
    "RefusedError", "Request", "ask", "ask_all", "count_processes", "decisive", "declare_service",
    "decode_request", "fetch_all", "free_endpoint", "open_session", "send_rollback", "send_weights",
]  # fmt: skip
