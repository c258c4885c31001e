"""The problem that maximises progress: IPOPT's solution, its reference, stops, starts, and bits."""

import math
from pathlib import Path

import numpy as np
import pytest

from bayesrace.arrays import Floats
from bayesrace.codegen.build import build, problem_of
from bayesrace.codegen.ocp import OcpNlp
from bayesrace.codegen.settings import BuildSettings
from bayesrace.controller.assembly import PathTable, make_path_table
from bayesrace.controller.interface import NO_LIMITS, Environment
from bayesrace.controller.native_step import NativeStep, Status
from bayesrace.controller.settings import MpcSettings
from bayesrace.gp.expression import corrected_function
from bayesrace.gp.weights import Weights
from bayesrace.integrators import PREDICTION
from bayesrace.vehicles import Car
from bayesrace.vehicles.models import dynamic, e_kinematic
from tests.conftest import SETTINGS, Circuit, discrete, offset_line
from tests.test_native_planner import nearest
from tests.test_native_prepare import BETWEEN, Between, result
from tests.test_native_step import EXACT, FROM_OUR_PLAN, TIGHT_IPOPT
from tests.test_native_time import Clock

HORIZON = 20
PROGRESS = BuildSettings(problem="progress", horizon=HORIZON, block_stages=1)
"""Without blocks, which IPOPT's solution does not have; see test_blocks.py."""


@pytest.fixture(scope="module")
def artefact() -> Path:
    return build(PROGRESS)[0]


def ready(
    artefact: Path, car: Car, weights: Weights, circuit: Circuit, settings: MpcSettings
) -> NativeStep:
    step = NativeStep(artefact, car, settings)
    step.set_weights(weights)
    step.set_path(circuit.table)
    return step


@pytest.fixture
def step(artefact: Path, car: Car, weights: Weights, circuit: Circuit) -> NativeStep:
    return ready(artefact, car, weights, circuit, MpcSettings())


def test_the_converged_step_is_the_solution_of_ipopt_after_few_iterations(
    step: NativeStep, car: Car, weights: Weights, circuit: Circuit
) -> None:
    """From the plan that drives; the feet on the line stay where they are."""
    exact = EXACT.model_copy(update={"iterations": 100, "tolerance": 1e-8})
    f = corrected_function(e_kinematic(car), PREDICTION, weights)
    ocp = OcpNlp(problem_of(PROGRESS), f, HORIZON, options=TIGHT_IPOPT | FROM_OUR_PLAN)
    plant, values = discrete(dynamic(car)), exact.parameters(car, "progress")
    x, d, iterations = circuit.start(), 0.0, list[int]()
    for k in range(120):
        assert step.step(x, d).usable
        u = step.u.copy()
        if k % 10 == 9:
            reference = step.read_reference()
            step.set_parameters(car, exact)
            status = step.solve(x, d, reference, elapsed_s=0.0)
            assert status.usable
            if status is Status.CONVERGED:
                iterations.append(step.info.iterations)
                plan = step.read_plan()
                oracle = ocp.solve(x, d, reference, values, plan)
                assert oracle.success, oracle.status
                np.testing.assert_allclose(plan[1], oracle.u, rtol=0, atol=1e-4)
                assert step.info.cost == pytest.approx(oracle.cost, rel=1e-6, abs=1e-8)
            step.set_parameters(car, MpcSettings())
        d, x = float(u[0]), plant(x, u)
    assert len(iterations) >= 10  # of 12
    assert np.median(iterations) <= 5


def time_on_line(table: PathTable, xy: Floats) -> float:
    """What the line takes from its first row to the foot of a point."""
    s, _ = nearest(table, xy)
    speed = np.append(table.rows[:, 2], table.rows[0, 2])
    at = np.arange(len(speed)) * table.spacing_m
    slope = np.diff(speed) / table.spacing_m
    time = table.spacing_m / speed[:-1]
    curved = np.abs(slope) > 1e-12
    time[curved] = np.log(speed[1:][curved] / speed[:-1][curved]) / slope[curved]
    return float(np.interp(s, at, np.append(0, np.cumsum(time))))


