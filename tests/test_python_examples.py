"""The worked examples in examples/python do what they print, and the two problems of their own
are solved to the solution of IPOPT."""

import importlib.util
import sys
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

import bayesrace as br
from bayesrace.arrays import Floats
from bayesrace.codegen.ocp import OcpNlp
from tests.programs import ROOT

IPOPT = {"tol": 1e-10, "mu_init": 1e-6, "bound_relax_factor": 0.0}
EXACT = {"iterations": 200, "iterations_cold": 200, "tolerance": 1e-8}


def example(name: str) -> Any:
    """An example as a module: the folder is no package."""
    path = ROOT / "examples" / "python" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"example_{name}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look up the types of their fields there
    spec.loader.exec_module(module)
    return module


def assert_picture(path: Path) -> None:
    data = path.read_bytes()
    assert data.startswith(b"\x89PNG")
    width = int.from_bytes(data[16:20])
    assert 900 <= width <= 1200  # as wide as a telephone shows


def assert_solved_as_by_ipopt(
    mpc: br.Mpc, oracle: OcpNlp, values: dict[str, float], case: tuple[Floats, Floats, Floats]
) -> None:
    """IPOPT begins at the plan: that the minimum is the same one is not the question."""
    x, stages, before = case
    mpc.reset()
    found = mpc.step(x, stages, before)
    assert found.usable
    optimum = oracle.solve(x, before, stages, values, (found.plan, found.plan_u))
    assert optimum.success, optimum.status
    np.testing.assert_allclose(found.u, optimum.u[0], rtol=0, atol=1e-4)
    assert found.cost == pytest.approx(optimum.cost, rel=1e-6)


@pytest.mark.check
def test_a_cost_of_ones_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = example("own_cost").main(tmp_path)
    built_in, results = made["built_in"], list(made["results"].values())
    assert made["same"]  # without the added cost, the states are equal to the bit
    for one in (built_in, *results):
        assert len(one.run.laps) == 3
        assert one.run.off_track == 0
    slips, laps = [one.slip_deg for one in results], [one.flying_s for one in results]
    assert slips == sorted(slips, reverse=True)
    assert laps == sorted(laps)
    assert slips[-1] < 0.8 * slips[0]
    assert laps[-1] < 1.05 * laps[0]
    assert "a weight of 0 drives the same states to the bit" in capsys.readouterr().out
    assert_picture(tmp_path / "own_cost.png")


def test_a_model_in_frenets_coordinates(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frenet = example("frenet")
    made = frenet.main(tmp_path)
    driven, car, track = made["driven"], made["car"], made["track"]
    assert len(driven.laps) == 3
    assert max(driven.laps[1:]) < 11
    assert driven.off_track_m.max() + car.width_m / 2 < 0  # not even its outline
    assert driven.usable.all()
    assert "states off the track: 0 of" in capsys.readouterr().out
    assert_picture(tmp_path / "frenet.png")

    problem = made["mpc"].problem
    exact = br.Mpc(problem, frenet.HORIZON, frenet.STEP_S, frenet.PARAMETERS, solver=EXACT)
    s = problem.symbols
    f = ca.Function("F", [s.x, s.u], [problem.f(s.x, s.u, ca.SX(0, 1))])
    oracle = OcpNlp(problem, f, frenet.HORIZON, options=IPOPT)
    for k in range(40, len(driven.x), 80):
        ahead = driven.x[k, 0] + driven.x[k, 3] * frenet.STEP_S * np.arange(1, frenet.HORIZON + 1)
        case = driven.x[k], frenet.stages(track, car, ahead), driven.u[k - 1]
        assert_solved_as_by_ipopt(exact, oracle, frenet.PARAMETERS, case)


def with_means(problem: br.Problem, regressors: list[Any]) -> ca.Function:
    """The corrected model by the textbook's formula, from scikit-learn's numbers."""
    s = problem.symbols
    z, means = ca.vertcat(s.x[1:], s.u), []
    for one in regressors:
        factor = one.kernel_.k1.k1.constant_value
        lengths = one.kernel_.k1.k2.length_scale
        near = [ca.exp(-ca.sumsqr((z - row) / lengths) / 2) for row in one.X_train_]
        mean = factor * ca.dot(ca.DM(one.alpha_), ca.vertcat(*near))
        means.append(float(one._y_train_mean) + float(one._y_train_std) * mean)
    corrected = problem.f(s.x, s.u, ca.vertcat(*means))
    return ca.Function("F", [s.x, s.u], [corrected])


@pytest.mark.check
def test_a_cart_with_a_pole(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cart_pole = example("cart_pole")
    made = cart_pole.main(tmp_path)
    nominal, corrected, perfect = made["motions"].values()
    assert corrected.upright_s < nominal.upright_s - 1
    assert corrected.upright_s < perfect.upright_s + 0.1
    assert corrected.offset_m < 0.1 * nominal.offset_m
    assert perfect.usable == len(perfect.u)
    assert made["left"].max() < 0.15
    assert "corrected: upright after" in capsys.readouterr().out
    assert_picture(tmp_path / "cart_pole.png")

    problem, values = made["mpc"].problem, cart_pole.PARAMETERS
    exact = br.Mpc(problem, cart_pole.HORIZON, cart_pole.STEP_S, values, solver=EXACT)
    learned: tuple[list[Any], ...] = ([], made["regressors"])
    for regressors in learned:
        exact.set_regressors(regressors)
        s = problem.symbols
        f = ca.Function("F", [s.x, s.u], [problem.f(s.x, s.u, ca.DM.zeros(2))])
        if regressors:
            f = with_means(problem, regressors)
        oracle = OcpNlp(problem, f, cart_pole.HORIZON, options=IPOPT)
        for k in (30, 60, 110):
            case = corrected.x[k], cart_pole.targets(k), corrected.u[k - 1]
            assert_solved_as_by_ipopt(exact, oracle, values, case)


@pytest.mark.check
def test_a_simulator_of_ones_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runs = example("own_simulator").main(tmp_path)
    assert [len(one.laps) for one in runs.values()] == [2, 2, 2]
    uncorrected, *corrected = runs.values()
    assert uncorrected.off_track > 100
    for one in corrected:
        assert one.off_track == 0
        assert one.laps[1] < 0.8 * uncorrected.laps[1]
    assert "learned: <Run of 'orca' on 'workshop': " in capsys.readouterr().out
    assert_picture(tmp_path / "own_simulator.png")


@pytest.mark.check
def test_the_learning_curve_of_ones_own_car(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = example("learning_curve").main(tmp_path)
    best = made["best"].laps[-1]
    for curve in made["curves"]:
        laps = curve.flying_s
        assert not laps[0] < 1.5 * best  # not finished, or slow
        assert laps[-1] < 1.02 * best
        assert curve.off_track[0] > 0
        assert curve.off_track[-1] == 0
        assert curve.error[-1] < 0.1
    assert "learned from  8 laps" in capsys.readouterr().out
    assert_picture(tmp_path / "learning_curve.png")
