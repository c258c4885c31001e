"""Times the QP of one step: condensing with DAQP (the step's own) against HPIPM from the wheel.

    python -m benchmarks.qp_solvers

The problems are a recorded closed loop of the tests' synthetic circuit, on which every kind of
limit binds. docs/decisions/2026-11-21-qp-solver.md holds the conclusion.
"""

import subprocess
import tempfile
from pathlib import Path

import casadi
import numpy as np

from bayesrace.arrays import Floats
from bayesrace.gp.weights import GpWeights
from bayesrace.vehicles import DEFAULT_CAR, get_car
from codegen.build import build, casadi_includes
from codegen.compiler import FLAGS, find_compiler
from codegen.settings import BuildSettings
from controller.native_step import NativeStep
from tests.conftest import SETTINGS, drive, fit_weights, make_circuit, native_numbers

ROUTES = (
    "condensing + DAQP, warm",
    "HPIPM BALANCE",
    "HPIPM BALANCE, 5 blocks",
    "HPIPM SPEED",
    "HPIPM SPEED, 5 blocks",
)
STEPS = 300


def write_problems(path: Path, artefact: Path, weights: GpWeights) -> None:
    """Records the drive and writes it as qp_solvers.c reads it."""
    car, circuit, s = get_car(DEFAULT_CAR), make_circuit(), SETTINGS
    step = NativeStep(artefact, car, s)
    step.set_weights(weights)
    step.set_path(circuit.table)
    problems = drive(step, circuit, STEPS)[0]
    recorded = [np.r_[p.x0, p.d_previous, p.reference.ravel()] for p in problems]
    head = [native_numbers(s, car, weights), np.r_[float(STEPS)]]
    np.concatenate(head + recorded).tofile(path)


def compile_harness(artefact: Path, folder: Path) -> Path:
    """The C file with the artefact's sources, DAQP, HPIPM and BLASFEO."""
    include, daqp = casadi_includes()
    libraries, out = Path(casadi.__file__).parent, folder / "qp_solvers"
    sources = sorted(artefact.glob("*.c"))
    flags = [flag for flag in FLAGS if flag != "-fPIC"]
    line = [*find_compiler().command, *flags, f"-I{artefact}", f"-I{include}"]
    line += [str(p) for p in (Path(__file__).with_suffix(".c"), *sources, daqp)]
    line += [f"-L{libraries}", "-lhpipm", "-lblasfeo", f"-Wl,-rpath,{libraries}", "-lm"]
    subprocess.run([*line, "-o", str(out)], check=True)
    return out


def measure() -> Floats:
    """Results (problems, routes, 4): time [us], distance, iterations, status."""
    artefact, _ = build(BuildSettings())
    weights = fit_weights(get_car(DEFAULT_CAR), ("rbf", "matern25", "matern15"))
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        write_problems(folder / "problems.bin", artefact, weights)
        program = compile_harness(artefact, folder)
        subprocess.run([program, folder / "problems.bin", folder / "results.bin"], check=True)
        return np.fromfile(folder / "results.bin").reshape(-1, len(ROUTES), 4)


def main() -> None:
    """Prints the table."""
    results = measure()
    print(f"{len(results)} QPs; time of the best of 5 repeats; distance to DAQP's input changes")
    print(f"{'route':26} {'p50 us':>8} {'p99 us':>8} {'max us':>8} {'iter p50':>9} "
          f"{'dist p50':>9} {'dist max':>9} {'failed':>7}")  # fmt: skip
    for j, name in enumerate(ROUTES):
        time, distance, iterations, status = results[:, j].T
        good = status == 0
        p50, p99, top = np.percentile(time, [50, 99, 100])
        print(f"{name:26} {p50:8.1f} {p99:8.1f} {top:8.1f} {np.median(iterations):9.0f} "
              f"{np.median(distance[good]):9.1e} {distance[good].max():9.1e} "
              f"{np.sum(~good):7d}")  # fmt: skip


if __name__ == "__main__":
    main()