def test_the_reference_is_where_the_plan_is_on_the_line(
    artefact: Path, car: Car, weights: Weights, circuit: Circuit
) -> None:
    """Once converged, the feet are those of the plan that is returned."""
    many = SETTINGS.model_copy(update={"iterations": 200, "iterations_cold": 200})
    step = ready(artefact, car, weights, circuit, many)
    table, names = circuit.table, step.manifest.problem.stage_parameters
    x, d = circuit.start(v_mps=1.0), 0.0
    for _ in range(5):
        assert step.step(x, d).usable
    reference = {name: step.read_reference()[:, i] for i, name in enumerate(names)}
    plan = step.read_plan()[0][1:]
    assert (reference["follows"] == 1).all()
    for k in range(0, HORIZON, 3):
        s, _ = nearest(table, plan[k, :2])
        foot = nearest(table, np.array([reference["x"][k], reference["y"][k]]))
        assert abs(foot[1]) < 1e-4
        assert foot[0] == pytest.approx(s, abs=5e-3)
        pace = np.array([reference["pace_x"][k], reference["pace_y"][k]])
        for way in np.eye(2):
            ahead, behind = (
                time_on_line(table, plan[k, :2] + sign * 0.01 * way) for sign in (1, -1)
            )
            assert pace @ way == pytest.approx((ahead - behind) / 0.02, abs=0.06 * np.hypot(*pace))


def test_bounds_are_nearer_where_the_edge_turns_between_stages(
    artefact: Path, car: Car, weights: Weights, circuit: Circuit
) -> None:
    """By the height of the arc over the chord between two stages, inside the bend alone."""
    many = SETTINGS.model_copy(update={"iterations": 200, "iterations_cold": 200})
    step, plant = ready(artefact, car, weights, circuit, many), discrete(dynamic(car))
    table, names = circuit.table, step.manifest.problem.stage_parameters
    x, d, nearer = circuit.start(v_mps=1.0), 0.0, list[float]()
    for _ in range(60):
        assert step.step(x, d).usable
        reference = {name: step.read_reference()[:, i] for i, name in enumerate(names)}
        turn = np.diff(np.unwrap(np.arctan2(reference["normal_y"], reference["normal_x"])))
        feet = np.column_stack([reference["x"], reference["y"]])
        at = np.array([nearest(table, xy)[0] for xy in feet]) / table.spacing_m
        rows = [np.interp(at, np.arange(len(table.rows)), column) for column in table.rows.T]
        lower, upper = (bound / np.hypot(rows[3], rows[4]) for bound in rows[5:])
        left, right = upper - reference["upper"], reference["lower"] - lower
        way_m = np.linalg.norm(np.diff(step.read_plan()[0][:, :2], axis=0), axis=1)
        arc_m = way_m[1:-1] * (turn[:-1] + turn[1:]) / 2 / 8
        np.testing.assert_allclose((left - right)[1:-1], arc_m, atol=1e-4)
        assert (np.minimum(left, right) < 1e-4).all()
        nearer.append(float(np.abs(arc_m).max()))
        d, x = float(step.u[0]), plant(x, step.u)
    assert max(nearer) > 1e-3


def another_path(step: NativeStep, circuit: Circuit, _: Car) -> None:
    line = offset_line(circuit.track, -0.05, 4.0, 2.0)
    step.set_path(make_path_table(circuit.track, line, circuit.table.spacing_m))


@pytest.mark.parametrize(
    "between", [lambda *_: None, another_path, BETWEEN["other weights"], BETWEEN["reset"]],
    ids=["nothing", "another path", "other weights", "reset"],
)  # fmt: skip
def test_prepared_steps_are_the_same_to_the_bit(
    artefact: Path, car: Car, weights: Weights, circuit: Circuit, between: Between
) -> None:
    """Whatever happens between a preparation and its step; a stop, too."""
    prepared, plain = (ready(artefact, car, weights, circuit, MpcSettings()) for _ in range(2))
    plant = discrete(dynamic(car))
    x, d = circuit.start(), 0.0
    for k in range(60):
        if k == 20:
            between(prepared, circuit, car)
            between(plain, circuit, car)
        slow = Environment(1.0, 1.5) if 30 <= k < 40 else NO_LIMITS
        assert prepared.step(x, d, environment=slow) is plain.step(x, d, environment=slow)
        assert result(prepared) == result(plain)
        prepared.prepare()
        assert prepared.read_reference().tobytes() == plain.read_reference().tobytes()
        d, x = float(plain.u[0]), plant(x, plain.u)


