"""A second control problem, which shares no size with that of the race car.

A craft with three inputs flies round an obstacle and must not get too hot: a soft constraint that
is not convex, a soft and a hard one that are linear, a terminal cost, and a residual of two outputs
over four features. Nothing in controller/native is written for it.
"""

import struct
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from bayesrace.arrays import Floats
from bayesrace.codegen.build import build
from bayesrace.codegen.ocp import OcpNlp
from bayesrace.codegen.problems.problem import (
    NO_BOUND,
    Input,
    Parameter,
    Problem,
    Row,
    State,
    Symbols,
    linearised,
)
from bayesrace.codegen.settings import BuildSettings
from bayesrace.controller.native_step import NativeProblem, Status
from bayesrace.errors import InputError
from bayesrace.integrators import Discretisation

HORIZON, STEP_S, CAPACITY = 12, 0.15, 24
VALUES = {
    "q": 1.0, "q_end": 4.0, "r": 0.05, "r_change": 0.02, "r_fan": 0.1, "w_obstacle": 200.0,
    "w_lane": 60.0, "lane": 0.55, "a_max": 3.0, "heat_max": 0.5,
    "tolerance": 1e-9, "defect_max": 0.03, "early_stop_tol": 0.0,
    "iterations": 80, "iterations_cold": 80, "qp_steps": 100_000,
}  # fmt: skip
IPOPT = {
    "tol": 1e-11, "constr_viol_tol": 1e-11, "compl_inf_tol": 1e-13, "bound_relax_factor": 0.0,
    "mu_init": 1e-9, "bound_push": 1e-12, "bound_frac": 1e-12, "slack_bound_push": 1e-12,
    "slack_bound_frac": 1e-12,
}  # fmt: skip


def dynamics(x: ca.SX, u: ca.SX, e: ca.SX, h: ca.SX) -> ca.SX:
    """Semi-implicit steps of drag, acceleration and heat; e is added to the velocities."""
    v = x[2:4] + h * (u[:2] - 0.3 * ca.sqrt(ca.sumsqr(x[2:4]) + 0.01) * x[2:4]) + e
    heat = x[4] + h * (0.1 * ca.sumsqr(u[:2]) - 0.4 * (0.2 + u[2]) * x[4])
    return ca.vertcat(x[:2] + h * v, v, heat)


def craft() -> Problem:
    parameters = tuple(
        Parameter(name, "1", positive=name not in ("w_obstacle", "w_lane"), low=0.0)
        for name in list(VALUES)[:10]
    )
    stage_parameters = tuple(Parameter(n, "m") for n in ("x_ref", "y_ref", "x_o", "y_o", "radius"))
    s = Symbols.of(5, 3, 5, 10)
    q, q_end, r, r_change, r_fan, w_obstacle, w_lane, lane, a_max, heat_max = ca.vertsplit(s.theta)
    x_ref, y_ref, x_o, y_o, radius = ca.vertsplit(s.p)
    e = ca.SX.sym("e", 2)
    f = ca.Function("craft", [s.x, s.u, e], [dynamics(s.x, s.u, e, ca.SX(STEP_S))])
    advanced = dynamics(s.x, s.u, e, s.h)
    error = (s.x[0] - x_ref) ** 2 + (s.x[1] - y_ref) ** 2
    return Problem(
        name="craft",
        states=tuple(State(n, "1") for n in ("x", "y", "vx", "vy", "heat")),
        inputs=(Input("ax", "m/s2"), Input("ay", "m/s2"), Input("fan", "1", held=False)),
        stage_parameters=stage_parameters,
        parameters=parameters,
        features=("vx", "vy", "ax", "ay"),
        outputs=2,
        symbols=s,
        f=f,
        linearise=linearised(f),
        advance=ca.Function("br_advance", [s.x, s.u, e, s.h], [advanced]),
        cost=q * error + r * ca.sumsqr(s.u[:2]) + r_fan * s.u[2] ** 2
        + r_change * ca.sumsqr(s.u[:2] - s.u_before[:2]) + s.last * q_end * ca.sumsqr(s.x[2:4]),
        rows=(
            Row("heat", s.x[4], -NO_BOUND, heat_max),
            Row("lane", s.x[1], -lane, lane, penalty=w_lane),
            Row(
                "obstacle", (s.x[0] - x_o) ** 2 + (s.x[1] - y_o) ** 2, radius**2, NO_BOUND,
                penalty=w_obstacle,
            ),
        ),
        u_lower=ca.vertcat(-a_max, -a_max, 0),
        u_upper=ca.vertcat(a_max, a_max, 1),
        guess=ca.vertcat(s.share * a_max / 4, 0, 0),
        acting=ca.vertcat(ca.fmin(ca.fmax(s.u[:2], -a_max), a_max), ca.fmin(ca.fmax(s.u[2], 0), 1)),
        reached=s.x,
        valid=a_max,
    )  # fmt: skip


