"""A program that forges messages of a driving car as fast as asked for, and holds connections open.

    python -m tests.security.forger ENDPOINT FOLDER RATE CONNECTIONS CAR EPOCH RUN

It knows the car's epoch and run, and has a certificate that should not allow any of it. It prints
"forging" when it begins, and on the end of stdin how many messages it has handed over.
"""

import itertools
import select
import socket
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import zenoh
from msgspec.structs import replace

from bayesrace.messages import (
    ACTUATION,
    COMMAND,
    EVENT,
    HEARTBEAT,
    STATE,
    STOP,
    Actuation,
    Command,
    Event,
    State,
    Status,
    StopRequest,
    car_key,
    encode,
)
from tests.driven import blank
from tests.security.intruder import bare_session

__all__ = ["forgeries"]

_BATCH_S: Final = 0.002
_ASK_S: Final = 0.2
_HOLD_S: Final = 1.0
"""A connection that does not greet is closed after the handshake's time; then there is another."""


def forgeries(car: str, epoch: int, run: int) -> Iterator[tuple[str, bytes]]:
    """Key and payload of messages that would be obeyed: each is right but for its sender."""
    state = blank(State, run=run, epoch=epoch, x=(1.0, 1.0, 0.0, 3.0, 0.0, 0.0, 0.0))
    actuation = blank(Actuation, run=run, epoch=epoch, u=(1.0, 5.0))
    end = blank(Event, run=run, source="plant", kind="run_ended", data={"reason": "laps"})
    status = blank(Status, source="plant", phase="idle", epoch=epoch, run=run, counters={}, seen={})
    keys = [
        car_key(STATE.key, car), car_key(ACTUATION.key, car), car_key(EVENT.key, car, "plant"),
        car_key(HEARTBEAT.key, car, "plant"),
    ]  # fmt: skip
    for seq in itertools.count():
        changes: list[Any] = [
            replace(state, seq=seq, time_s=0.02 * seq),
            replace(actuation, seq=seq, state_seq=seq, decided_at_s=0.02 * seq),
            replace(end, seq=seq), replace(status, seq=seq),
        ]  # fmt: skip
        yield from ((key, encode(one)) for key, one in zip(keys, changes, strict=True))


def _ask(session: Any, car: str) -> None:
    """Asks car and controller to stop; nobody waits for the answer."""
    for service, request in ((STOP, blank(StopRequest)), (COMMAND, blank(Command, command="stop"))):
        session.get(
            car_key(service.key, car), payload=encode(request), timeout=_ASK_S,
            source_info=zenoh.SourceInfo(session.id, 0),
        )  # fmt: skip


def _hold(endpoint: str, count: int, held: list[socket.socket]) -> None:
    host, port = endpoint.partition("/")[2].rsplit(":", 1)
    for one in held:
        one.close()
    held[:] = [socket.create_connection((host, int(port))) for _ in range(count)]


def main(
    endpoint: str, folder: str, rate: str, connections: str, car: str, epoch: str, run: str
) -> None:
    """Forges until the end of stdin."""
    sent, held, asked = 0, list[socket.socket](), 0.0
    drop = zenoh.CongestionControl.DROP
    with bare_session(endpoint, Path(folder), mode="client") as session:
        print("forging", flush=True)  # noqa: T201
        messages, begin = forgeries(car, int(epoch), int(run)), time.monotonic()
        while not select.select([sys.stdin], [], [], _BATCH_S)[0]:
            now = time.monotonic()
            for key, payload in itertools.islice(messages, int((now - begin) * int(rate)) - sent):
                session.put(key, payload, congestion_control=drop)
                sent += 1
            if now - asked > _HOLD_S:
                asked = now
                _ask(session, car)
                if int(connections):
                    _hold(endpoint, int(connections), held)
        print(sent, f"{sent / (time.monotonic() - begin):.0f} a second", flush=True)  # noqa: T201


if __name__ == "__main__":
    main(*sys.argv[1:])
