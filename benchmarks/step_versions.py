"""Step times and first-input errors of two checkouts, interleaved over the same recorded problems.

    python -m benchmarks.step_versions OTHER_CHECKOUT [--passes 10] [--json FILE]

Records drives of the present step on three tracks (those of ``bayesrace bench``), gives all
problems, with their paths, to a process of each checkout, and lets both solve them in turn, pass by
pass: the whole step, and, in passes between, the feedback (the step after its preparation) and the
preparation, as in lockstep, and with the budget that the preparation has in real time. Times are
CPU times of the thread, so that other processes do not count, though a busy hyperthread beside
does. A problem's time is the lower quintile of its passes, so that a stall of the machine does not
count either. Where memory happens to lie makes some percent of difference from process to process:
ratios, of this checkout over the other one, are medians over several pairs.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from bayesrace.gp.weights import encode_weights, read_weights
from bayesrace.vehicles.models import dynamic
from controller.assembly import compiled_controller
from controller.path_table import make_path_table
from operation.preparation import prepare
from operation.terminal.progress import stages_on
from plant.simulator import Simulator
from studies.bench import BenchSettings

ROOT = Path(__file__).resolve().parents[1]
TIMES = {
    "whole": ("step_us",),
    "prepared": ("feedback_us", "prepare_us"),
    "budget": ("realtime_feedback_us", "realtime_prepare_us"),
}
"""By how the steps are prepared."""
PERCENTILES = (50, 90, 99)

# Runs in either checkout, so it may use only what both have.
WORKER = """
import json, sys, time
import numpy as np
sys.path.insert(0, sys.argv[1])
from bayesrace.gp.weights import decode_weights
from bayesrace.vehicles import get_car
from codegen.build import build
from codegen.settings import BuildSettings
from controller.native_step import NativeStep
from controller.path_table import PathTable
from controller.settings import MpcSettings
data = np.load(sys.argv[2])
car = get_car(str(data["car"]))
known = {"caution": 0.0} if "caution" in MpcSettings.model_fields else {}
exact = MpcSettings(**known, iterations=100, iterations_cold=100, tolerance=1e-10, early_stop_tol=0)
def make(settings):
    step = NativeStep(build(BuildSettings(car=car.name))[0], car, settings)
    step.set_weights(decode_weights(data["weights"].tobytes()))
    return step
now = time.thread_time_ns
def solve(step, how="whole"):
    times, preparation, inputs, good = [], [], [], []
    for x, d, track in zip(data["x"], data["d"], data["track"]):
        if track >= 0:
            step.set_path(PathTable(data[f"path{track}"], float(data["spacing_m"])))
            step.reset()
        if how != "whole":
            begin = now()
            step.prepare(0.02, 0.016 if how == "budget" else 0.0)
            preparation.append((now() - begin) * 1e-3)
        begin = now()
        status = step.step(x, d)
        times.append((now() - begin) * 1e-3)
        inputs.append(step.u.tolist())
        good.append(int(status))
    return [times, preparation][: 1 + (how != "whole")], inputs, good
fast = make(MpcSettings(**known))
solve(fast)
print(json.dumps(solve(make(exact))[1:]), flush=True)
for line in sys.stdin:
    print(json.dumps(solve(fast, line.strip())), flush=True)
