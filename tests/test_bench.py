"""``bayesrace bench`` measures both solvers on the same problems and writes what was promised."""

import json
from typing import Any

import pytest

from tests.programs import run

pytestmark = pytest.mark.check


@pytest.fixture(scope="module")
def numbers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """A short bench; times are looked at for order only."""
    path = tmp_path_factory.mktemp("bench") / "bench.json"
    done = run("bench", "--problems", "60", "--peers", "2", "--points", "240", "--json", path)
    assert done.returncode == 0, done.stderr
    assert "CasADi + IPOPT" in done.stdout
    assert "after preparation" in done.stdout
    content: dict[str, Any] = json.loads(path.read_text())
    return content


def test_bench_writes_the_promised_form(numbers: dict[str, Any]) -> None:
    for solver in ("step_us", "feedback_us", "ipopt_us"):
        times = numbers[solver]
        assert sorted(times) == ["max", "p50", "p90", "p99"]
        assert 0 < times["p50"] <= times["p90"] <= times["p99"] <= times["max"]
    assert numbers["speedup_p50"] == pytest.approx(
        numbers["ipopt_us"]["p50"] / numbers["step_us"]["p50"], rel=1e-12
    )
    assert sorted(numbers["u0_error"]) == ["d", "delta_rate"]
    for error in numbers["u0_error"].values():
        assert sorted(error) == ["p95", "p99"]
        assert 0 <= error["p95"] <= error["p99"]
    assert sorted(numbers["cost_gap"]) == ["p50", "p95"]
    assert numbers["gp_points"] == 240
    assert (numbers["problems"], numbers["peers"]) == (60, 2)


def test_one_step_is_close_to_the_converged_solution(numbers: dict[str, Any]) -> None:
    """Bounds are those of the honest one-iteration peer, acados' exact RTI; no time is judged."""
    assert numbers["unconverged"] <= 6  # of 60: three or four, by the rounding of the processor
    assert numbers["ipopt_solved"] >= 1
    assert numbers["ipopt_agreement"] <= 1e-6
    assert numbers["u0_error"]["delta_rate"]["p95"] <= 0.23
    assert numbers["u0_error"]["d"]["p99"] <= 0.15
    # a plan cannot cost less than the optimum, but for rounding and the model's own defect
    assert -1e-6 <= numbers["cost_gap"]["p50"] <= 1e-3
    assert numbers["cost_gap"]["p95"] <= 0.05
