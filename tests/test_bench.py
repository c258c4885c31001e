"""``bayesrace bench`` measures what is driven, with its own error, and writes what was promised."""

import json
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bayesrace.controller.assembly import compiled_controller
from bayesrace.controller.settings import MpcSettings
from bayesrace.gp.weights import Weights
from bayesrace.operation.closed_loop import ClosedLoop
from bayesrace.studies.bench import _Drive
from bayesrace.vehicles import Car
from tests.conftest import Circuit
from tests.programs import run

PARTS = ("whole step", "preparation", "feedback")
CASES = tuple(product(("tracking", "progress"), (0.95, 0.0)))


def test_a_step_is_timed_as_it_is_driven_and_solving_it_leaves_no_trace(
    kinematic_artefact: Path, car: Car, weights: Weights, circuit: Circuit
) -> None:
    """The whole step gives the inputs that lockstep drives with, at its caution; the same to the
    bit where each step is iterated to convergence first."""
    track, line = circuit.track, circuit.line
    make = partial(compiled_controller, kinematic_artefact, car, track, line, weights)
    driven, controller = ClosedLoop(car, track, line, make()).drive(0, 1.0), make()
    drive = _Drive("tracking", car, MpcSettings(), make)
    drive.states = driven.states[:-1]
    plain = drive._replay(controller, drive.states, None)
    assert plain[:, :2] == pytest.approx(driven.u, abs=1e-12)
    solutions = []

    def solve(k: int) -> None:
        solutions.append(drive._converged(controller.native, drive.states[k]))

    solved = drive._replay(controller, drive.states, None, solve)
    assert np.array_equal(solved[:, :3], plain[:, :3])
    assert sum(one is not None for one in solutions) > 30


@pytest.fixture(scope="module")
def numbers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """A short bench; times are looked at for order only."""
    path = tmp_path_factory.mktemp("bench") / "bench.json"
    done = run("bench", "--problems", "60", "--peers", "2", "--points", "240", "--json", path)
    assert done.returncode == 0, done.stderr
    assert "CasADi" in done.stdout
    content: dict[str, Any] = json.loads(path.read_text())
    return content


@pytest.mark.check
def test_bench_writes_the_promised_form(numbers: dict[str, Any]) -> None:
    rows, ipopt = numbers["rows"], numbers["ipopt"]
    found = [(row["problem"], row["caution"], row["part"]) for row in rows]
    assert found == [(*case, part) for case, part in product(CASES, PARTS)]
    for times in (row["us"] for row in (*rows, ipopt)):
        assert sorted(times) == ["max", "p50", "p90", "p99"]
        assert 0 < times["p50"] <= times["p90"] <= times["p99"] <= times["max"]
    for row, name in product(rows, ("d", "delta_rate")):
        assert (row[name] is None) == (row["part"] == "preparation")
        if row[name] is not None:
            assert 0 <= row[name]["p95"] <= row[name]["p99"]
    whole = rows[found.index(("tracking", 0.0, "whole step"))]
    assert ipopt["speedup_p50"] == pytest.approx(ipopt["us"]["p50"] / whole["us"]["p50"], rel=1e-12)
    assert (numbers["gp_points"], numbers["problems"], ipopt["peers"]) == (240, 60, 2)


@pytest.mark.check
def test_one_step_is_close_to_the_converged_solution(numbers: dict[str, Any]) -> None:
    """Bounds are those of the honest one-iteration peer, acados' exact RTI; no time is judged."""
    for row in numbers["rows"]:
        assert row["compared"] >= 0.8 * row["sought"] > 0
        if row["problem"] == "tracking" and row["part"] != "preparation":
            assert row["delta_rate"]["p95"] <= 0.23
            assert row["d"]["p99"] <= 0.15
    assert numbers["ipopt"]["solved"] >= 1
    assert numbers["ipopt"]["agreement"] <= 1e-6
