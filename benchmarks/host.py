"""How soon the controller without Python answers: state → actuation, beside bare messages.

    python -m benchmarks.host [--rates 50 500] [--seconds 20]

A simulated car sends its states at a fixed rate by the monotonic clock, over UDP and over a Unix
socket of this machine, to ``controller/host`` and to a program that sends each datagram back. The
times are from before the system call that sends a state to after the one that receives its answer,
which acts from the next millisecond on. Right before it, the car looks for what has come since: its
own cold caches, after what others computed on its processor, are not the controller's time. The
process in Python, over Zenoh, is measured by ``bayesrace latency`` in the same run.
"""

import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import bayesrace as br
from bayesrace import clock
from bayesrace.codegen.build import PROGRAM
from bayesrace.codegen.compiler import find_compiler
from bayesrace.controller.settings import MpcSettings
from bayesrace.gp.weights import read_weights
from bayesrace.messages import STATE, Actuation, State, from_datagram, to_datagram
from bayesrace.operation.host import HostProgram
from bayesrace.operation.settings import PreparationSettings
from benchmarks.harness import Row, arguments, percentiles, prepared, report, resident_bytes

STEP_S = 0.001
"""Of the simulated car."""

ECHO = """
#include <netinet/in.h>
#include <stdlib.h>
#include <sys/socket.h>
int main(int argc, char **argv) {
    static char data[65536];
    struct sockaddr_in here = {.sin_family = AF_INET, .sin_port = htons(atoi(argv[1]))};
    here.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    const int in = socket(AF_INET, SOCK_DGRAM, 0);
    if (bind(in, (struct sockaddr *)&here, sizeof here)) return 1;
    for (;;) {
        struct sockaddr_in from;
        socklen_t size = sizeof from;
        const ssize_t got = recvfrom(in, data, sizeof data, 0, (struct sockaddr *)&from, &size);
        if (got > 0) sendto(in, data, got, 0, (struct sockaddr *)&from, size);
    }
}
"""


@contextmanager
def started(line: list[str], link: str, folder: Path) -> Iterator[tuple[socket.socket, int]]:
    """A program that answers at a link, as a socket connected to it, and its process."""
    kind, _, where = link.partition(":")
    family = socket.AF_INET if kind == "udp" else socket.AF_UNIX
    own: Any = ("127.0.0.1", 0) if kind == "udp" else str(folder / "plant")
    there: Any = ("127.0.0.1", int(where.rpartition(":")[2])) if kind == "udp" else where
    with (
        subprocess.Popen(line, stderr=subprocess.DEVNULL) as process,
        socket.socket(family, socket.SOCK_DGRAM) as one,
    ):
        time.sleep(0.5)
        one.bind(own)
        one.connect(there)
        yield one, process.pid
        process.terminate()
    (folder / "plant").unlink(missing_ok=True)


def empty(link: socket.socket) -> None:
    """Reads what is there."""
    link.setblocking(False)
    with suppress(BlockingIOError):
        while True:
            link.recv(1 << 16)


def driven(link: socket.socket, simulator: br.Simulator, rate_hz: float, seconds: float) -> Any:
    """Times from states to their answers [us]; an answer that is missing counts as a period."""
    period_s, u, after, applied = 1 / rate_hz, np.zeros(2), np.zeros(2), np.zeros(2)
    delays: tuple[float, ...] = ()
    count, begin_s = round(seconds * rate_hz), time.monotonic() + 0.1
    steps = round(period_s / STEP_S)
    simulator.reset()
    times = np.full(count, 1e6 * period_s)
    for k in range(count):
        state = State(
            seq=k, source_time_ns=clock.monotonic_ns(), epoch=1, run=1, time_s=k * period_s,
            x=tuple(simulator.state), u_applied=tuple(applied), lap=0,
            estimated=False, readings=(), lockstep=False, actuation_delays=delays, final=False,
        )  # fmt: skip
        data, delays, acts = to_datagram(STATE, state), (), steps
        due_s = begin_s + k * period_s
        clock.sleep_until_ns(round(due_s * 1e9))
        empty(link)
        sent_ns = clock.monotonic_ns()
        link.send(data)
        while (left_s := due_s + 0.5 * period_s - time.monotonic()) > 0:
            link.settimeout(left_s)
            try:
                answer = link.recv(1 << 16)
            except TimeoutError:
                break
            came_ns = clock.monotonic_ns()
            bare = answer == data
            found = None if bare else from_datagram(answer)[1]
            if bare or (isinstance(found, Actuation) and found.state_seq == k):
                times[k] = (came_ns - sent_ns) * 1e-3
            if isinstance(found, Actuation) and found.state_seq == k:
                after, acts = np.array(found.u), int(times[k] * 1e-6 / STEP_S) + 1
                acts_s = k * period_s + acts * STEP_S - found.decided_at_s
                delays = (float(k), times[k] * 1e-6, acts_s)
            if times[k] < 1e6 * period_s:
                break
        applied = np.zeros(2)
        for step in range(steps):
            simulator.step(after if step >= acts else u)
            applied += np.array(simulator.u_applied) / steps
        u = after
    return times[round(rate_hz) :]  # the first second warms up


