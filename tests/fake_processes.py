"""Plants and controllers as far as operation sees them, in threads of the tests' own process."""

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import pytest

from bayesrace.messages import COMMAND, HEARTBEAT, STATUS, Command, Reply, Role, Status
from bayesrace.operation.lifecycle import NetworkStatus, ask_statuses, find
from bayesrace.transport import (
    Endpoints,
    Inbox,
    Item,
    Kind,
    Publisher,
    decode_request,
    free_endpoint,
    open_session,
)
from tests import sample_messages as messages

__all__ = ["COUNTERS", "PATIENCE_S", "Fake", "Fakes", "fakes", "options", "status_of", "where"]

PATIENCE_S = 5.0
COUNTERS = {"deadline_misses": 3, "shifted_plan": 4, "brake": 5, "stop": 6, "refused": 7,
            "states_lost": 8, "states_stale": 9}  # fmt: skip


@dataclass
class Fake:
    """A plant or a controller as far as operation sees it; in a thread of this process."""

    car: str
    source: str
    endpoints: Endpoints
    mute: bool = False
    """It is present and does not answer."""
    refuses: str = ""
    beats: bool = True
    text: str = "all is well"
    track: str = ""
    heard: list[Command] = field(default_factory=list)
    clock_s: float = 0.0
    """How far the clock of its machine is ahead."""
    presence: Callable[[], dict[str, Any]] = dict

    def status(self, seq: int) -> Status:
        rate, age = (50.0, 0.012) if self.source == "controller" else (0.0, -1.0)
        phase = "driving" if self.source == "controller" else "idle"
        here = self.presence() | {"calendar_s": time.time() + self.clock_s}
        return messages.status(
            seq=seq, **here, source=self.source, phase=phase, epoch=7, run=2, text=self.text,
            weights_version="v3", rate_hz=rate, state_age_s=age, delay_s=0.034, counters=COUNTERS,
            track=self.track,
        )  # fmt: skip

    def serve(self, ready: threading.Event, over: threading.Event) -> None:
        role: Role = "plant" if self.source == "plant" else "controller"
        with open_session(self.endpoints, role) as session:
            inbox = Inbox(session, self.car)
            other = "controller" if self.source == "plant" else "plant"
            inbox.watch(other)
            self.presence = partial(inbox.presence, self.endpoints, other)
            inbox.serve(STATUS, self.source)
            if self.source == "controller":
                inbox.serve(COMMAND)
            beats = Publisher(session, HEARTBEAT, self.car, self.source)
            inbox.announce(self.source)
            ready.set()
            while not over.is_set():
                item = inbox.get(0.05)
                if item is not None and item.kind is Kind.REQUEST and not self.mute:
                    self._answer(item)
                if self.beats:
                    beats.put(self.status(beats.next_seq), lockstep=False)

    def _answer(self, item: Item) -> None:
        if item.value.service is STATUS:
            item.value.answer(self.status(0))
            return
        self.heard.append(decode_request(item.value)[0])
        text = self.refuses or f"{self.heard[-1].command}: as you say"
        item.value.answer(
            Reply(seq=0, source_time_ns=0, accepted=not self.refuses, text=text, data={})
        )


Fakes = Callable[..., Fake]


@pytest.fixture
def fakes() -> Iterator[Fakes]:
    """Starts fakes, each listening on an endpoint of its own by default."""
    over = threading.Event()
    threads = []

    def begin(car: str, source: str, **settings: Any) -> Fake:
        settings.setdefault("endpoints", Endpoints(listen=(free_endpoint(),)))
        fake, ready = Fake(car, source, **settings), threading.Event()
        thread = threading.Thread(target=fake.serve, args=(ready, over))
        thread.start()
        threads.append(thread)
        assert ready.wait(PATIENCE_S)
        return fake

    yield begin
    over.set()
    for thread in threads:
        thread.join()


def where(*fakes: Fake) -> Endpoints:
    """What to connect to."""
    return Endpoints(connect=tuple(fake.endpoints.listen[0] for fake in fakes))


def options(*fakes: Fake) -> list[str]:
    """The same for the command line."""
    return [word for endpoint in where(*fakes).connect for word in ("--endpoint", endpoint)]


def status_of(
    endpoints: Endpoints, name: str = "", patience_s: float = PATIENCE_S
) -> NetworkStatus:
    """What the processes there say of themselves."""
    with open_session(endpoints) as session:
        found = find(session, endpoints, patience_s, name)
        return ask_statuses(session, found, 1.0)
