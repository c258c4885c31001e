"""Execution times of the compiled step on recorded problems.

    python -m benchmarks.step [--problems 900] [--passes 4] [--caution 0.95] [--file FILE]

Drives three tracks, two of them with hairpins, and lets the step solve the problems of these drives
again: as a whole step, and as the feedback after a preparation, as in lockstep and with the budget
of real time. Times are CPU times of the thread, and a problem's is the lower quintile of the
passes, so neither other processes nor stalls count. ``--file`` keeps the problems, or has them.
"""

import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.codegen.build import build
from bayesrace.codegen.settings import BuildSettings
from bayesrace.controller.assembly import PathTable, make_path_table
from bayesrace.controller.native_step import NativeStep
from bayesrace.controller.settings import MpcSettings
from bayesrace.gp.weights import read_weights
from bayesrace.operation.closed_loop import ClosedLoop
from bayesrace.plant.simulator import PLANT
from bayesrace.tracks import DEFAULT_RACE_TRACK
from bayesrace.vehicles import default_car
from benchmarks.harness import Row, arguments, controller, percentiles, prepared, report

_TRACKS = (DEFAULT_RACE_TRACK, "random:11", "random:15")
_BUDGETS_S = {"": None, " in lockstep": 0.0, " in real time": 0.016}  # of the preparation


def record(count: int) -> Row:
    """What each step of three drives had to solve."""
    car, made, data = default_car(), prepared(*_TRACKS), Row()
    for number, on in enumerate(made.tracks):
        loop = ClosedLoop(car, on.track, on.line, controller(made, number))
        driven_s = count // len(_TRACKS) * PLANT.step_s
        states = loop.drive(0, driven_s, start_speed_mps=1.0).states[:-1]
        path = make_path_table(on.track, on.line, car.tuning.path.spacing_m)
        data[f"x{number}"] = [one.x for one in states]
        data[f"d{number}"] = [one.u_applied[0] for one in states]
        data |= {f"path{number}": path.rows, "spacing_m": path.spacing_m}
    return data | {"weights": str(made.weights)}


def solve(step: NativeStep, data: Any, budget_s: float | None) -> Floats:
    """Times of step and preparation [us] and the first input of each problem, (n, 4)."""
    now, rows = time.thread_time_ns, []
    for number in range(len(_TRACKS)):
        step.set_path(PathTable(data[f"path{number}"], float(data["spacing_m"])))
        step.reset()
        for x, d in zip(data[f"x{number}"], data[f"d{number}"].tolist(), strict=True):
            begin = now()
            if budget_s is not None:
                step.prepare(PLANT.step_s, budget_s)
            middle = now()
            step.step(x, d)
            rows.append((1e-3 * (now() - middle), 1e-3 * (middle - begin), *step.u))
    return np.array(rows)


def main() -> None:
    """Records the problems, solves them pass by pass, prints percentiles."""
    given = arguments(__doc__, problems=900, passes=4, caution=0.95, file="")
    with TemporaryDirectory() as folder:
        file = Path(given.file or Path(folder) / "problems.npz")
        if not file.exists():
            np.savez(file, **record(given.problems))
        data, car = dict(np.load(file)), default_car()
    artefact = build(BuildSettings(car=car))[0]
    step = NativeStep(artefact, car, MpcSettings(caution=given.caution))
    step.set_weights(read_weights(Path(str(data["weights"]))))
    rows, inputs = [], {}
    for how, budget_s in _BUDGETS_S.items():
        solve(step, data, budget_s)  # warms up
        passes = np.array([solve(step, data, budget_s) for _ in range(given.passes)])
        step_us, prepare_us, *_ = np.percentile(passes, 20, axis=0).T
        inputs[how] = passes[-1, :, 2:]
        named = {"feedback": step_us, "preparation": prepare_us} if how else {"whole step": step_us}
        rows += [{"us": name + how, **percentiles(us)} for name, us in named.items()]
    assert np.array_equal(inputs[""], inputs[" in lockstep"]), "a preparation has changed a step"
    report(given, f"{passes.shape[1]} steps, caution {given.caution:g}", rows, inputs[""])


if __name__ == "__main__":
    main()
