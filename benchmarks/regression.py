"""Two versions compared: benchmarks of this checkout run on the modules of both, in turn.

    python -m benchmarks.regression A B [--rounds 5] [--same] [--json FILE]
    python -m benchmarks.regression A B --of "step --passes 2" "lockstep --laps 6"

A and B are commits, or folders with a checkout. Each round runs each benchmark on both versions, in
a process of its own, with the native code that the version builds. Versions need the interfaces
that the benchmarks use. The step solves the same recorded problems in both. Prints the median of
each figure, and the ratio B over A: the median of the rounds' with its range. Says by how much
first inputs and driven states differ; ``--same`` fails if they do.
"""

import json
import os
import shlex
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from shutil import copytree
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.harness import ROOT, Row, arguments, in_turn, ratio, report


@contextmanager
def checked_out(name: str) -> Iterator[Path]:
    """The folder of a version: that itself, or the commit checked out for the block."""
    if Path(name).is_dir():
        yield Path(name).resolve()
        return
    archive = subprocess.run(["git", "-C", ROOT, "archive", name], stdout=subprocess.PIPE)
    if archive.returncode:
        raise SystemExit(f"{name} is neither a folder nor a commit")
    with TemporaryDirectory() as folder:
        subprocess.run(["tar", "-xC", folder], input=archive.stdout, check=True)
        yield Path(folder)


def measure(benchmark: str, options: list[str], version: Path, folder: Path) -> Row:
    """Runs a benchmark on a version; what its JSON file holds."""
    file, modules = folder / "result.json", f"{folder}:{version}"  # before what is installed
    line = [sys.executable, "-P", "-m", f"benchmarks.{benchmark}", *options, "--json", str(file)]
    env = os.environ | {"PYTHONPATH": modules}
    if subprocess.run(line, cwd=version, env=env, stdout=subprocess.DEVNULL).returncode:
        raise SystemExit(f"benchmarks.{benchmark} has failed on {version}, see above")
    content: Row = json.loads(file.read_text())
    return content


def compared(benchmark: str, a: list[Row], b: list[Row]) -> Iterator[Row]:
    """A row for each number in the tables of the benchmark, which are one a round."""
    for number, row in enumerate(a[0]["rows"]):
        words = ", ".join(value for value in row.values() if isinstance(value, str))
        numbers = [name for name, value in row.items() if isinstance(value, float)]
        for column in (name for name in numbers if name not in ratio([1], [1])):
            of_a, of_b = ([one["rows"][number][column] for one in found] for found in (a, b))
            medians = {"a": float(np.median(of_a)), "b": float(np.median(of_b))}
            figure = {"benchmark": benchmark, "figure": f"{words}, {column}"}
            yield figure | medians | ratio(of_b, of_a)


def main() -> None:
    """Measures both versions in turn and compares them."""
    of = ("step", "lockstep")
    given, rows, apart = arguments(__doc__, "a", "b", of=of, rounds=5, same=False), [], {}
    with ExitStack() as stack:
        versions = {}
        for name in "ab":
            folder = Path(stack.enter_context(TemporaryDirectory()))
            versions[name] = stack.enter_context(checked_out(getattr(given, name))), folder
            copytree(Path(__file__).parent, folder / "benchmarks")
        for one, *options in map(shlex.split, given.of):
            if one == "step":
                options += ["--file", str(versions["a"][1] / "problems.npz")]
            ways = {n: partial(measure, one, options, *both) for n, both in versions.items()}
            found = in_turn(ways, given.rounds)
            rows += list(compared(one, found["a"], found["b"]))
            a, b = (np.array(found[name][-1]["exact"]) for name in "ab")
            apart[one] = np.abs(a - b).max(initial=0.0) if a.shape == b.shape else np.inf
    report(given, f"a: {given.a}, b: {given.b}, {given.rounds} rounds", rows)
    for one, most in apart.items():
        print(f"{one}: results differ by {most:.2g} at most")
    sys.exit(bool(given.same and any(apart.values())))


if __name__ == "__main__":
    main()
