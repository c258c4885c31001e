"""Processes that run beside what is measured: a bare loop, bare messages, and busy processes.

The bare loop does nothing but sleep to absolute deadlines, at the same rate and with the same
scheduling. Its errors come from the machine, not from the program. As for the controller, a release
is missed when nothing could be done before the next one: here, when the loop wakes after that.

For bare messages, one process sends as many bytes as a state has, another answers at once, and
neither does anything else: state → actuation less this is what plant and controller add. They are
sent half a period after the bare loop's releases, so that the two do not wake each other.
"""

import json
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import zenoh
from numpy.typing import NDArray

from bayesrace.clock import sleep_until_ns
from bayesrace.operation.system import Child, child
from bayesrace.processes import die_with_parent
from bayesrace.realtime import RealtimeSettings, prepare_thread
from bayesrace.studies.latency.analysis import BareLoop, Series
from bayesrace.transport import Endpoints, open_session, private_endpoints

__all__ = ["bare_loop", "bare_result", "read_bare_loop", "read_round_trips", "running_beside"]

_LOOP: Final = "bare_loop"
_MESSAGES: Final = "round_trip"
"""What the processes do, and names of their files: ``.npy`` with numbers, ``.log`` with output."""
_BEGIN: Final = "begin.npy"
"""When the periods begin [ns], 0 until that is known; then 1 for each of these that is ready."""
_READY: Final = {_LOOP: 1, _MESSAGES: 2}

_BYTES: Final = bytes(120)
_LOOK_S: Final = 0.01
_READY_S: Final = 30.0
"""A busy machine takes long to start them; what is not ready by then is left out."""


@contextmanager
def running_beside(
    out: Path, numbers: Path, load: int, realtime: RealtimeSettings, rate_hz: float, count: int
) -> Iterator[Callable[[int], None]]:
    """Starts a bare loop and bare messages, ``count`` periods of both, and ``load`` busy processes,
    and waits until they are ready; they end with the block.

    The block gets a function, to be called with the time [ns] at which the periods begin. At its
    end what was measured is in the folder ``numbers``; ``out`` is for the output of the processes.
    """
    np.save(numbers / f"{_MESSAGES}.npy", np.zeros(count, dtype=np.int64))
    np.save(numbers / _BEGIN, np.zeros(3, dtype=np.int64))
    begin = np.lib.format.open_memmap(str(numbers / _BEGIN), mode="r+")
    with ExitStack() as stack:
        (endpoint,) = stack.enter_context(private_endpoints("answers"))

        def start(work: str, **task: Any) -> Child:
            task |= {"work": work, "realtime": realtime.model_dump()}
            line = ["--parent-pid", str(os.getpid()), json.dumps(task)]
            module = "bayesrace.studies.latency.beside"
            return stack.enter_context(child(line, out / f"{work}.log", module))

        measured = {"numbers": str(numbers), "period_ns": round(1e9 / rate_hz)}
        timed = {_LOOP: start(_LOOP, count=count, **measured)}
        answer = start("answer", endpoint=endpoint)
        timed[_MESSAGES] = start(_MESSAGES, endpoint=endpoint, **measured)
        for _ in range(load):
            start("load")
        deadline = time.monotonic() + _READY_S
        while not begin[1:].all() and time.monotonic() < deadline:
            if any(one.ended() for one in (*timed.values(), answer)):
                break
            time.sleep(_LOOK_S)
        for work, one in timed.items():
            if not begin[_READY[work]]:
                one.stop()

        def begin_at(time_ns: int) -> None:
            begin[0] = time_ns

        yield begin_at
        timed[_LOOP].wait(1.0)


def _begin_ns(work: str, numbers: str) -> int:
    """When the periods begin, for which a process that is ready waits."""
    begin = np.lib.format.open_memmap(f"{numbers}/{_BEGIN}", mode="r+")
    begin[_READY[work]] = 1
    while not begin[0]:
        time.sleep(_LOOK_S)
    return int(begin[0])


def read_bare_loop(out: Path, numbers: Path, rate_hz: float) -> tuple[Series, BareLoop] | None:
    """Wake-up errors by time, and the numbers of the report; None if the loop never woke."""
    try:
        late_ns = np.load(numbers / f"{_LOOP}.npy")
    except (OSError, ValueError):  # it was lost before it has written, or while it did
        return None
    if not len(late_ns):
        return None
    refused = (out / f"{_LOOP}.log").read_text(errors="replace").splitlines()
    return bare_result(late_ns, round(1e9 / rate_hz), refused)


