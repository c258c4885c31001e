"""How soon the car is driven again after a stall of its controller, bridge or plant.

    python -m tests.recovery [--count 20] [--pause 0.6] [--rate 50]

A learned car drives laps of harbour in real time: by the controller without Python over UDP, with
a plant in this process; by the same through the network and its bridge; and by the process in
Python. One process is stopped (SIGSTOP) for ``pause`` seconds again and again, in which the car
brakes by its braking plan. The times are from SIGCONT until actuations come, at the plant or at a
recorder, that are solutions for states no older than two periods: five in a row, of which the first
counts.
"""

import math
import os
import queue
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack, nullcontext
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any, Final, cast

import numpy as np
from msgspec.structs import replace

from bayesrace import clock
from bayesrace.codegen.compiler import compiled
from bayesrace.controller.settings import MpcSettings
from bayesrace.gp.weights import read_weights
from bayesrace.log import LogReader
from bayesrace.messages import (
    ACTUATION,
    STATE,
    TELEMETRY,
    Actuation,
    Decoder,
    Message,
    Numbering,
    RunRequest,
    State,
    Telemetry,
    Truth,
    from_datagram,
    to_datagram,
)
from bayesrace.operation.host import HostProgram
from bayesrace.operation.preparation import Prepared
from bayesrace.operation.run_plan import RunPlan, run_request
from bayesrace.operation.system import CONFIGURATION, started_system
from bayesrace.plant.car import End
from bayesrace.plant.run import Run, RunCounters
from bayesrace.plant.vehicle import open_vehicle
from bayesrace.recorder import Recorder
from bayesrace.transport import Item, Kind
from bayesrace.transport.hold import HoldWatch
from bayesrace.vehicles import get_car
from benchmarks.harness import Row, arguments, prepared, report
from tests.network.cars import free_port, started_host
from tests.programs import COMMAND

CAR: Final = "orca"
SETTLED_S: Final = 2.4
"""Before each stall: the car races again."""
IN_A_ROW: Final = 5
WITHIN_S: Final = 0.5


def recoveries(
    messages: Iterable[tuple[int, Message]], resumed_ns: list[int], period_s: float
) -> list[float]:
    """Of each stall, the time after its end [s]; infinite if the car is not driven again before
    the next one. ``messages``: each with the calendar time at which it came."""
    of: dict[type, dict[int, Any]] = {State: {}, Actuation: {}, Telemetry: {}}
    came_ns = dict[int, int]()
    for at_ns, one in messages:
        if type(one) in of:
            of[type(one)][one.seq] = one
        if isinstance(one, Actuation):
            came_ns[one.seq] = at_ns
    states, answers, reports = of.values()
    drives = []
    for seq, answer in sorted(answers.items()):
        state, how = states.get(answer.state_seq), reports.get(seq)
        if state is not None and how is not None:
            age_s = (answer.source_time_ns - state.source_time_ns) * 1e-9
            drives.append((came_ns[seq], how.fallback == 0 and age_s <= 2 * period_s))
    found = []
    for begin_ns, end_ns in zip(resumed_ns, [*resumed_ns[1:], math.inf], strict=True):
        since = [one for one in drives if begin_ns < one[0] < end_ns]
        rows = (since[k : k + IN_A_ROW] for k in range(len(since) - IN_A_ROW + 1))
        first = next((row[0][0] for row in rows if all(good for _, good in row)), math.inf)
        found.append((first - begin_ns) * 1e-9)
    return found


def stalled(stall: Callable[[float], object], count: int, pause_s: float) -> list[int]:
    """Stalls a driving process so often; when it went on."""
    resumed_ns = []
    for _ in range(count):
        time.sleep(SETTLED_S)
        stall(pause_s)
        resumed_ns.append(time.time_ns())
    time.sleep(SETTLED_S)
    return resumed_ns


def stops(pid: int) -> Callable[[float], None]:
    """SIGSTOP, and SIGCONT after so long."""

    def stop(pause_s: float) -> None:
        os.kill(pid, signal.SIGSTOP)
        time.sleep(pause_s)
        os.kill(pid, signal.SIGCONT)

    return stop


