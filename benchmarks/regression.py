"""Two versions compared, interleaved: step, cycle, lockstep, start and memory.

    python -m benchmarks.regression A B [--rounds 5] [--laps 6] [--json FILE]

A and B are commits, or folders with a checkout. A commit is checked out beside, in a folder that is
removed afterwards. Each round measures A then B, or B then A, one thing at a time in a process of
its own, with the packages of this environment and the native code that each version builds:

- step, preparation, cycle: median execution time of a step after its preparation and of the
  preparation; CPU time of a whole cycle of a run in one process, plant included;
- lockstep: real-time factor of a run of two processes over Zenoh, recorded as in a race;
- start: CPU time of ``bayesrace --help`` and of ``bayesrace build`` from the cache;
- memory: resident size of a controller process after a run.

Prints the median of each and the ratio B over A, the median of the rounds' with its range, so that
a machine that is faster at one hour than at another compares fairly. Ends with an error if the laps
of the two are not the same to the bit and ``--same-laps`` is given.
"""

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

from rich.console import Console
from rich.table import Table

_ROOT: Final = Path(__file__).resolve().parents[1]
_TRACK: Final = "harbour"

_FIGURES: Final = {
    "step_us": "step after preparation, p50 [µs]",
    "prepare_us": "preparation, p50 [µs]",
    "cycle_us": "cycle in one process, CPU [µs]",
    "factor": "lockstep over Zenoh, recorded [x real time]",
    "help_s": "bayesrace --help, CPU [s]",
    "build_s": "bayesrace build, cached, CPU [s]",
    "memory_mb": "controller process [MB]",
}

# Both run in either version, so they may use only what both have.
_PREPARED: Final = """
import json, statistics, sys, tempfile, time
from contextlib import ExitStack
from pathlib import Path
from rich.console import Console
from operation.drive import RunPlan
from operation.preparation import prepare
from operation.settings import PreparationSettings
from operation.terminal.progress import stages_on
track, laps = sys.argv[1], int(sys.argv[2])
with stages_on(Console(quiet=True)) as stages:
    prepared = prepare(PreparationSettings(), (track,), stages)
first = prepared.first
"""
_IN_ONE_PROCESS: Final = (
    _PREPARED
    + """
from bayesrace.gp.weights import read_weights
from bayesrace.vehicles import get_car
from controller.assembly import compiled_controller
from operation.closed_loop import ClosedLoop
car = get_car("orca")
weights = read_weights(prepared.weights)
controller = compiled_controller(prepared.artefacts[0], car, first.track, first.line, weights)
loop = ClosedLoop(car, first.track, first.line, controller)
loop.drive(1)
cycle, preparations = loop._cycle, []
prepare_next = cycle.prepare
def timed(*arguments):
    prepare_next(*arguments)
    preparations.append(cycle.timing.prepare_us)
begin = time.thread_time()
driven = loop.drive(laps, 1000.0)
took = time.thread_time() - begin
cycle.prepare = timed
loop.drive(1)
print(json.dumps({
    "step_us": statistics.median(driven.step_us),
    "prepare_us": statistics.median(preparations),
    "cycle_us": 1e6 * took / len(driven.states),
    "laps": driven.laps_s,
}))
"""
)
_OVER_ZENOH: Final = (
    _PREPARED
    + """
import inspect
from bayesrace.recorder import Recorder
from operation.system import started_system
known = inspect.signature(started_system).parameters
how = {"lockstep": True} if "lockstep" in known else {"both": ["--low-latency"]}
with ExitStack() as stack:
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
    system = stack.enter_context(started_system("orca", folder, **how))
    stack.enter_context(system.controller(prepared.arguments))
    session = getattr(system, "recording", system.session)
    stack.enter_context(Recorder(session, "orca", folder / "log.mcap"))
    for run, count in ((1, 1), (2, laps)):
        begin = time.perf_counter()
        plan = RunPlan(run, "bayesrace", count, 1000.0, lockstep=True)
        end = system.drive(first.track, plan)
        took = time.perf_counter() - begin
    status = Path(f"/proc/{system.children['controller'].pid}/status").read_text()
resident = next(line for line in status.splitlines() if line.startswith("VmRSS"))
print(json.dumps({
    "factor": float(end.data["time_s"]) / took,
    "memory_mb": int(resident.split()[1]) / 1024,
}))
"""
)