def residual(seed: int = 3) -> list[dict[str, Floats]]:
    """Two Gaussian processes of other sizes, so small that they only bend the motion."""
    random = np.random.default_rng(seed)
    return [
        {
            "length_scales": random.uniform(1.0, 2.0, 4),
            "inputs": random.uniform(-1.5, 1.5, (count, 4)),
            "alpha": 0.02 * random.normal(size=count),
        }
        for count in (CAPACITY, 10)
    ]


def corrected(problem: Problem) -> ca.Function:
    """The model with that residual, by the textbook's formula (squared exponential)."""
    x, u = ca.MX.sym("x", 5), ca.MX.sym("u", 3)
    z = ca.vertcat(x[2:4], u[:2])
    means = []
    for one in residual():
        mean = ca.MX(0)
        for row, alpha in zip(one["inputs"], one["alpha"], strict=True):
            mean += alpha * ca.exp(-0.5 * ca.sumsqr((z - row) / one["length_scales"]))
        means.append(mean)
    return ca.Function("corrected", [x, u], [problem.f(x, u, ca.vertcat(*means))])


@pytest.fixture(scope="module")
def problem() -> Problem:
    return craft()


@pytest.fixture(scope="module")
def native(problem: Problem) -> NativeProblem:
    """The compiled problem with its residual."""
    return compiled(problem)


def compiled(problem: Problem, **blocks: int) -> NativeProblem:
    settings = BuildSettings(
        discretisation=Discretisation(step_s=STEP_S),
        horizon=HORIZON,
        gp_capacity=CAPACITY,
        **blocks,
    )
    step = NativeProblem(build(settings, problem=problem)[0])
    step.set_values(VALUES)
    packed = b""
    for one in residual():
        packed += struct.pack("<II4d", 0, len(one["alpha"]), 0.0, 1.0, 0.0, 0.0)
        packed += b"".join(one[name].tobytes() for name in ("length_scales", "inputs", "alpha"))
    step.stage_weights(packed)
    step.adopt_weights()
    return step


def stages(k: int) -> Floats:
    """The target moves along a line past the obstacle."""
    t = (k + 1 + np.arange(HORIZON)) * STEP_S
    rows = [0.9 * t - 1.0, 0 * t, 0.2 + 0 * t, 0.1 + 0 * t, 0.4 + 0 * t]
    return np.column_stack(rows)


def test_the_derivatives_are_those_of_the_model(native: NativeProblem, problem: Problem) -> None:
    f = corrected(problem)
    x, u, lam = ca.MX.sym("x", 5), ca.MX.sym("u", 3), ca.MX.sym("lam", 5)
    v = ca.vertcat(x, u)
    value = f(x, u)
    hessian = ca.hessian(ca.dot(lam, value), v)[0]
    oracle = ca.Function("o", [x, u, lam], [value, ca.jacobian(value, v), hessian])
    random = np.random.default_rng(0)
    for _ in range(5):
        point, costate = random.uniform(-1, 1, 8), random.normal(size=5)
        found = native.evaluate(point, costate)
        for ours, theirs in zip(found, oracle(point[:5], point[5:], costate), strict=True):
            shape = np.asarray(ours).shape
            np.testing.assert_allclose(ours, theirs.full().reshape(shape), rtol=0, atol=1e-12)


