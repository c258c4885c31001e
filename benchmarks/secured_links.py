"""What certificates and access control cost a driving car, and what a flood of forgeries does.

    python -m benchmarks.secured_links
    python -m benchmarks.secured_links --rounds 5 --seconds 20 --rate 500
    python -m benchmarks.secured_links --blocks 0 --rounds 3 --ahead

First bare messages: a state's size there and an actuation's back, one each 2 ms, between two
processes that have a plain link and a secured one and use them by turns. Then plant and controller
drive in real time, by turns over plain links, over secured ones, and over secured ones while a
viewer's certificate forges 10,000 messages a second and holds 500 connections open. Prints the legs
that cross the network and the whole way from state to actuation, with the ratio of each to the
plain links of the same round, and what plant and controller take of a CPU.

``--ahead`` lets plant and controller go before all other work of the machine (SCHED_RR), the
forger's included, which then is not what is measured: it would come from elsewhere.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from zenoh.handlers import FifoChannel

from bayesrace.clock import sleep_until_ns
from bayesrace.configuration import (
    Configuration,
    NetworkSettings,
    TlsSettings,
    as_toml,
    read_configuration,
)
from bayesrace.files import write_whole
from bayesrace.messages import ACTUATION, STATE, Role
from bayesrace.recorder import Recorder
from bayesrace.tracks import DEFAULT_RACE_TRACK
from bayesrace.transport import free_endpoint, open_session
from bayesrace.vehicles import get_car
from operation.certificates import add, init
from operation.drive import RunPlan, run_request
from operation.preparation import Prepared, prepare
from operation.settings import PreparationSettings
from operation.system import System, started_system
from operation.terminal.progress import stages_on
from studies.latency.analysis import Beside, analyse
from studies.latency.results import LatencyResult
from studies.latency.settings import LatencySettings
from tests.programs import ROOT

CAR = "orca"
WARM_UP_S = 3.0
LEGS = ("state_transport", "actuation_transport", "state_to_actuation")
FLOOD, CONNECTIONS = 10_000, 500
STATE_BYTES, ANSWER_BYTES = 250, 120
BLOCK, PERIOD_NS = 100, 2_000_000


def certified(folder: Path) -> Configuration:
    """A network on loopback with a certificate for each process."""
    init(folder)
    roles: tuple[Role, ...] = ("plant", "controller", "director", "viewer")
    for role in roles:
        add(folder, role, role)
    plant, controller = free_endpoint("tls"), free_endpoint("tls")
    network = NetworkSettings(plant=(plant,), controller=(controller,))
    return Configuration(network=network, tls=TlsSettings(folder=folder))


@contextmanager
def flooded(configuration: Configuration, system: System) -> Iterator[None]:
    """For the block, forged messages; prints how many."""
    status, folder = system.director.status("plant"), configuration.tls.folder
    forger = subprocess.Popen(
        [
            sys.executable, "-m", "tests.security.forger", configuration.network.plant[0],
            f"{folder}/viewer", str(FLOOD), str(CONNECTIONS), CAR, str(status.epoch),
            str(status.run),
        ],
        cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        yield
    finally:
        print("forged:", forger.communicate("")[0].replace("forging\n", "").strip())


def put_ahead(pid: int) -> None:
    """Lets all threads of a process go before ordinary ones."""
    for task in Path(f"/proc/{pid}/task").iterdir():
        os.sched_setscheduler(int(task.name), os.SCHED_RR, os.sched_param(10))


def cpu_s(pid: int) -> float:
    """CPU time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Drive(NamedTuple):
    """What came of a run."""

    result: LatencyResult
    cpu: dict[str, float]
    """Share of a CPU that each process took."""


def driven(
    prepared: Prepared, folder: Path, way: str, rate: float, seconds: float, ahead: bool
) -> Drive:
    """One run in real time, and what its log says."""
    folder.mkdir()
    configuration = None if way == "plain" else certified(folder / "certs")
    track, log = prepared.first.track, folder / "run.mcap"
    both = ["--rate", str(rate)]
    with ExitStack() as stack:
        system = stack.enter_context(
            started_system(CAR, folder, both=both, configuration=configuration)
        )
        stack.enter_context(system.controller(prepared.arguments))
        pids = {name: child.pid for name, child in system.children.items()}
        for pid in pids.values() if ahead else ():
            put_ahead(pid)
        plan = RunPlan(1, "bayesrace", 0, 600.0, lockstep=False)
        recorder = stack.enter_context(Recorder(system.session, CAR, log))
        system.director.start(run_request(track, plan))
        if configuration is not None and way == "flooded":
            stack.enter_context(flooded(configuration, system))
        time.sleep(WARM_UP_S)
        before = {name: cpu_s(pid) for name, pid in pids.items()}
        time.sleep(seconds)
        cpu = {name: (cpu_s(pid) - before[name]) / seconds for name, pid in pids.items()}
        system.director.stop("measured")
        recorder.close()
    settings = LatencySettings(
        car=get_car(CAR), rate_hz=rate, duration_s=seconds, warm_up_s=WARM_UP_S,
        track=DEFAULT_RACE_TRACK,
    )  # fmt: skip
    return Drive(analyse(log, settings, track, Beside()).result, cpu)