class Version:
    """A checkout, and what has been measured of it."""

    def __init__(self, name: str, folder: Path) -> None:
        self.name, self._folder = name, folder
        self.figures: dict[str, list[float]] = {figure: [] for figure in _FIGURES}
        self.laps: list[float] = []

    def measure(self, laps: int) -> None:
        """One of each figure."""
        found = self._run(_IN_ONE_PROCESS, laps) | self._run(_OVER_ZENOH, laps)
        found["help_s"], found["build_s"] = self._cpu_s("--help"), self._cpu_s("build")
        self.laps = found.pop("laps")
        for figure, value in found.items():
            self.figures[figure].append(value)

    def _run(self, program: str, laps: int) -> dict[str, Any]:
        line = [sys.executable, "-P", "-c", program, _TRACK, str(laps)]
        done = subprocess.run(line, **self._where, stdout=subprocess.PIPE, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{self.name}: the measurement has failed, see above")
        found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
        return found

    def _cpu_s(self, command: str) -> float:
        """CPU time of a ``bayesrace`` command and its children, the least of three."""
        line = [sys.executable, "-P", "-m", "operation.cli", command]
        times = []
        for _ in range(3):
            before = resource.getrusage(resource.RUSAGE_CHILDREN)
            subprocess.run(line, **self._where, stdout=subprocess.DEVNULL, check=True)
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            times.append(after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime)
        return min(times)

    @property
    def _where(self) -> dict[str, Any]:
        """Its modules come first, whatever is installed."""
        return {"cwd": self._folder, "env": os.environ | {"PYTHONPATH": str(self._folder)}}


@contextmanager
def checked_out(name: str) -> Iterator[Version]:
    """The version of a folder or of a commit, for the block."""
    if Path(name).is_dir():
        yield Version(name, Path(name).resolve())
        return
    git = ["git", "-C", str(_ROOT), "worktree"]
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "checkout"
        added = [*git, "add", "--quiet", "--detach", str(folder), name]
        if subprocess.run(added, check=False).returncode:
            raise SystemExit(f"{name} is neither a folder nor a commit")
        try:
            yield Version(name, folder)
        finally:
            subprocess.run([*git, "remove", "--force", str(folder)], check=True)


def compared(a: Version, b: Version) -> dict[str, Any]:
    """Medians of both and the ratios, by figure."""
    result = {}
    for figure in _FIGURES:
        pairs = zip(a.figures[figure], b.figures[figure], strict=True)
        ratios = sorted(of_b / of_a for of_a, of_b in pairs)
        result[figure] = {
            "a": statistics.median(a.figures[figure]),
            "b": statistics.median(b.figures[figure]),
            "ratio": statistics.median(ratios),
            "range": [ratios[0], ratios[-1]],
        }
    return result


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("a", help="commit or folder to compare with")
    parser.add_argument("b", help="commit or folder that is compared")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--laps", type=int, default=6, help="of each run")
    parser.add_argument("--same-laps", action="store_true", help="fail if the laps differ")
    parser.add_argument("--json", type=Path, help="write the numbers to this file")
    options = parser.parse_args()
    with ExitStack() as stack:
        a, b = (stack.enter_context(checked_out(name)) for name in (options.a, options.b))
        for number in range(options.rounds):
            for version in (a, b) if number % 2 == 0 else (b, a):
                version.measure(options.laps)
    result = compared(a, b)
    table = Table(title=f"{_TRACK}, {options.laps} laps, {options.rounds} rounds")
    for column in ("", a.name, b.name, "ratio", "range"):
        table.add_column(column, justify="left" if not column else "right")
    for figure, text in _FIGURES.items():
        one = result[figure]
        low, high = one["range"]
        row = (f"{one['a']:.3g}", f"{one['b']:.3g}", f"{one['ratio']:.2f}", f"{low:.2f}–{high:.2f}")
        table.add_row(text, *row)
    Console().print(table)
    same = a.laps == b.laps
    print(f"laps: {'the same' if same else f'{a.laps} and {b.laps}'}")
    if options.json:
        options.json.write_text(json.dumps(result | {"same_laps": same}, indent=1) + "\n")
    if options.same_laps and not same:
        raise SystemExit("the laps differ")


if __name__ == "__main__":
    main()
