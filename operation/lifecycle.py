"""Operating running cars: finding them, their status, stop and go, and the router.

What ``bayesrace status --json`` prints is one object, ``{"cars": {NAME: {"plant": P, "controller":
P}}}``, where P is null if no such process is there, and otherwise holds, always:

- ``answering``: its status is known; all from ``phase`` on is null if not;
- ``fault``: why it is not, or null;
- ``processes``: how many answer under this name; more than one is a mistake;
- ``status_age_s``: since the status arrived here [s];
- ``phase``, ``epoch``, ``run``, ``text``, ``weights_version``, ``track``, ``delay_s``: as in the
  message :class:`~bayesrace.messages.Status`;
- ``rate_hz``: of the loop, null in lockstep;
- ``state_age_s``: since the process received (controller) or sent (plant) its newest state [s],
  null before the first;
- ``counters``: name to number, all counters since the process started.

With ``--watch`` there is a line for each heartbeat, about the car that it came from.
"""

import logging
import time
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal, NamedTuple

from bayesrace.errors import InputError
from bayesrace.messages import (
    ALIVE,
    COMMAND,
    HEARTBEAT,
    STATUS,
    STOP,
    Command,
    Message,
    Reply,
    Service,
    Status,
    StatusRequest,
    StopRequest,
    car_key,
    is_car_name,
)
from bayesrace.transport import (
    Endpoints,
    Inbox,
    Kind,
    ask_all,
    decisive,
    open_session,
    open_sessions,
)
from bayesrace.transport.credentials import NEWEST_LIST

__all__ = [
    "SOURCES", "Action", "Found", "NetworkStatus", "ProcessStatus", "ask_statuses", "command_cars",
    "find", "follow", "pick", "route",
]  # fmt: skip

_log = logging.getLogger("bayesrace.router")

Found = Mapping[str, Collection[str]]
"""Name of a car to its processes whose liveliness token is present."""

Action = Literal["stop", "go", "end"]

SOURCES: Final = ("plant", "controller")
"""Processes that a car consists of."""

_SILENT_S: Final = 1.0
"""A process without a heartbeat for this long, ten periods, counts as not answering."""

_SPARE_S: Final = 2.0
"""How long after all runs a router may open its links anew."""

_DECLARATIONS_S: Final = 0.1
"""Time that declarations take to arrive after the last link is up."""


@dataclass(frozen=True)
class ProcessStatus:
    """What is known of a present process."""

    status: Status | None = None
    fault: str = ""
    """Why there is no status."""
    processes: int = 0
    """How many answered."""
    arrived_s: float = field(default_factory=time.monotonic)
    """Monotonic clock when the status arrived, or was missed."""

    def as_json(self, now_s: float) -> dict[str, Any]:
        """JSON as in the docstring of this module."""
        status = self.status
        known: dict[str, Any] = dict.fromkeys(
            ("phase", "epoch", "run", "text", "weights_version", "track", "rate_hz", "state_age_s")
        )
        known |= {"delay_s": None, "counters": None}
        if status is not None:
            known = {name: getattr(status, name) for name in known}
            known["rate_hz"] = status.rate_hz or None
            known["state_age_s"] = None if status.state_age_s < 0 else status.state_age_s
            known["counters"] = dict(status.counters)
        return {
            "answering": status is not None,
            "fault": self.fault or None,
            "processes": self.processes,
            "status_age_s": round(max(now_s - self.arrived_s, 0.0), 4),
            **known,
        }


class NetworkStatus:
    """All cars as known now."""

    def __init__(self, cars: Mapping[str, Mapping[str, ProcessStatus]]) -> None:
        self.cars: dict[str, dict[str, ProcessStatus]] = {
            car: dict(cars[car]) for car in sorted(cars)
        }

    @property
    def answering(self) -> bool:
        """Whether the status of any process is known."""
        return any(one.status for processes in self.cars.values() for one in processes.values())

    def put(self, car: str, source: str, process: ProcessStatus | None) -> None:
        """Update a process; None: it is gone."""
        processes = self.cars.setdefault(car, {})
        if process is None:
            processes.pop(source, None)
        else:
            processes[source] = process
        if not processes:
            del self.cars[car]

    def expire(self, now_s: float) -> None:
        """Drop each status whose process sends no heartbeats any more."""
        for processes in self.cars.values():
            for source, one in processes.items():
                if one.status is not None and now_s - one.arrived_s > _SILENT_S:
                    fault = f"no heartbeat for {_SILENT_S:g} s"
                    processes[source] = ProcessStatus(None, fault, 0, one.arrived_s)

    def as_json(self, only: str | None = None) -> dict[str, Any]:
        """JSON as in the docstring of this module; ``only``: one car."""
        now_s = time.monotonic()
        names = sorted(self.cars) if only is None else [only]
        return {
            "cars": {
                car: {
                    source: _json(self.cars.get(car, {}).get(source), now_s) for source in SOURCES
                }
                for car in names
            }
        }


