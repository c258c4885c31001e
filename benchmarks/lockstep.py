"""Real-time factor of a lockstep run: two processes over Zenoh, and in one process.

    python -m benchmarks.lockstep [--laps 3] [--rounds 5] [--track NAME|FILE.csv]

The BayesRace controller drives the same laps over and over: over Zenoh, recorded as in a race; over
Zenoh, unrecorded; in one process, with a log like the race's; in one process without. The four take
turns, so that what the machine does meanwhile hits all of them. Prints the median real-time factor
of each, and how many times as fast as the recorded run it is; ends with an error if the states of
any two runs differ in a bit.
"""

import argparse
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
from rich.console import Console

from bayesrace.gp.weights import read_weights
from bayesrace.log import LogReader, LogWriter
from bayesrace.messages import EVENT, TRUTH, Event
from bayesrace.recorder import Recorder
from bayesrace.tracks import DEFAULT_RACE_TRACK
from bayesrace.transport import Director, Endpoints, Publisher, free_endpoint, open_session
from bayesrace.vehicles import DEFAULT_CAR, get_car
from controller.assembly import compiled_controller
from experiments.closed_loop import ClosedLoop
from experiments.drive import RunPlan, execute, wait_for_both
from experiments.preparation import Prepared, prepare
from experiments.processes import child
from experiments.progress import stages_on
from experiments.settings import PreparationSettings

CAR = DEFAULT_CAR
LIMIT_S = 1000.0


@contextmanager
def over_zenoh(prepared: Prepared, folder: Path) -> Iterator[Callable[[int, Path | None], float]]:
    """Plant and controller as processes; the function drives laps, records them if it gets a file,
    and returns the plant time of the run."""
    at_plant, at_controller = free_endpoint(), free_endpoint()
    both = ["--parent-pid", str(os.getpid()), "--low-latency"]
    plant = ["plant", "--endpoint", at_plant, *both]
    listen = ["--endpoint", at_plant, "--listen", at_controller]
    controller = ["controller", *prepared.arguments, *listen, *both]
    with ExitStack() as stack:
        children = [
            stack.enter_context(child(plant, folder / "plant.log")),
            stack.enter_context(child(controller, folder / "controller.log")),
        ]
        session = stack.enter_context(open_session(Endpoints(connect=(at_plant, at_controller))))
        director = Director(session, CAR)
        events: Publisher[Event] = Publisher(session, EVENT, CAR, "race")
        wait_for_both(director, children, 60.0)
        runs = 0

        def drive(laps: int, log: Path | None) -> float:
            nonlocal runs
            runs += 1
            plan = RunPlan(runs, "bayesrace", laps, LIMIT_S, lockstep=True)
            with Recorder(session, CAR, log) if log else ExitStack():
                end = execute(director, events, prepared.course.track, plan)
            return float(end.data["time_s"])

        yield drive


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
    car, course = get_car(CAR), prepared.course
    weights = read_weights(prepared.weights)
    controller = compiled_controller(prepared.artefacts[0], car, course.track, course.line, weights)
    factors: dict[str, list[float]] = {}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        networked = stack.enter_context(over_zenoh(prepared, folder))
        zenoh_log, own_log = folder / "zenoh.mcap", folder / "own.mcap"

        def in_one_process(log: LogWriter | None) -> float:
            loop = ClosedLoop(car, course.track, course.line, controller, log=log)
            return float(loop.drive(options.laps, LIMIT_S).time_s[-1])

        def logged() -> float:
            log = LogWriter(own_log)
            try:
                return in_one_process(log)
            finally:
                log.close()

        ways: dict[str, Callable[[], float]] = {
            "over Zenoh, recorded": lambda: networked(options.laps, zenoh_log),
            "over Zenoh": lambda: networked(options.laps, None),
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
    console.print(
        f"{course.track.name}, {options.laps} laps, {options.rounds} rounds; equal states"
    )
    for name, values in factors.items():
        ratio = float(np.median(np.array(values) / base))
        console.print(f"{name:24} {np.median(values):6.1f} x real time, ratio {ratio:5.2f}")


if __name__ == "__main__":
    main()
