"""A viewer that asks for the status of a process at a rate, and waits for no answer.

    python -m tests.security.flood ENDPOINT FOLDER SOURCE RATE

It prints "asking" when it begins, and on the end of stdin how many times a second it has asked.
"""

import select
import sys
import time
from pathlib import Path
from typing import Final

import zenoh

from bayesrace.messages import STATUS, StatusRequest, car_key, encode
from tests.driven import blank
from tests.security.authority import CAR
from tests.security.intruder import bare_session

__all__: list[str] = []

_BATCH_S: Final = 0.002
_TIMEOUT_S: Final = 5.0


def main(endpoint: str, folder: str, source: str, rate: str) -> None:
    """Asks until the end of stdin."""
    key, request, sent = car_key(STATUS.key, CAR, source), encode(blank(StatusRequest)), 0
    with bare_session(endpoint, Path(folder)) as session:
        print("asking", flush=True)  # noqa: T201
        begin, named = time.monotonic(), {"source_info": zenoh.SourceInfo(session.id, 0)}
        while not select.select([sys.stdin], [], [], _BATCH_S)[0]:
            for _ in range(int((time.monotonic() - begin) * int(rate)) - sent):
                session.get(key, lambda _: None, payload=request, timeout=_TIMEOUT_S, **named)
                sent += 1
        print(sent / (time.monotonic() - begin), flush=True)  # noqa: T201


if __name__ == "__main__":
    main(*sys.argv[1:])
