"""What messages alone cost: two processes that pass bytes to and fro beside the run, at its rate.

One sends as many bytes as a state has, the other answers at once, and neither does anything else.
So state → actuation less this is what plant and controller add. Half a period after the bare loop's
releases, so that the two do not wake each other.
"""

import json
import os
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import zenoh

from bayesrace.clock import die_with_parent, sleep_until_ns
from bayesrace.realtime import RealtimeSettings, prepare_thread
from bayesrace.transport import Endpoints, open_session, private_endpoints
from operation.processes import child
from studies.latency.series import Series

__all__ = ["passing_messages", "read_round_trips"]

_FILE: Final = "round_trip.npy"
_BYTES: Final = bytes(120)
_LOOK_S: Final = 0.01


@contextmanager
def passing_messages(
    out: Path, realtime: RealtimeSettings, rate_hz: float, begin_ns: int, count: int
) -> Iterator[None]:
    """Both processes, for ``count`` periods from ``begin_ns`` on; at the block's end the round
    trips are in the folder ``out``."""
    module, period_ns = "studies.latency.round_trip", round(1e9 / rate_hz)
    np.save(out / _FILE, np.zeros(count, dtype=np.int64))
    with ExitStack() as stack:
        (endpoint,) = stack.enter_context(private_endpoints("answers"))
        meet = {"endpoint": endpoint, "realtime": realtime.model_dump()}
        sender = {"path": str(out / _FILE), "period_ns": period_ns}
        sender |= {"begin_ns": begin_ns + period_ns // 2}
        for name, part in (("answer", meet), ("round_trip", meet | sender)):
            line = ["--parent-pid", str(os.getpid()), json.dumps(part)]
            stack.enter_context(child(line, out / f"{name}.log", module))
        yield


def read_round_trips(out: Path, rate_hz: float) -> Series | None:
    """Round trips by time; None if no message came back."""
    try:
        taken_ns = np.load(out / _FILE)
        (out / _FILE).unlink()
    except (OSError, ValueError):
        return None
    (back,) = np.nonzero(taken_ns)
    return Series(back / rate_hz, taken_ns[back].astype(np.float64)) if len(back) else None


def _receiver(session: Any, key: str) -> Any:
    return session.declare_subscriber(key, zenoh.handlers.FifoChannel(100))


def _sender(session: Any, key: str) -> Any:
    return session.declare_publisher(key, express=True)


def _answer(endpoint: str) -> None:
    """Sends back what comes, until it is ended."""
    with open_session(Endpoints(listen=(endpoint,))) as session:
        there, back = _receiver(session, "there"), _sender(session, "back")
        while True:
            back.put(there.recv().payload)


def _send(endpoint: str, path: str, period_ns: int, begin_ns: int) -> None:
    """One message each period; the file has what came back, however this process ends."""
    taken_ns = np.lib.format.open_memmap(path, mode="r+")
    with open_session(Endpoints(connect=(endpoint,)), peers_follow=True) as session:
        back, there = _receiver(session, "back"), _sender(session, "there")
        while not there.matching_status.matching:
            time.sleep(_LOOK_S)
        first = max(0, -(-(time.monotonic_ns() - begin_ns) // period_ns))
        for k in range(first, len(taken_ns)):
            sleep_until_ns(begin_ns + k * period_ns)
            sent_ns = time.monotonic_ns()
            there.put(_BYTES)
            back.recv()
            taken_ns[k] = time.monotonic_ns() - sent_ns


def _run(endpoint: str, realtime: Any, **sender: Any) -> None:
    prepare_thread(RealtimeSettings(**realtime))  # what is refused the bare loop says
    if sender:
        _send(endpoint, **sender)
    else:
        _answer(endpoint)


if __name__ == "__main__":
    die_with_parent(int(sys.argv[2]))
    _run(**json.loads(sys.argv[3]))
