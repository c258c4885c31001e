"""Real-time factor of a lockstep run: two processes over Zenoh, and in one process.

    python -m benchmarks.lockstep [--laps 3] [--rounds 5] [--track NAME|FILE.csv]

The BayesRace controller drives the same laps over and over: over Zenoh, recorded as in a race; over
Zenoh, unrecorded; in one process, with a log like the race's; in one process without. The four take
turns, so that what the machine does meanwhile hits all of them. Prints the median real-time factor
of each, and how many times as fast as the recorded run it is; ends with an error if the states of
any two runs differ in a bit.
"""

import argparse
import itertools
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from rich.console import Console

from bayesrace.gp.weights import read_weights
from bayesrace.log import LogReader, LogWriter
from bayesrace.messages import TRUTH
from bayesrace.recorder import Recorder
from bayesrace.tracks import DEFAULT_RACE_TRACK
from bayesrace.vehicles import DEFAULT_CAR, get_car
from controller.assembly import compiled_controller
from operation.closed_loop import ClosedLoop
from operation.drive import RunPlan
from operation.preparation import Prepared, prepare
from operation.settings import PreparationSettings
from operation.system import System, started_system
from operation.terminal.progress import stages_on

CAR = DEFAULT_CAR
LIMIT_S = 1000.0


def over_zenoh(system: System, prepared: Prepared, laps: int, run: int, log: Path | None) -> float:
    """Drives a run by two processes, records it if there is a log; its plant time [s]."""
    plan = RunPlan(run, "bayesrace", laps, LIMIT_S, lockstep=True)
    with Recorder(system.recording, CAR, log) if log else ExitStack():
        end = system.drive(prepared.first.track, plan)
    return float(end.data["time_s"])


def states_of(log: Path) -> np.ndarray:
    """States (n, 7) of the one run in a log."""
    return np.array([state.x for state in LogReader(log).select(TRUTH)])


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--track", default=DEFAULT_RACE_TRACK)
    parser.add_argument("--laps", type=int, default=3)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    console = Console()
    with stages_on(Console(stderr=True)) as stages:
        prepared = prepare(PreparationSettings(), (options.track,), stages)
    car, first = get_car(CAR), prepared.first
    weights = read_weights(prepared.weights)
    controller = compiled_controller(prepared.artefacts[0], car, first.track, first.line, weights)
    factors: dict[str, list[float]] = {}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        system = stack.enter_context(started_system(CAR, folder, lockstep=True))
        stack.enter_context(system.controller(prepared.arguments))
        runs = itertools.count(1)
        zenoh_log, own_log = folder / "zenoh.mcap", folder / "own.mcap"

        def in_one_process(log: LogWriter | None) -> float:
            loop = ClosedLoop(car, first.track, first.line, controller, log=log)
            return float(loop.drive(options.laps, LIMIT_S).time_s[-1])

        def logged() -> float:
            log = LogWriter(own_log)
            try:
                return in_one_process(log)
            finally:
                log.close()

        ways: dict[str, Callable[[], float]] = {
            "over Zenoh, recorded": lambda: over_zenoh(
                system, prepared, options.laps, next(runs), zenoh_log
            ),
            "over Zenoh": lambda: over_zenoh(system, prepared, options.laps, next(runs), None),
            "in one process, logged": logged,
            "in one process": lambda: in_one_process(None),
        }
        for _ in range(options.rounds):
            for name, drive in ways.items():
                begin_s = time.perf_counter()
                driven_s = drive()
                factor = driven_s / (time.perf_counter() - begin_s)
                factors.setdefault(name, []).append(factor)
            assert np.array_equal(states_of(zenoh_log), states_of(own_log)), "other states"
    base = np.array(factors["over Zenoh, recorded"])
    console.print(f"{first.track.name}, {options.laps} laps, {options.rounds} rounds; equal states")
    for name, values in factors.items():
        ratio = float(np.median(np.array(values) / base))
        console.print(f"{name:24} {np.median(values):6.1f} x real time, ratio {ratio:5.2f}")


if __name__ == "__main__":
    main()