class Plant:
    """A plant in this process, whose messages are datagrams; for its run, inbox and publishers."""

    next_seq, stamped = 0, staticmethod(nullcontext)

    def __init__(self, link: socket.socket) -> None:
        self.messages: list[tuple[int, Message]] = []
        self.over = threading.Event()
        self._resumed_s = 0.0
        self._link, self._items = link, queue.SimpleQueue[Item]()
        threading.Thread(target=self._receive, daemon=True).start()

    def _receive(self) -> None:
        while data := self._link.recv(1 << 16):
            topic, message = from_datagram(data)
            self.messages.append((time.time_ns(), message))
            if topic is not TELEMETRY:
                self._items.put(Item(Kind.MESSAGE, topic.name, message, clock.monotonic_ns()))

    def stall(self, pause_s: float) -> None:
        """It does not run for so long."""
        self._resumed_s = time.monotonic() + pause_s
        time.sleep(pause_s)

    def put(self, message: State | Truth, *, lockstep: bool) -> None:
        time.sleep(max(self._resumed_s - time.monotonic(), 0))
        self.messages.append((time.time_ns(), message))
        if isinstance(message, State) and not lockstep:
            self._link.send(to_datagram(STATE, message))

    @property
    def queued(self) -> int:
        return self._items.qsize()

    def get(self, _: float = 0) -> Item:
        return self._items.get()

    def drive(self, request: RunRequest, rate_hz: float) -> None:
        """A run, until it is over."""
        end, given = End("stopped", ""), cast(Any, self)
        with open_vehicle(get_car(CAR), None, None, rate_hz, compiled) as vehicle:
            Run(
                request=request, simulator=vehicle, inbox=given, states=given, truths=given,
                decoder=Decoder(Actuation), counters=RunCounters(), numbering=Numbering(),
                react=lambda _: None, beat=lambda: end if self.over.is_set() else None,
                pause=lambda _: None, suspended=lambda _: None, epoch=1,
                hold=cast(HoldWatch, SimpleNamespace(missing=False)),
            ).execute()  # fmt: skip


def endless(made: Prepared) -> RunRequest:
    plan = RunPlan(1, "", 1, 1e5, lockstep=False)
    return replace(run_request(made.first.track, plan), laps=0)


def by_datagrams(
    made: Prepared, host: HostProgram, what: str, count: int, pause_s: float, rate_hz: float
) -> list[float]:
    """Of stalls of the "program" or the "plant", over UDP."""
    port = free_port()
    with (
        started_host(host, f"udp:127.0.0.1:{port}", "--rate", str(rate_hz)) as program,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link,
    ):
        link.connect(("127.0.0.1", port))
        plant = Plant(link)
        driving = threading.Thread(target=plant.drive, args=(endless(made), rate_hz))
        driving.start()
        try:
            stall = plant.stall if what == "plant" else stops(program.pid)
            resumed_ns = stalled(stall, count, pause_s)
        finally:
            plant.over.set()
            driving.join()
            link.shutdown(socket.SHUT_RDWR)
        return recoveries(plant.messages, resumed_ns, 1 / rate_hz)


def by_network(
    made: Prepared, host: HostProgram | None, what: str, count: int, pause_s: float, rate_hz: float
) -> list[float]:
    """Of stalls of the "program", its "bridge", the "plant", or without a program of the
    "controller" in Python."""
    rate = "--rate", str(rate_hz)
    with TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        own, pids = {}, dict[str, int]()
        if host is not None:
            link = f"udp:127.0.0.1:{free_port()}"
            pids["program"] = stack.enter_context(started_host(host, link, *rate)).pid
            own["controller"] = [*bridge_command(link, made.first.track_file, folder), *rate]
        system = stack.enter_context(started_system(CAR, folder, rate, own=own))
        stack.enter_context(system.controller([*made.arguments, *rate]))
        pids |= {part: one.pid for part, one in system.children.items()}
        pids["bridge"] = pids["controller"]
        with Recorder(system.session, CAR, folder / "run.mcap"):
            system.director.start(endless(made))
            resumed_ns = stalled(stops(pids[what]), count, pause_s)
            system.director.stop("measured")
        read = LogReader(folder / "run.mcap").messages((STATE, ACTUATION, TELEMETRY))
        return recoveries(((one.wall_ns, one.message) for one in read), resumed_ns, 1 / rate_hz)


def bridge_command(link: str, track: Path, folder: Path) -> list[str]:
    """The bridge as the controller of a system that was started in that folder."""
    words = "bridge", link, "--track", track, "--config", folder / CONFIGURATION
    return [*COMMAND, *map(str, words)]


def main() -> None:
    given = arguments(__doc__, count=20, pause=0.6, rate=50.0)
    made, how = prepared("harbour"), (given.count, given.pause, given.rate)
    with TemporaryDirectory() as folder:
        host = hosted(made, Path(folder))
        ways = {
            "the program, UDP": partial(by_datagrams, made, host, "program"),
            "the plant, UDP": partial(by_datagrams, made, host, "plant"),
            "the program behind its bridge": partial(by_network, made, host, "program"),
            "its bridge": partial(by_network, made, host, "bridge"),
            "the plant, bridge": partial(by_network, made, host, "plant"),
            "the controller in Python": partial(by_network, made, None, "controller"),
        }
        rows: list[Row] = []
        for name, way in ways.items():
            times = way(*how)
            within = sum(one <= WITHIN_S for one in times)
            rows.append({
                "stalled": name, "within 0.5 s": f"{within} of {len(times)}",
                "median s": float(np.median(times)), "longest s": max(times),
            })  # fmt: skip
    report(given, f"driven again after {given.pause:g} s, {given.rate:g} Hz", rows)


def hosted(made: Prepared, folder: Path) -> HostProgram:
    on = made.first
    car, weights = get_car(CAR), read_weights(made.weights)
    return HostProgram.made(
        folder, made.artefacts[0], car, on.track, on.line, weights, MpcSettings()
    )


if __name__ == "__main__":
    main()
