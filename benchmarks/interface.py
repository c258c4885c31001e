"""What the Python interface costs: import, the ten lines of docs/index.md, a step, the closed loop.

    python -m benchmarks.interface [--rounds 9]

The step of ``bayesrace.Controller`` and the three C calls that it makes (a state observed, an input
decided, the next step prepared) take turns on the same laps. ``bayesrace.drive`` drives them with
default caution and learned weights, on one core.
"""

import gc
import os
import re
import subprocess
import sys
import time
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import bayesrace as br
from bayesrace.arrays import Floats
from benchmarks.harness import ROOT, Row, arguments, report

_DT_S = 0.02


def took_s(code: str, **variables: str) -> float:
    """Wall-clock time of a program, its start included."""
    begin_s = time.perf_counter()
    with TemporaryDirectory() as folder:
        environment = {**os.environ, **variables}
        subprocess.run([sys.executable, "-c", code], cwd=folder, env=environment, check=True,
                       stdout=subprocess.DEVNULL)  # fmt: skip
    return time.perf_counter() - begin_s


def started(rounds: int) -> list[Row]:
    """Importing, and the program of the start page from an empty and from a filled cache."""
    page = (ROOT / "docs" / "index.md").read_text()
    found = re.search(r"```python\n(.*?)```", page, re.DOTALL)
    assert found is not None
    bare = np.median([took_s("pass") for _ in range(rounds)])
    imported = np.median([took_s("import bayesrace") for _ in range(rounds)])
    with TemporaryDirectory() as cache:
        cold, warm = (took_s(found[1], BAYESRACE_CACHE=cache) for _ in range(2))
    return [
        {"what": "import bayesrace [ms]", "value": 1e3 * float(imported - bare)},
        {"what": "ten lines, empty cache [s]", "value": cold},
        {"what": "ten lines, again [s]", "value": warm},
    ]


def learned() -> br.Controller:
    """A controller of the default car and track that has learned from two runs."""
    controller = br.Controller("orca", "harbour")
    simulator = br.Simulator(controller.car, controller.track)
    for _ in range(2):
        run = br.drive(controller, simulator, laps=2)
        controller.weights = br.train(run, initial=controller.weights)
    return controller


def steps(controller: br.Controller, rounds: int) -> list[Row]:
    """By the interface, and by its C calls alone."""
    run = br.drive(controller, br.Simulator(controller.car, controller.track), laps=4)
    states = [br.State(*one) for one in run.x[:-1].tolist()]
    inputs = [tuple(one) for one in np.vstack((np.zeros(2), run.u[:-1])).tolist()]
    over, alone = [], []
    for _ in range(rounds):
        alone.append(by_c(controller, run.x[:-1], inputs))
        over.append(by_interface(controller, states, inputs) - alone[-1])
    return [
        {"what": "step, its C calls [us]", "value": float(np.median(alone))},
        {"what": "step, over its C calls [us]", "value": float(np.median(over))},
    ]


def by_interface(controller: br.Controller, states: list[Any], inputs: list[Any]) -> Floats:
    """Time of each step [us]."""
    controller.reset()
    times = []
    for state, u in zip(states, inputs, strict=True):
        begin_ns = time.perf_counter_ns()
        controller.step(state, _DT_S, u_applied=u)
        times.append(time.perf_counter_ns() - begin_ns)
    return 1e-3 * np.array(times)


def by_c(controller: br.Controller, states: Floats, inputs: list[Any]) -> Floats:
    """Time of the C calls of each step [us]."""
    controller.reset()
    driver, times = controller._driver, []
    library, cycle, measured = driver._library, driver._cycle, driver._measured
    for k, (x, u) in enumerate(zip(states.tolist(), inputs, strict=True)):
        measured.epoch, measured.run, measured.seq = 1, controller._run, k
        measured.time_s, measured.lockstep = k * _DT_S, True
        measured.x, measured.u_applied, measured.delays = x, u, 0
        measured.estimated, measured.measurements = False, 0
        begin_ns = time.perf_counter_ns()
        library.br_cycle_observe(cycle, measured)
        library.br_cycle_decide(cycle, driver._null, k * _DT_S, 0.0, 0.0, driver._decided)
        library.br_cycle_prepare(cycle, driver._counters.interval_s, 0.0)
        times.append(time.perf_counter_ns() - begin_ns)
    return 1e-3 * np.array(times)


def loop(controller: br.Controller, rounds: int) -> Row:
    """Laps of the closed loop over the time that they take."""
    simulator = br.Simulator(controller.car, controller.track)
    factors = []
    for _ in range(rounds):
        begin_s = time.process_time()
        run = br.drive(controller, simulator, laps=6)
        factors.append(float(run.t[-1]) / (time.process_time() - begin_s))
    return {"what": "drive [x real time]", "value": float(np.median(factors))}


def main() -> None:
    """The program."""
    given = arguments(__doc__, rounds=9)
    rows = started(given.rounds)
    controller = learned()
    gc.disable()
    rows += [*steps(controller, given.rounds), loop(controller, given.rounds)]
    report(given, f"Python interface, {given.rounds} rounds", rows)


if __name__ == "__main__":
    main()
