"""Looking after cars that drive: who is there, how they are, stop and go, and the router."""

import logging
import queue
import time
from collections.abc import Callable, Collection, Mapping
from typing import Any, Final, Literal, NamedTuple

import zenoh

from bayesrace.errors import InputError
from bayesrace.interrupts import catching_signals
from bayesrace.messages import (
    ALIVE,
    COMMAND,
    HEARTBEAT,
    STATUS,
    STOP,
    Command,
    Decoder,
    Message,
    Reply,
    Status,
    StatusRequest,
    StopRequest,
    car_key,
    decode,
)
from bayesrace.transport import Endpoints, ask_all, decisive, open_session
from experiments.picture import SOURCES, Picture, Process

__all__ = ["Found", "Word", "ask_statuses", "command", "find", "follow", "pick", "route"]

_log = logging.getLogger("bayesrace.router")

Found = Mapping[str, Collection[str]]
"""Name of a car to those of its processes whose liveliness token is there."""

Word = Literal["stop", "go", "end"]

_SETTLING_S: Final = 0.1
"""After the last link is up, a moment for what is declared behind it."""


def find(
    session: Any,
    endpoints: Endpoints,
    timeout_s: float,
    name: str = "",
    sources: Collection[str] = SOURCES,
) -> Found:
    """Cars in the network with those of their processes that are there.

    Returns as soon as the named car's ``sources`` are seen, or all endpoints are connected and
    have told of theirs; with what there is when the time is over. Raises InputError if that is
    nothing, or nothing of the named car.
    """
    key = ALIVE.format(car="*", source="*") if not name else car_key(ALIVE, name, "*")
    deadline = time.monotonic() + timeout_s
    settled_s: float | None = None
    while True:
        found = _tokens(session, key, timeout_s)
        now_s = time.monotonic()
        if name and set(sources) <= set(found.get(name, ())):
            return found
        if _connected(session) < len(endpoints.connect):
            settled_s = None
        elif settled_s is None:
            settled_s = now_s + _SETTLING_S
        if now_s >= deadline or (settled_s is not None and found and now_s >= settled_s):
            break
        time.sleep(0.02)
    if not found:
        raise _nobody(session, endpoints, timeout_s, name)
    return found


def _connected(session: Any) -> int:
    return len(list(session.info.peers_zid())) + len(list(session.info.routers_zid()))


def _tokens(session: Any, key: str, timeout_s: float) -> dict[str, set[str]]:
    found: dict[str, set[str]] = {}
    for reply in session.liveliness().get(key, timeout=timeout_s):
        if reply.ok is not None and (place := _place(str(reply.ok.key_expr), ALIVE)):
            found.setdefault(place.car, set()).add(place.source)
    return found


class _Place(NamedTuple):
    car: str
    source: str


def _place(key: str, template: str) -> _Place | None:
    """Car and source of a key; None for one that is not of this form."""
    parts, form = key.split("/"), template.split("/")
    if len(parts) != len(form):
        return None
    place = _Place(parts[form.index("{car}")], parts[form.index("{source}")])
    try:
        ours = place.source in SOURCES and car_key(template, *place) == key
    except InputError:
        ours = False
    return place if ours else None


def _nobody(session: Any, endpoints: Endpoints, timeout_s: float, name: str) -> InputError:
    where = ", ".join(endpoints.connect)
    start = "start 'bayesrace plant' and 'bayesrace controller', or name their endpoints"
    if not _connected(session):
        return InputError(f"nobody answers at {where} within {timeout_s:g} s; {start}: --endpoint")
    others = sorted(_tokens(session, ALIVE.format(car="*", source="*"), timeout_s)) if name else []
    if others:
        return InputError(f"no car '{name}' at {where}; there are: {', '.join(others)}")
    return InputError(f"no car at {where}, though somebody listens there; {start}: --endpoint")


def ask_statuses(session: Any, found: Found, timeout_s: float) -> Picture:
    """What the processes say of themselves, those included that do not answer in time."""
    keys = {
        car_key(STATUS.key, car, source): _Place(car, source)
        for car, sources in found.items()
        for source in sources
    }
    request = StatusRequest(0, time.monotonic_ns())
    answers = ask_all(session, keys, request, timeout_s)
    picture = Picture({})
    for key, place in keys.items():
        picture.put(*place, _process(answers[key], f"no answer within {timeout_s:g} s"))
    return Picture(picture.cars)


def _process(answers: list[bytes], fault: str) -> Process:
    status = None
    for data in answers:
        try:
            status = status or decode(Status, data)
        except InputError as error:
            fault = str(error)
    return Process(status, "" if status else fault, len(answers))