def echo(names: list[str]) -> None:
    """The controller's part in the round trips: answers each state on the link it came by."""
    with ExitStack() as stack:
        threads = []
        for name in names:
            ends = read_configuration(Path(name)).endpoints("controller", listen=())
            session = stack.enter_context(open_session(ends, "controller"))
            states = session.declare_subscriber(STATE.key.format(car=CAR), FifoChannel(100))
            answers = session.declare_publisher(ACTUATION.key.format(car=CAR), express=True)

            def answer(states: Any = states, answers: Any = answers) -> None:
                while payload := states.recv().payload.to_bytes():
                    answers.put(payload[:ANSWER_BYTES])

            threads.append(threading.Thread(target=answer))
            threads[-1].start()
        for thread in threads:
            thread.join()


def round_trips(folder: Path, blocks: int) -> dict[str, np.ndarray]:
    """Round trips [us] in blocks by turns, as (blocks, messages), by kind of link."""
    plain = Configuration().plain(free_endpoint(), free_endpoint())
    networks = {"plain": plain, "secured": certified(folder / "certs")}
    files = {}
    for way, network in networks.items():
        files[way] = folder / f"{way}.toml"
        write_whole(files[way], as_toml(network))
    times: dict[str, list[list[float]]] = {way: [] for way in networks}
    with ExitStack() as stack:
        ends = {}
        for way, network in networks.items():
            session = stack.enter_context(open_session(network.endpoints("plant"), "plant"))
            answers = session.declare_subscriber(ACTUATION.key.format(car=CAR), FifoChannel(100))
            ends[way] = session.declare_publisher(STATE.key.format(car=CAR), express=True), answers
        line = [
            sys.executable,
            "-m",
            "benchmarks.secured_links",
            "--echo",
            *map(str, files.values()),
        ]
        other = stack.enter_context(subprocess.Popen(line))
        while not all(states.matching_status.matching for states, _ in ends.values()):
            time.sleep(0.01)
        time.sleep(0.5)
        for number in range(2 * blocks):
            way = tuple(networks)[number % 2]
            times[way].append(_block(*ends[way]))
        for states, _ in ends.values():
            states.put(b"")
        other.wait(10)
    return {way: np.array(blocks) for way, blocks in times.items()}


def _block(states: Any, answers: Any) -> list[float]:
    times, due_ns = [], time.monotonic_ns()
    for _ in range(BLOCK):
        due_ns = max(due_ns + PERIOD_NS, time.monotonic_ns())
        sleep_until_ns(due_ns)
        begin_ns = time.perf_counter_ns()
        states.put(bytes(STATE_BYTES))
        answers.recv()
        times.append((time.perf_counter_ns() - begin_ns) * 1e-3)
    return times


def print_round_trips(found: dict[str, np.ndarray]) -> None:
    """Percentiles, and the median over the blocks of their ratio."""
    for share in (10, 50, 90, 99):
        plain, secured = (np.percentile(found[way], share, axis=1) for way in ("plain", "secured"))
        print(
            f"round trip p{share}: plain {np.median(plain):.0f} us, secured "
            f"{np.median(secured):.0f} us, ratio {np.median(secured / plain):.2f}"
        )


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--echo", nargs="*", help=argparse.SUPPRESS)
    parser.add_argument("--blocks", type=int, default=50, help="of round trips, on each link")
    parser.add_argument("--rounds", type=int, default=5, help="of driving")
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--rate", type=float, default=50.0)
    parser.add_argument("--ahead", action="store_true", help="plant and controller at SCHED_RR")
    options = parser.parse_args()
    if options.echo:
        echo(options.echo)
        return
    if options.blocks:
        with tempfile.TemporaryDirectory() as name:
            print_round_trips(round_trips(Path(name), options.blocks))
    if options.rounds:
        drives(options.rounds, options.seconds, options.rate, options.ahead)


def drives(rounds: int, seconds: float, rate: float, ahead: bool) -> None:
    """Drives by turns, and prints what came of it."""
    with stages_on(Console(stderr=True)) as stages:
        prepared = prepare(PreparationSettings(), (DEFAULT_RACE_TRACK,), stages)
    ways = ("plain", "secured", "flooded")
    found: dict[str, list[LatencyResult]] = {way: [] for way in ways}
    cpu: dict[str, list[dict[str, float]]] = {way: [] for way in ways}
    with tempfile.TemporaryDirectory() as name:
        for number in range(rounds):
            for way in ways:
                folder = Path(name) / f"{way}-{number}"
                drive = driven(prepared, folder, way, rate, seconds, ahead)
                found[way].append(drive.result)
                cpu[way].append(drive.cpu)
    for leg in LEGS:
        for share in ("p50", "p90", "p99"):
            values = {
                way: np.array([getattr(one.legs_us[leg], share) for one in results])
                for way, results in found.items()
            }
            row = [f"{way} {np.median(values[way]):7.0f} us" for way in ways]
            ratios = [np.median(values[way] / values["plain"]) for way in ways[1:]]
            print(f"{leg:20} {share}  {'  '.join(row)}  ratios {ratios[0]:.2f} {ratios[1]:.2f}")
    for way, results in found.items():
        off = sum(one.off_track_samples or 0 for one in results)
        lost = sum(one.lost or 0 for one in results)
        fallbacks = sum(one.fallbacks for one in results)
        took = {name: np.median([one[name] for one in cpu[way]]) for name in cpu[way][0]}
        shares = ", ".join(f"{name} {100 * share:.0f} %" for name, share in took.items())
        print(
            f"{way}: {off} samples off the track, {lost} messages lost, {fallbacks} fallbacks; "
            f"CPU: {shares}"
        )


if __name__ == "__main__":
    main()