def read_round_trips(numbers: Path, rate_hz: float) -> Series | None:
    """Round trips by time; None if no message came back."""
    taken_ns = np.load(numbers / f"{_MESSAGES}.npy")
    (back,) = np.nonzero(taken_ns)
    return Series(back / rate_hz, taken_ns[back].astype(np.float64)) if len(back) else None


def bare_result(
    late_ns: NDArray[np.int64], period_ns: int, refused: list[str]
) -> tuple[Series, BareLoop]:
    """The same from how late the loop woke at each release that was not passed over."""
    passed, count = late_ns // period_ns, len(late_ns)
    released_s = (np.arange(count) + np.cumsum(passed) - passed) * (period_ns * 1e-9)
    woken_s = released_s + late_ns * 1e-9
    series = Series(released_s.astype(np.float64), late_ns.astype(np.float64))
    skipped = int(passed.sum())
    return series, BareLoop(
        **series.distribution().model_dump(),
        misses=int((passed > 0).sum()),
        skipped=skipped,
        ticks=count + skipped,
        mean_period_us=float(np.ptp(woken_s)) * 1e6 / (count - 1) if count > 1 else None,
        refused=refused,
    )


def bare_loop(
    count: int,
    period_ns: int,
    begin_ns: int,
    ended: Callable[[], bool] = lambda: False,
    clock: Callable[[], int] = time.monotonic_ns,
    sleep: Callable[[int], None] = sleep_until_ns,
) -> NDArray[np.int64]:
    """Sleeps from release to release, ``count`` of them from ``begin_ns`` on or until it has
    ``ended``; how late it woke at each that was not passed over [ns]."""
    late_ns = np.full(count, -1, dtype=np.int64)  # filled: no page is touched first in the loop
    release_ns, end_ns, woken = begin_ns, begin_ns + count * period_ns, 0
    while release_ns < end_ns and not ended():
        sleep(release_ns)
        late = clock() - release_ns
        if late >= 0:  # otherwise a signal has ended the sleep
            late_ns[woken] = late
            woken += 1
            release_ns += (late // period_ns + 1) * period_ns
    return late_ns[:woken]


def _loop(numbers: str, period_ns: int, count: int) -> None:
    """The bare loop as a process; SIGTERM ends it early, and it keeps what it has measured."""
    begin_ns, signals = _begin_ns(_LOOP, numbers), list[int]()
    signal.signal(signal.SIGTERM, lambda number, _frame: signals.append(number))
    late_ns = bare_loop(count, period_ns, begin_ns, lambda: bool(signals))
    np.save(f"{numbers}/{_LOOP}.npy", late_ns)


def _answer(endpoint: str) -> None:
    """Sends back what comes, until it is ended; subscribes when the sender can hear the answers."""
    with open_session(Endpoints(listen=(endpoint,))) as session:
        back = session.declare_publisher("back", express=True)
        _wait_for_listener(back)
        there = session.declare_subscriber("there", zenoh.handlers.FifoChannel(100))
        while True:
            back.put(there.recv().payload)


def _send(endpoint: str, numbers: str, period_ns: int) -> None:
    """One message each period; the file has what came back, however this process ends."""
    taken_ns = np.lib.format.open_memmap(f"{numbers}/{_MESSAGES}.npy", mode="r+")
    with open_session(Endpoints(connect=(endpoint,)), peers_follow=True) as session:
        back = session.declare_subscriber("back", zenoh.handlers.FifoChannel(100))
        there = session.declare_publisher("there", express=True)
        _wait_for_listener(there)
        begin_ns = _begin_ns(_MESSAGES, numbers) + period_ns // 2
        for k in range(len(taken_ns)):
            sleep_until_ns(begin_ns + k * period_ns)
            sent_ns = time.monotonic_ns()
            there.put(_BYTES)
            back.recv()
            taken_ns[k] = time.monotonic_ns() - sent_ns


def _wait_for_listener(publisher: Any) -> None:
    while not publisher.matching_status.matching:
        time.sleep(_LOOK_S)


def _run(work: str, realtime: Any, **task: Any) -> None:
    while work == "load":
        pass
    # What is refused the bare loop says for all.
    refused = prepare_thread(RealtimeSettings(**realtime))
    sys.stdout.writelines(f"{one}\n" for one in refused if work == _LOOP)
    works: dict[str, Callable[..., None]] = {_LOOP: _loop, "answer": _answer, _MESSAGES: _send}
    works[work](**task)


if __name__ == "__main__":
    die_with_parent(int(sys.argv[2]))
    _run(**json.loads(sys.argv[3]))