def pick(found: Found, name: str, everybody: bool, source: str = "controller") -> list[str]:
    """The cars to command: the named one, all, or the only one; InputError if that is unclear."""
    cars = sorted(car for car, sources in found.items() if source in sources)
    if not cars:
        other = "plant" if source == "controller" else "controller"
        raise InputError(
            f"no {source} can be reached, only the {other} of {', '.join(sorted(found))}; "
            f"start 'bayesrace {source}', or name its endpoint: --endpoint"
        )
    if name or everybody or len(cars) == 1:
        return cars
    raise InputError(f"several cars are there: {', '.join(cars)}; choose one with --name")


def command(
    session: Any, cars: Collection[str], word: Word, text: str, timeout_s: float
) -> dict[str, Reply | str]:
    """Tell the controllers of these cars, all at once; each one's answer, or why there is none.

    "end" is for their plants: it ends the run under way.
    """
    service = STOP if word == "end" else COMMAND
    keys = {car: car_key(service.key, car) for car in cars}
    now_ns = time.monotonic_ns()
    request: Message = (
        StopRequest(0, now_ns, text) if word == "end" else Command(0, now_ns, word, text)
    )
    answers = ask_all(session, keys.values(), request, timeout_s)
    return {car: _reply(answers[key], timeout_s) for car, key in keys.items()}


def _reply(answers: list[bytes], timeout_s: float) -> Reply | str:
    """What the controllers under one name say together, or why that is unknown."""
    try:
        reply = decisive([decode(Reply, data) for data in answers])
    except InputError as error:
        return str(error)
    return reply or f"no answer within {timeout_s:g} s"


class _News:
    """Heartbeats, comings and goings of one car or all (name ""), as they arrive."""

    def __init__(self, session: Any, name: str) -> None:
        self._arrived: queue.SimpleQueue[tuple[_Place, bytes | bool] | None] = queue.SimpleQueue()
        car = name or "*"
        alive, beat = (key.format(car=car, source="*") for key in (ALIVE, HEARTBEAT.key))
        self._declared = (
            session.liveliness().declare_subscriber(alive, self._on_token, history=True),
            session.declare_subscriber(beat, self._on_heartbeat),
        )

    def end(self) -> None:
        """Makes :meth:`next` return None; may be called from a signal handler."""
        self._arrived.put(None)

    def next(self, timeout_s: float) -> tuple[_Place, bytes | bool] | None:
        """A heartbeat's bytes, or whether a process is there now; queue.Empty if nothing comes."""
        return self._arrived.get(timeout=timeout_s)

    def _on_heartbeat(self, sample: Any) -> None:
        if place := _place(str(sample.key_expr), HEARTBEAT.key):
            self._arrived.put((place, sample.payload.to_bytes()))

    def _on_token(self, sample: Any) -> None:
        if place := _place(str(sample.key_expr), ALIVE):
            self._arrived.put((place, sample.kind == zenoh.SampleKind.PUT))


def follow(
    session: Any, picture: Picture, name: str, show: Callable[[str | None], None], period_s: float
) -> None:
    """Keeps the picture up to date from heartbeats and tokens, until SIGINT or SIGTERM.

    Calls ``show`` with the car's name after each heartbeat, and with None each ``period_s``. For
    the main thread.
    """
    news, decoder = _News(session, name), Decoder(Status)
    due_s = 0.0
    with catching_signals(lambda _number: news.end()):
        while True:
            if (now_s := time.monotonic()) >= due_s:
                picture.silence(now_s)
                show(None)
                # From the end of the showing: however long that takes, there is time to listen.
                due_s = time.monotonic() + period_s
            try:
                item = news.next(max(due_s - time.monotonic(), 0.001))
            except queue.Empty:
                continue
            if item is None:
                return
            place, what = item
            if isinstance(what, bool):
                _note_token(picture, place, what)
                continue
            status = decoder(what)
            picture.put(*place, Process(status, "" if status else decoder.last_reason, 1))
            show(place.car)


def _note_token(picture: Picture, place: _Place, there: bool) -> None:
    known = picture.cars.get(place.car, {}).get(place.source)
    if not there:
        picture.put(*place, None)
    elif known is None:
        picture.put(*place, Process(None, "no heartbeat yet"))


def route(endpoints: Endpoints) -> None:
    """Forward between all that connect to this process, until SIGINT or SIGTERM."""
    told: queue.SimpleQueue[None] = queue.SimpleQueue()
    with catching_signals(lambda _number: told.put(None)), open_session(endpoints):
        _log.info("router on %s", ", ".join(endpoints.listen))
        told.get()