def test_a_car_that_is_measured_elsewhere_is_sought_there_whatever_was_prepared(
    artefact: Path, car: Car, weights: Weights, circuit: Circuit
) -> None:
    """At the other side of the waist, for a cycle: nearer to the plan than what lies between."""
    prepared, plain = (ready(artefact, car, weights, circuit, MpcSettings()) for _ in range(2))
    plant, quarter_m = discrete(dynamic(car)), circuit.line.length_m / 4
    x, d = circuit.start(0.8 * quarter_m), 0.0
    for k in range(24):
        measured = circuit.start(3 * quarter_m) if k in (12, 18) else x
        assert prepared.step(measured, d) is plain.step(measured, d)
        assert result(prepared) == result(plain)
        assert prepared.read_reference().tobytes() == plain.read_reference().tobytes()
        prepared.prepare()
        d, x = float(plain.u[0]), plant(x, plain.u)


def test_a_budget_looks_for_no_other_plan(
    artefact: Path, car: Car, weights: Weights, circuit: Circuit
) -> None:
    """The costs of two plans do not compare: each counts from its own feet on the line."""
    settings = MpcSettings(iterations=4, iterations_cold=4, caution=0.0)  # it follows throughout
    step, plant = ready(artefact, car, weights, circuit, settings), discrete(dynamic(car))
    Clock(step, 1e-6)
    x, d, iterations = circuit.start(), 0.0, []
    for _ in range(40):
        step.step(x, d, budget_s=1.0)
        iterations.append(step.info.prepared_iterations)
        step.prepare(budget_s=1.0)
        d, x = float(step.u[0]), plant(x, step.u)
    assert 0 < max(iterations) <= 4


def test_what_is_prepared_knows_whether_the_plan_follows(
    artefact: Path, car: Car, weights: Weights, circuit: Circuit
) -> None:
    """Where caution slows the car down, the reference is another one from a step to the next."""
    step = ready(artefact, car, weights, circuit, MpcSettings())
    plant = discrete(dynamic(car))
    Clock(step, 1e-6)
    x, d, paces, iterations = circuit.start(), 0.0, [1.0], list[int]()
    for _ in range(400):
        assert step.step(x, d).usable
        paces.append(step.info.pace)
        iterations.append(step.info.iterations)
        step.prepare(budget_s=1.0)
        d, x = float(step.u[0]), plant(x, step.u)
    slowed = np.array(paces[:-1]) < 1
    switches = slowed[1:] != slowed[:-1]
    assert switches.sum() > 10
    assert np.array(iterations)[1:][switches].max() <= 4  # of up to 7 where it is not foreseen


def test_a_stop_brakes_to_standstill(step: NativeStep, car: Car, circuit: Circuit) -> None:
    plant = discrete(dynamic(car))
    x, d, limit = circuit.start(v_mps=1.5), 0.0, math.inf
    for k in range(150):
        limit = math.inf if k < 30 else max(0.0, min(limit, float(x[3])) - 1.5 * 0.02)
        environment = Environment(speed_limit_mps=limit, speed_limit_rate_mps2=1.5)
        assert step.step(x, d, environment=environment).usable
        d, x = float(step.u[0]), plant(x, step.u)
        if k == 29:
            assert x[3] > 1.0
    assert x[3] < 0.15


def test_a_car_that_points_aside_sets_off_at_once(
    step: NativeStep, car: Car, circuit: Circuit
) -> None:
    """Tracking turns it round at a walking pace first."""
    plant = discrete(dynamic(car))
    x, d = circuit.start(v_mps=0.1), 0.0
    x[2] += 1.2
    for _ in range(25):
        assert step.step(x, d).usable
        d, x = float(step.u[0]), plant(x, step.u)
    assert x[3] > 0.8


def test_a_car_that_points_back_turns_and_drives_on(
    step: NativeStep, car: Car, circuit: Circuit
) -> None:
    plant = discrete(dynamic(car))
    x, d, turned, fastest_mps = circuit.start(v_mps=0.1), 0.0, False, 0.0
    x[2] += math.pi
    for _ in range(150):
        assert step.step(x, d).usable
        follows = step.read_reference()[:, 6]
        turned |= bool((follows == 0).all())
        d, x = float(step.u[0]), plant(x, step.u)
        if turned and (follows == 1).all():
            fastest_mps = max(fastest_mps, x[3])
    assert turned
    assert fastest_mps > 2.0  # it goes on to slide, and may follow its line for that: not judged
    assert x[3] > 0.8