def measured(what: str, line: list[str], link: str, folder: Path, simulator: br.Simulator,
             rate_hz: float, seconds: float) -> Row:  # fmt: skip
    """Latencies, memory and processor time of a program at a link."""
    with started(line, link, folder) as (one, pid):
        times = driven(one, simulator, rate_hz, seconds)
        stat = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        cpu_s = (int(stat[11]) + int(stat[12])) / os.sysconf("SC_CLK_TCK")
        memory = resident_bytes(pid) / 1e6
    return {
        "what": f"{what}, {rate_hz:g} Hz",
        **{f"{name}_us": value for name, value in percentiles(times, 50, 90, 99).items()},
        "unanswered": int(np.sum(times >= 1e6 / rate_hz)), "memory_mb": memory, "cpu_s": cpu_s,
    }  # fmt: skip


def python_process(folder: Path, rate: str, seconds: float) -> list[Row]:
    """The process in Python over Zenoh, beside bare messages over Zenoh."""
    line = [sys.executable, "-m", "bayesrace.operation.cli", "latency", "--rate", rate, "--out"]
    run = folder / f"python-{rate}"
    subprocess.run([*line, str(run), "--duration", f"{seconds:g}"], check=True)
    found = json.loads((run / "latency.json").read_text())
    return [
        {
            "what": f"{what}, {rate} Hz",
            **{f"{name}_us": found[key][name] for name in ("p50", "p90", "p99")},
        }
        for what, key in (("bare messages, Zenoh", "round_trip_us"),
                          ("controller in Python, Zenoh", "state_to_actuation_us"))
    ]  # fmt: skip


def main() -> None:
    """Compiles both programs, drives by each in turn, and reports."""
    given = arguments(__doc__, rates=("50", "500"), seconds=20.0)
    made, car, rows = prepared("harbour"), PreparationSettings().car, list[Row]()
    on, weights = made.tracks[0], read_weights(made.weights)
    with TemporaryDirectory() as name:
        folder = Path(name)
        HostProgram.made(folder, made.artefacts[0], car, on.track, on.line, weights, MpcSettings())
        source = folder / "echo.c"
        source.write_text(ECHO)
        find_compiler().run("-O2", source, "-o", folder / "echo")
        for number, rate in enumerate(given.rates):
            simulator = br.Simulator(car, on.track, step_s=STEP_S)
            udp, unix = f"udp:127.0.0.1:{7460 + number}", f"unix:{folder}/host"
            host = [str(folder / PROGRAM), str(folder)]
            ways = {
                "bare messages": ([str(folder / "echo"), str(7470 + number)],
                                  f"udp:127.0.0.1:{7470 + number}"),
                "controller, UDP": ([*host, udp, "--rate", rate], udp),
                "controller, Unix socket": ([*host, unix, "--rate", rate], unix),
            }  # fmt: skip
            for what, (line, link) in ways.items():
                rows.append(
                    measured(what, line, link, folder, simulator, float(rate), given.seconds)
                )
            rows += python_process(folder, rate, given.seconds)
    report(given, "state -> actuation of the controller without Python", rows)


if __name__ == "__main__":
    main()
