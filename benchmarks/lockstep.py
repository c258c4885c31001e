"""Real-time factor of a lockstep run: two processes over Zenoh, and in one process.

    python -m benchmarks.lockstep [--laps 3] [--rounds 5] [--track NAME|FILE.csv]

The controller with learned weights drives the same laps over and over: over Zenoh, recorded as in a
race, and not recorded; in one process with a log like the race's, and without one. Ends with an
error if the states of the two logs differ in a bit. The last row is the controller's memory.
"""

import itertools
import time
from contextlib import ExitStack, closing, nullcontext
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bayesrace.log import LogReader, LogWriter
from bayesrace.messages import TRUTH
from bayesrace.operation.closed_loop import ClosedLoop
from bayesrace.operation.run_plan import RunPlan
from bayesrace.operation.system import started_system
from bayesrace.recorder import Recorder
from bayesrace.scene import Scene
from bayesrace.tracks import DEFAULT_RACE_TRACK
from bayesrace.vehicles import default_car
from benchmarks.harness import (
    Row,
    arguments,
    controller,
    in_turn,
    prepared,
    ratio,
    report,
    resident_bytes,
)


def main() -> None:
    """Drives in turn, compares the states, prints the factors."""
    given = arguments(__doc__, track=DEFAULT_RACE_TRACK, laps=3, rounds=5)
    made, car, runs = prepared(given.track), default_car(), itertools.count(1)
    first, own = made.first, controller(made)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        system = stack.enter_context(started_system(car.name, folder, lockstep=True))
        stack.enter_context(system.controller(made.arguments))
        logs = folder / "zenoh.mcap", folder / "own.mcap"

        def recorder() -> Recorder:
            scene = Scene(car, first.track, first.line)
            return Recorder(system.recording, car.name, logs[0], scene=scene)

        def over_zenoh(record: bool) -> float:
            begin_s = time.perf_counter()
            plan = RunPlan(next(runs), "bayesrace", given.laps, 1e3, lockstep=True)
            with recorder() if record else nullcontext():
                end = system.drive(first.track, plan)
            return float(end.data["time_s"]) / (time.perf_counter() - begin_s)

        def in_one_process(record: bool) -> float:
            begin_s = time.perf_counter()
            scene = Scene(car, first.track, first.line)
            with closing(LogWriter(logs[1], scene=scene)) if record else nullcontext() as log:
                loop = ClosedLoop(car, first.track, first.line, own, log=log)
                driven_s = float(loop.drive(given.laps, 1e3).time_s[-1])
            return driven_s / (time.perf_counter() - begin_s)

        ways = {
            name + end: partial(drive, record)
            for name, drive in (("over Zenoh", over_zenoh), ("in one process", in_one_process))
            for end, record in ((", recorded", True), ("", False))
        }
        factors = in_turn(ways, given.rounds)
        memory_mb = resident_bytes(system.children["controller"].pid) / 2**20
        states = [np.array([truth.x for truth in LogReader(log).select(TRUTH)]) for log in logs]
    assert np.array_equal(states[0], states[1]), "other states"
    base, rows = factors["over Zenoh, recorded"], list[Row]()
    for name, values in factors.items():
        figure = {"way": name, "x real time, or MB": float(np.median(values))}
        rows.append(figure | ratio(values, base))
    rows.append({"way": "controller process, resident memory", "x real time, or MB": memory_mb})
    report(given, f"{first.track.name}, {given.laps} laps, {given.rounds} rounds", rows, states[0])


if __name__ == "__main__":
    main()