def _json(process: ProcessStatus | None, now_s: float) -> dict[str, Any] | None:
    return None if process is None else process.as_json(now_s)


def find(
    session: Any,
    endpoints: Endpoints,
    timeout_s: float,
    name: str = "",
    sources: Collection[str] = SOURCES,
) -> Found:
    """Cars in the network with their present processes.

    Returns when the named car's ``sources`` are found, or all endpoints are connected and their
    processes known, or with what there is after the timeout. Raises InputError if that is nothing,
    or nothing of the named car.
    """
    key = ALIVE.format(car="*", source="*") if not name else car_key(ALIVE, name, "*")
    deadline = time.monotonic() + timeout_s
    complete_s: float | None = None
    while True:
        found = _tokens(session, key, timeout_s)
        now_s = time.monotonic()
        if name and set(sources) <= set(found.get(name, ())):
            return found
        if _connected(session) < len(endpoints.connect):
            complete_s = None
        elif complete_s is None:
            complete_s = now_s + _DECLARATIONS_S
        if now_s >= deadline or (complete_s is not None and found and now_s >= complete_s):
            break
        time.sleep(0.02)
    if not found:
        raise _not_found(session, endpoints, timeout_s, name)
    return found


def _connected(session: Any) -> int:
    return len(list(session.info.peers_zid())) + len(list(session.info.routers_zid()))


def _tokens(session: Any, key: str, timeout_s: float) -> dict[str, set[str]]:
    found: dict[str, set[str]] = {}
    for reply in session.liveliness().get(key, timeout=timeout_s):
        if reply.ok is not None and (place := _place(str(reply.ok.key_expr).rpartition("/")[0])):
            found.setdefault(place.car, set()).add(place.source)
    return found


class _Place(NamedTuple):
    car: str
    source: str


def _place(key: str) -> _Place | None:
    """Car and source of the key of a heartbeat, or of a token's without its last part; None if the
    table has no such process."""
    parts = key.split("/")
    known = len(parts) == 4 and is_car_name(parts[1]) and parts[3] in SOURCES
    return _Place(parts[1], parts[3]) if known else None


def _not_found(session: Any, endpoints: Endpoints, timeout_s: float, name: str) -> InputError:
    where = ", ".join(endpoints.connect)
    remedy = (
        "start 'bayesrace plant' and 'bayesrace controller', or give their endpoints (--endpoint)"
    )
    if endpoints.credentials is not None:
        remedy += f"; if both run, {NEWEST_LIST}"
    if not _connected(session):
        doctor = "'bayesrace doctor' says what is wrong"
        return InputError(f"no connection to {where} within {timeout_s:g} s; {remedy}; {doctor}")
    others = sorted(_tokens(session, ALIVE.format(car="*", source="*"), timeout_s)) if name else []
    if others:
        return InputError(f"no car '{name}' at {where}; cars found: {', '.join(others)}")
    return InputError(f"linked to {where}, but no car is visible there; {remedy}")


def ask_statuses(session: Any, found: Found, timeout_s: float) -> NetworkStatus:
    """The status of each process, those included that do not answer in time."""
    places = {
        car_key(STATUS.key, car, source): _Place(car, source)
        for car, sources in found.items()
        for source in sources
    }
    request = StatusRequest(seq=0, source_time_ns=time.monotonic_ns())
    network = NetworkStatus({})
    for key, answers in ask_all(session, STATUS, places, request, timeout_s).items():
        status = answers.valid[0] if answers.valid else None
        fault = "" if status else answers.fault or f"no answer within {timeout_s:g} s"
        network.put(*places[key], ProcessStatus(status, fault, answers.count))
    return NetworkStatus(network.cars)


