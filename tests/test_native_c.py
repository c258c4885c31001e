"""The artefact's C without Python: under sanitizers, without allocations, to the same bits."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from bayesrace.arrays import Floats
from bayesrace.controller.native_step import NativeStep
from bayesrace.gp.weights import Weights, zero_weights
from bayesrace.vehicles import Car
from tests.conftest import SETTINGS, Circuit, Problem, native_numbers
from tests.native_programs import (
    OPTIMISED,
    PROGRAMS,
    SANITIZED,
    SANITIZERS,
    STRICT,
    gcc,
    native_program,
)

HARNESS = PROGRAMS / "harness.c"
STEPS = 300


def states(recorded: list[Problem]) -> Floats:
    """x and d_previous of a drive with bad measurements strewn in, shape (STEPS, 8)."""
    rows = np.array([np.r_[p.x0, p.d_previous] for p in recorded[:STEPS]])
    bad = np.array([np.nan, np.inf, -np.inf, 1e300, 99.0, -99.0, 1.4, 0.6])
    random = np.random.default_rng(0)
    for k in range(5, STEPS, 11):
        rows[k, random.integers(8)] = bad[k % len(bad)]
    rows[30::60, 6] = 0.6  # steered farther than a period can bring back
    return rows


@pytest.fixture(scope="module")
def problems(
    tmp_path_factory: pytest.TempPathFactory,
    recorded: list[Problem],
    circuit: Circuit,
    weights: Weights,
    car: Car,
) -> Path:
    """The harness' input file."""
    table = circuit.table
    parts = [
        np.r_[table.spacing_m, len(table.rows), table.rows.ravel()],
        native_numbers(SETTINGS, car, weights),
        np.r_[STEPS, states(recorded).ravel()],
    ]
    path = tmp_path_factory.mktemp("native") / "problems.bin"
    np.concatenate(parts).tofile(path)
    return path


def run(program: Path, problems: Path, folder: Path, *under: str) -> Floats:
    """The harness' results; "under" another program, such as valgrind."""
    results = folder / "results.bin"
    line: list[str | Path] = [*under, program, problems, results]
    done = subprocess.run(line, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr[-4000:]
    return np.fromfile(results).reshape(STEPS, 4)


def test_the_control_loop_never_allocates_and_python_sees_the_same_bits(
    kinematic_artefact: Path,
    problems: Path,
    tmp_path: Path,
    car: Car,
    weights: Weights,
    circuit: Circuit,
    recorded: list[Problem],
) -> None:
    wraps = [f"-Wl,--wrap={name}" for name in ("malloc", "calloc", "realloc", "free")]
    counting = ["-DCOUNT_ALLOCATIONS", *wraps]
    out = tmp_path / "harness"
    program = native_program(kinematic_artefact, HARNESS, out, *OPTIMISED, also=counting)
    results = run(program, problems, tmp_path)
    assert (results[:, 0] == 0).all()
    assert set(np.unique(results[:, 1])) >= {1.0, 3.0, 6.0}  # acceptable, infeasible, bad state

    step = NativeStep(kinematic_artefact, car, SETTINGS)
    step.set_weights(weights)
    step.set_path(circuit.table)
    # as the harness does, up to where it begins to spoil references
    for k, row in enumerate(states(recorded)[: STEPS // 2]):
        if k % 50 == 40:
            if k % 100 == 40:
                step.load_weights(b"")
            else:
                step.set_weights(weights)
        if k % 97 == 96:
            step.reset()
        status = step.step(row[:7], float(row[7]))
        assert status == results[k, 1]
        if status.usable:
            assert step.u.tobytes() == results[k, 2:].tobytes()


@pytest.mark.check
@pytest.mark.parametrize("artefact", ["kinematic_artefact", "dynamic_artefact"])
def test_no_sanitizer_finds_anything(
    artefact: str,
    problems: Path,
    tmp_path: Path,
    car: Car,
    weights: Weights,
    request: pytest.FixtureRequest,
) -> None:
    folder: Path = request.getfixturevalue(artefact)
    flags = SANITIZED
    if artefact == "dynamic_artefact":  # its capacity is 8 points
        nothing = native_numbers(SETTINGS, car, zero_weights(car.name, "none"))
        full = len(native_numbers(SETTINGS, car, weights))
        data = np.fromfile(problems)
        steps = data[-(8 * STEPS + 1) :]
        head = data[: len(data) - len(steps) - full]
        problems = tmp_path / "problems.bin"
        np.concatenate([head, nothing, steps]).tofile(problems)
        flags = SANITIZERS  # its equations take long to optimise
    program = native_program(folder, HARNESS, tmp_path / "harness", *flags)
    results = run(program, problems, tmp_path)
    assert (results[:, 0] == 0).all()


@pytest.mark.check
def test_valgrind_finds_nothing(kinematic_artefact: Path, problems: Path, tmp_path: Path) -> None:
    """No use of what was never written, no access outside, nothing left at the end."""
    valgrind = shutil.which("valgrind")
    if valgrind is None:
        pytest.skip("valgrind is not installed")
    flags = ("-O1", "-g", "-std=gnu11", *STRICT)
    program = native_program(kinematic_artefact, HARNESS, tmp_path / "harness", *flags)
    # --track-origins=yes takes as long again: for when there is a finding
    line = [valgrind, "-q", "--leak-check=full", "--error-exitcode=9"]
    results = run(program, problems, tmp_path, *line)
    assert (results[:, 0] == 0).all()


def test_the_public_header_is_plain_c99(kinematic_artefact: Path, tmp_path: Path) -> None:
    source = tmp_path / "user.c"
    source.write_text('#include "bayesrace_mpc.h"\nint main(void) { return br_mpc_abi() - 1; }\n')
    strict = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror")
    gcc(*strict, "-fsyntax-only", f"-I{kinematic_artefact}", source)
