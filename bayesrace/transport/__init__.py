"""Zenoh, wrapped thinly.

``endpoints`` says where a process listens and connects, ``credentials`` holds its certificate, and
``session`` opens a session with both, and with the access control that follows from the table of
messages. ``publisher`` sends messages, ``inbox`` is the one
subscriber, ``requests`` sends requests and serves them; ``director`` starts and follows runs, and
``hold`` notices that it is missing.
"""

from bayesrace.transport.credentials import Credentials, Member, Members
from bayesrace.transport.director import Director, RefusedError
from bayesrace.transport.endpoints import (
    CONTROLLER_ENDPOINT,
    PLANT_ENDPOINT,
    Endpoint,
    Endpoints,
    LinkLimits,
    check_descriptors,
    free_endpoint,
    private_endpoints,
)
from bayesrace.transport.inbox import LOCKSTEP_SPIN_S, NEWEST, POLL_S, Inbox, Item, Kind
from bayesrace.transport.publisher import HEARTBEAT_S, Heartbeat, Publisher
from bayesrace.transport.requests import (
    Answers,
    Request,
    ask,
    ask_all,
    count_processes,
    decisive,
    declare_service,
    decode_request,
    send_rollback,
    send_weights,
)
from bayesrace.transport.session import check_session, open_session, open_sessions, unlinked

__all__ = [
    "CONTROLLER_ENDPOINT", "HEARTBEAT_S", "LOCKSTEP_SPIN_S", "NEWEST", "PLANT_ENDPOINT", "POLL_S",
    "Answers", "Credentials", "Director", "Endpoint", "Endpoints", "Heartbeat", "Inbox", "Item",
    "Kind", "LinkLimits", "Member", "Members", "Publisher", "RefusedError", "Request",
    "ask", "ask_all", "check_descriptors", "count_processes", "decisive",
    "declare_service", "decode_request", "free_endpoint", "open_session", "open_sessions",
    "private_endpoints",
    "send_rollback", "send_weights", "check_session", "unlinked",
]  # fmt: skip