def pick(found: Found, name: str, all_cars: bool, source: str = "controller") -> list[str]:
    """The cars to command: the named one, all, or the only one; InputError if that is unclear."""
    cars = sorted(car for car, sources in found.items() if source in sources)
    if not cars:
        other = "plant" if source == "controller" else "controller"
        raise InputError(
            f"no {source} found, only the {other} of {', '.join(sorted(found))}; "
            f"start 'bayesrace {source}', or give its endpoint (--endpoint)"
        )
    if name or all_cars or len(cars) == 1:
        return cars
    raise InputError(f"several cars found: {', '.join(cars)}; choose one with --name")


def command_cars(
    endpoints: Endpoints, action: Action, name: str, all_cars: bool, text: str, timeout_s: float
) -> tuple[list[str], list[str]]:
    """Commands the controllers of the cars that :func:`pick` chooses, all at once: what they answer
    in words, and what those answer that refuse or are silent.

    "end" ends the current runs of their plants. ``text``: the reason.
    """
    done, failed = [], []
    name, now_ns = endpoints.car_named(name), time.monotonic_ns()
    service: Service[Any, Reply] = COMMAND
    request: Message = Command(seq=0, source_time_ns=now_ns, command=action, text=text)
    if action == "end":
        service, request = STOP, StopRequest(seq=0, source_time_ns=now_ns, text=text)
    source = service.servers[0]
    with open_session(endpoints, "director", reports_absence=False) as session:
        cars = pick(find(session, endpoints, timeout_s, name, (source,)), name, all_cars, source)
        keys = {car_key(service.key, car): car for car in cars}
        found = ask_all(session, service, keys, request, timeout_s)
    for key, answers in found.items():
        answer = decisive(answers.valid)
        if answer is not None and answer.accepted:
            done.append(f"{keys[key]}: {answer.text}")
            continue
        silent = answers.fault or f"no answer within {timeout_s:g} s"
        why = f"failed: {silent}" if answer is None else f"refused: {answer.text}"
        failed.append(f"{action} of car '{keys[key]}' {why}")
    return done, failed


def follow(
    session: Any, network: NetworkStatus, name: str, period_s: float
) -> Iterator[str | None]:
    """Updates the network from heartbeats and tokens, of one car or all (""), until a signal.

    Yields the car's name after each heartbeat, and None each ``period_s``. For the main thread.
    """
    inbox, due_s = Inbox(session, name or None), 0.0
    decoder = inbox.subscribe(HEARTBEAT)
    inbox.watch()
    with inbox.receive_signals():
        while True:
            if (now_s := time.monotonic()) >= due_s:
                network.expire(now_s)
                yield None
                # After a slow display there is still time to receive.
                due_s = time.monotonic() + period_s
            item = inbox.get(max(due_s - time.monotonic(), 0.001))
            if item is None:
                continue
            if item.kind is Kind.SIGNAL:
                return
            place = _place(item.key)
            if place is None:
                continue
            if item.kind is Kind.MESSAGE:
                fault = "" if item.value else decoder.last_reason
                network.put(*place, ProcessStatus(item.value, fault, 1))
                yield place.car
            elif item.kind is Kind.GONE:
                network.put(*place, None)
            elif place.source not in network.cars.get(place.car, {}):
                network.put(*place, ProcessStatus(None, "no heartbeat yet"))


def route(endpoints: Endpoints) -> None:
    """Forward between all that connect to this process, until SIGINT or SIGTERM."""
    # In this order: opening may wait for an endpoint, which a signal then ends.
    with open_sessions(endpoints, "router") as sessions:
        inbox, spare_s = Inbox(sessions.current, None), 0.0
        inbox.subscribe(HEARTBEAT, "plant")
        with inbox.receive_signals():
            _log.info("router on %s", ", ".join(endpoints.listen))
            while (item := inbox.get(_SILENT_S)) is None or item.kind is not Kind.SIGNAL:
                if item is not None and item.value is not None and item.value.phase == "running":
                    spare_s = time.monotonic() + _SPARE_S
                elif time.monotonic() > spare_s and (session := sessions.renewed()) is not None:
                    inbox.bind(session)