def note_active(active: dict[str, int], plan_x: Floats, plan_u: Floats) -> None:
    """Counts the limits that a plan touches."""
    distance = np.hypot(plan_x[1:, 0] - 0.2, plan_x[1:, 1] - 0.1)
    active["obstacle"] += bool(distance.min() < 0.4 - 1e-6)
    active["hard"] += bool(plan_x[1:, 4].max() > 0.5 - 1e-8)
    active["lane"] += bool(np.abs(plan_x[1:, 1]).max() > VALUES["lane"] + 1e-6)
    active["input"] += bool(np.abs(plan_u[:, :2]).max() > VALUES["a_max"] - 1e-8)


def test_it_solves_to_the_solution_of_ipopt_along_a_flight(
    native: NativeProblem, problem: Problem
) -> None:
    ocp = OcpNlp(problem, corrected(problem), HORIZON, options=IPOPT)
    native.reset()
    x, u = np.array([-1.3, -0.9, 0.5, -0.6, 0.3]), np.zeros(3)
    converged, closest, active = 0, np.inf, {"hard": 0, "lane": 0, "input": 0, "obstacle": 0}
    for k in range(24):
        reference = stages(k)
        status = native.solve(x, u, reference)
        assert status.usable
        converged += status is Status.CONVERGED
        plan_x, plan_u = (part.copy() for part in native.read_plan())
        oracle = ocp.solve(x, u, reference, VALUES, (plan_x, plan_u))
        assert oracle.success, oracle.status
        np.testing.assert_allclose(plan_u, oracle.u, rtol=0, atol=1e-6)
        np.testing.assert_allclose(plan_x, oracle.x, rtol=0, atol=1e-6)
        assert native.info.cost == pytest.approx(oracle.cost, rel=1e-8)
        note_active(active, plan_x, plan_u)
        u = native.u.copy()
        native.prepare()
        x = native.predict(x, u, STEP_S)
        closest = min(closest, float(np.hypot(x[0] - 0.2, x[1] - 0.1)))
    assert converged == 24
    assert 0.3 < closest < 0.5  # it has flown round the obstacle, close by
    assert active["obstacle"] > 3
    assert active["hard"] > 3
    assert active["lane"] > 3
    assert active["input"] > 0


def assert_preparation_changes_no_bit(native: NativeProblem, start: Floats) -> None:
    plans = []
    for prepares in (False, True):
        native.reset()
        x, u = start, np.zeros(3)
        for k in range(8):
            assert native.solve(x, u, stages(k)).usable
            u = native.u.copy()
            if prepares:
                native.prepare()
                native.rehearse()
            x = native.predict(x, u, STEP_S)
        plans.append([part.tobytes() for part in native.read_plan()])
    assert plans[0] == plans[1]


def test_the_preparation_changes_no_bit(native: NativeProblem) -> None:
    assert_preparation_changes_no_bit(native, np.array([-1.3, 0.0, 0.8, 0.0, 0.3]))