"""


def record(problems: int, seed: int) -> dict[str, Any]:
    """Closed loops on the tracks of the bench: what both checkouts are to solve, by name."""
    settings = BenchSettings(seed=seed)
    car = settings.driven_car
    with stages_on(Console(stderr=True)) as stages:
        prepared = prepare(settings, settings.driven_on, stages)
    weights = read_weights(prepared.weights)
    rows: dict[str, Any] = {name: [] for name in ("x", "d", "track")}
    for number, one in enumerate(prepared.tracks):
        path = make_path_table(one.track, one.line, car.tuning.path.spacing_m)
        rows |= {f"path{number}": path.rows, "spacing_m": path.spacing_m}
        controller = compiled_controller(prepared.artefacts[0], car, one.track, one.line, weights)
        step, simulator = controller.native, Simulator(dynamic(car))
        simulator.reset([*one.track.start_pose(), 1.0, 0.0, 0.0, 0.0])
        for k in range(problems // len(settings.driven_on)):
            x, d = simulator.x.copy(), simulator.u_applied[0]
            status = step.step(x, d)
            for key, value in (("x", x), ("d", d), ("track", -1 if k else number)):
                rows[key].append(value)
            simulator.step(step.u.tolist() if status.usable else None)
    encoded = np.frombuffer(encode_weights(weights), dtype=np.uint8)
    return {"car": car.name, "weights": encoded, **rows}


class _Worker:
    """A process of one checkout."""

    def __init__(self, checkout: Path, problems: Path) -> None:
        line = [sys.executable, "-P", "-c", WORKER, str(checkout), str(problems)]
        self._process = subprocess.Popen(
            line, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=checkout
        )
        self.inputs, self.converged = self._read()

    def solve(self, how: str) -> tuple[list[list[float]], list[list[float]], list[int]]:
        """One pass, of TIMES: its times [us], first inputs, statuses."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{how}\n")
        self._process.stdin.flush()
        times, inputs, good = self._read()
        return times, inputs, good

    def close(self) -> None:
        """Ends the process."""
        self._process.communicate()

    def _read(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit("a worker has ended: see above")
        return json.loads(line)


def _passes(workers: dict[str, _Worker], passes: int) -> dict[str, Any]:
    """Of each checkout, the times by name (passes, problems), and by how it was prepared the first
    inputs that it gives with their statuses, from the last pass."""
    found: dict[str, Any] = {name: {} for name in workers}
    for number in range(passes):
        for name in list(workers)[:: 1 if number % 2 else -1]:
            own, answers = found[name], {}
            for how, kinds in TIMES.items():
                times, *answers[how] = workers[name].solve(how)
                for kind, took in zip(kinds, times, strict=True):
                    own.setdefault(kind, []).append(took)
                own[how] = np.array(answers[how][0]), np.array(answers[how][1]) <= 1
            assert answers["prepared"] == answers["whole"], "the preparation has changed a step"
    return found


def measure(other: Path, problems: Path, passes: int) -> dict[str, Any]:
    """Percentiles of times and error of both, and their ratios."""
    workers = {"this": _Worker(ROOT, problems), "other": _Worker(other, problems)}
    found = _passes(workers, passes)
    exact = {name: np.array(worker.inputs) for name, worker in workers.items()}
    both = np.all([np.array(worker.converged) == 0 for worker in workers.values()], axis=0)
    apart = np.abs(exact["this"] - exact["other"])
    same = both & (apart.max(axis=1) < 1e-3)
    result: dict[str, Any] = {
        "problems": len(both),
        "passes": passes,
        "exact_difference": apart[both].max(axis=0).tolist(),
        "same_minimum": int(same.sum()),
        "exact_difference_same_minimum": float(apart[same].max()),
    }
    answers = {name: found[name]["whole"][0] for name in workers}
    result["u0_difference"] = np.abs(answers["this"] - answers["other"]).max(axis=0).tolist()
    for name in workers:
        result[name] = {}
        for label, how in (("", "whole"), ("realtime_", "budget")):
            inputs, good = found[name][how]
            error = np.abs(inputs - exact[name])[same & good]
            result[name] |= {
                f"{label}u0_error": {
                    f"p{q}": np.percentile(error, q, axis=0).tolist() for q in (95, 99)
                },
                f"{label}usable": int(good.sum()),
            }
        for kind in (kind for kinds in TIMES.values() for kind in kinds):
            us = np.percentile(found[name][kind], 20, axis=0)
            result[name][kind] = {f"p{q}": float(np.percentile(us, q)) for q in PERCENTILES}
        workers[name].close()
    result["ratio"] = {
        kind: {q: us / result["other"][kind][q] for q, us in result["this"][kind].items()}
        for kinds in TIMES.values()
        for kind in kinds
    }
    return result


def main() -> None:
    """See the text of this module."""
    parser = argparse.ArgumentParser(description="Step time of two checkouts, interleaved.")
    parser.add_argument("other", type=Path, help="checkout to compare with")
    parser.add_argument("--problems", type=int, default=900)
    parser.add_argument("--passes", type=int, default=10, help="of each pair of processes")
    parser.add_argument("--pairs", type=int, default=9, help="pairs of processes, one by one")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write the numbers to this file")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        problems = Path(folder) / "problems.npz"
        np.savez(problems, **record(given.problems, given.seed))
        pairs = [measure(given.other.resolve(), problems, given.passes) for _ in range(given.pairs)]
    ratio = {
        kind: {q: float(np.median([pair["ratio"][kind][q] for pair in pairs])) for q in one}
        for kind, one in pairs[0]["ratio"].items()
    }
    p50 = {kind: sorted(pair["ratio"][kind]["p50"] for pair in pairs) for kind in ratio}
    result = pairs[-1] | {"ratio": ratio, "ratio_p50_of_pairs": p50}
    text = json.dumps(result, indent=1)
    print(text)
    if given.json:
        given.json.write_text(text + "\n")


if __name__ == "__main__":
    main()