def test_a_soft_row_without_penalty_is_off(native: NativeProblem) -> None:
    x = np.array([-0.6, 0.1, 0.8, 0.0, 0.1])
    kept = {}
    for weight in (VALUES["w_obstacle"], 0.0):
        native.set_values({"w_obstacle": weight})
        native.reset()
        assert native.solve(x, np.zeros(3), stages(4)).usable
        plan = native.read_plan()[0]
        kept[weight] = float(np.hypot(plan[:, 0] - 0.2, plan[:, 1] - 0.1).min())
    native.set_values({"w_obstacle": VALUES["w_obstacle"]})
    assert native.solve(x, np.zeros(3), stages(4)).usable  # from the plan through the obstacle
    native.set_values({"w_obstacle": 0.0})
    assert native.solve(x, np.zeros(3), stages(4)).usable  # and back, without a reset
    plan = native.read_plan()[0]
    assert np.hypot(plan[:, 0] - 0.2, plan[:, 1] - 0.1).min() < 0.3
    native.set_values({"w_obstacle": VALUES["w_obstacle"]})
    assert kept[0.0] < 0.3 < kept[VALUES["w_obstacle"]]


def test_parameters_outside_their_limits_and_unknown_ones_are_refused(
    native: NativeProblem,
) -> None:
    for bad in ({"q": 0.0}, {"w_lane": -1.0}, {"a_max": np.nan}, {"iterations": 0}):
        with pytest.raises(InputError, match="a parameter is not finite or out of its range"):
            native.set_values(bad)
        native.set_values({name: VALUES[name] for name in bad})
    with pytest.raises(InputError, match="problem 'craft' has no parameter speed; it has"):
        native.set_values({"speed": 1.0})
    with pytest.raises(InputError, match=r"reference has shape \(12, 4\), not \(12, 5\)"):
        native.solve(np.zeros(5), np.zeros(3), np.zeros((12, 4)))
    with pytest.raises(InputError, match="parameters or path have not been set"):
        native.step(np.zeros(5), np.zeros(3))


def test_a_description_that_c_could_not_follow_is_refused(problem: Problem) -> None:
    s = problem.symbols
    with pytest.raises(ValueError, match="the cost couples states with inputs"):
        replace(problem, cost=problem.cost + s.x[0] * s.u[0])
    with pytest.raises(ValueError, match="row 'wrong' depends on what it must not"):
        replace(problem, rows=(Row("wrong", s.u[0], -1, 1),))
    with pytest.raises(ValueError, match="row 'round' is not linear: give it a penalty"):
        replace(problem, rows=(Row("round", s.x[0] ** 2, -1, 1),))
    with pytest.raises(ValueError, match="rows with constant gradients come first"):
        replace(problem, rows=problem.rows[::-1])
    with pytest.raises(ValueError, match="'a b' names no parameter, or more than one"):
        replace(problem, parameters=(Parameter("a b", "1"),))
    with pytest.raises(ValueError, match="a stage needs at least one parameter"):
        replace(problem, stage_parameters=())
    with pytest.raises(ValueError, match="has no state or input"):
        replace(problem, features=("speed",))


def test_second_derivatives_that_depend_on_the_stage_are_those_of_the_step(
    problem: Problem,
) -> None:
    """A cost whose curvature only the step knows: the preparation must not use an older one."""
    s = problem.symbols
    change = s.u[2] - s.u_before[2]
    error = (s.x[0] - s.p[0]) ** 2
    late = replace(
        problem, name="late", cost=problem.cost + 0.1 * change**4 + 0.5 * ca.sqrt(1 + error)
    )
    step = compiled(late)
    ocp = OcpNlp(late, corrected(late), HORIZON, options=IPOPT)
    plans = []
    for prepares in (False, True):
        step.reset()
        x, u = np.array([-1.3, 0.0, 0.8, 0.0, 0.3]), np.zeros(3)
        for k in range(6):
            assert step.solve(x, u, stages(k)).usable
            plan = step.read_plan()[0].copy()
            oracle = ocp.solve(x, u, stages(k), VALUES, (plan, step.plan_u))
            np.testing.assert_allclose(plan, oracle.x, rtol=0, atol=1e-6)
            u = step.u.copy()
            if prepares:
                step.prepare()
                step.rehearse()
            x = step.predict(x, u, STEP_S)
        plans.append(plan.tobytes())
    assert plans[0] == plans[1]
