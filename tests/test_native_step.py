"""The compiled SQP step: IPOPT's solution, honest residuals, symmetry, determinism."""

from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import lsq_linear

from bayesrace.arrays import Floats
from bayesrace.codegen.build import problem_of
from bayesrace.codegen.ocp import OcpNlp
from bayesrace.codegen.settings import BuildSettings
from bayesrace.controller.assembly import make_path_table
from bayesrace.controller.native_step import NativeStep, Status
from bayesrace.controller.settings import MpcSettings
from bayesrace.gp.expression import corrected_function
from bayesrace.gp.weights import Weights
from bayesrace.integrators import PERFECT, PREDICTION
from bayesrace.vehicles import Car, default_car
from bayesrace.vehicles.models import dynamic, e_kinematic
from tests.conftest import (
    MIRROR_INPUT,
    SETTINGS,
    Circuit,
    Make,
    Problem,
    drive,
    mirrored_line,
    mirrored_weights,
)

MANY = {"iterations": 60, "iterations_cold": 60, "tolerance": 1e-11}
EXACT = SETTINGS.model_copy(update=MANY)
TIGHT_IPOPT = {
    "tol": 1e-12,
    "constr_viol_tol": 1e-12,
    "compl_inf_tol": 1e-15,  # its barrier pushes weakly active bounds inwards
    "bound_relax_factor": 0.0,
}
FROM_OUR_PLAN = {
    "mu_init": 1e-9,
    "bound_push": 1e-12,
    "bound_frac": 1e-12,
    "slack_bound_push": 1e-12,
    "slack_bound_frac": 1e-12,
}
AT_BOUND = 1e-8
E_KINEMATIC = BuildSettings()


def solved(step: NativeStep, problem: Problem) -> tuple[Status, Floats, Floats]:
    """Status and plan of a solution from cold."""
    step.reset()
    status = step.solve(problem.x0, problem.d_previous, problem.reference)
    x, u = step.read_plan()
    return status, x.copy(), u.copy()


@pytest.fixture
def exact(make: Make) -> NativeStep:
    return make(**MANY)


@pytest.fixture(scope="module")
def corrected(car: Car, weights: Weights) -> ca.Function:
    return corrected_function(e_kinematic(car), PREDICTION, weights)


def active(problem: Problem, x: Floats, u: Floats, car: Car) -> dict[str, bool]:
    """Which kinds of limit bind in a plan."""
    ref = problem.reference
    along = np.sum(ref[:, 2:4] * x[1:, :2], axis=1)
    return {
        "slack": bool(np.maximum(along - ref[:, 5], ref[:, 4] - along).max() > 1e-6),
        "duty": bool(np.min([u[:, 0] - car.d_min, car.d_max - u[:, 0]]) < AT_BOUND),
        "rate": bool(np.abs(u[:, 1]).max() > car.delta_rate_max_radps - AT_BOUND),
        "angle": bool(np.abs(x[1:, 6]).max() > car.delta_max_rad - AT_BOUND),
    }


def test_the_converged_step_is_the_solution_of_ipopt(
    exact: NativeStep, corrected: ca.Function, recorded: list[Problem], car: Car
) -> None:
    ocp = OcpNlp(problem_of(E_KINEMATIC), corrected, 20, options=TIGHT_IPOPT | FROM_OUR_PLAN)
    kinds: dict[str, int] = {}
    for problem in recorded[::12]:
        status, x, u = solved(exact, problem)
        assert status is Status.CONVERGED
        oracle = ocp.solve(
            problem.x0, problem.d_previous, problem.reference, EXACT.parameters(car), (x, u)
        )
        assert oracle.success, oracle.status
        np.testing.assert_allclose(u, oracle.u, rtol=0, atol=1e-6)
        np.testing.assert_allclose(x, oracle.x, rtol=0, atol=1e-6)
        assert exact.info.cost == pytest.approx(oracle.cost, rel=1e-7, abs=1e-9)
        for kind, binds in active(problem, x, u, car).items():
            kinds[kind] = kinds.get(kind, 0) + binds
    # the comparison means little unless every kind of limit binds somewhere
    assert all(count >= 2 for count in kinds.values()), kinds


def test_nearly_every_problem_converges_from_cold(
    exact: NativeStep, recorded: list[Problem]
) -> None:
    """Where the exact Hessian is indefinite, convergence is linear and may take too long."""
    statuses = [solved(exact, problem)[0] for problem in recorded]
    assert all(status.usable for status in statuses)
    assert statuses.count(Status.CONVERGED) >= 0.95 * len(statuses)


@pytest.mark.check
def test_the_cost_is_no_worse_than_that_of_ipopt_from_its_own_start(
    exact: NativeStep, corrected: ca.Function, recorded: list[Problem], car: Car
) -> None:
    options = TIGHT_IPOPT | {"max_iter": 300}
    ocp = OcpNlp(problem_of(E_KINEMATIC), corrected, 20, options=options)
    same = 0
    for problem in recorded[5::15]:
        status, _, u = solved(exact, problem)
        if status is not Status.CONVERGED:
            continue  # their share is bounded below
        oracle = ocp.solve(problem.x0, problem.d_previous, problem.reference, EXACT.parameters(car))
        if not oracle.success or np.abs(oracle.u - u).max() > 0.05:
            continue  # another basin
        same += 1
        assert exact.info.cost <= oracle.cost + 1e-6
    assert same >= 10


def test_the_converged_best_case_step_is_the_solution_of_ipopt(
    dynamic_artefact: Path, car: Car, circuit: Circuit
) -> None:
    """The dynamic model with ten sub-steps, whose derivatives are composed by the chain rule."""
    step = NativeStep(dynamic_artefact, car, SETTINGS)
    step.set_path(circuit.table)
    problems, _ = drive(step, circuit, 120)
    step.set_parameters(car, EXACT)
    f = PERFECT.discretise(dynamic(car))
    ocp = OcpNlp(problem_of(BuildSettings.best_case()), f, 20, options=TIGHT_IPOPT | FROM_OUR_PLAN)
    for problem in problems[::30]:
        status, x, u = solved(step, problem)
        assert status is Status.CONVERGED
        oracle = ocp.solve(
            problem.x0, problem.d_previous, problem.reference, EXACT.parameters(car), (x, u)
        )
        assert oracle.success, oracle.status
        np.testing.assert_allclose(u, oracle.u, rtol=0, atol=1e-6)


# --- residuals, recomputed from the plan alone -------------------------------------------------


def objective(problem: Problem, x: Floats, u: Floats, s: dict[str, float]) -> tuple[float, float]:
    """Equation (8) at a plan in plain numpy: cost and largest slack."""
    ref = problem.reference
    along = np.sum(ref[:, 2:4] * x[1:, :2], axis=1)
    over = np.maximum(along - ref[:, 5] + s["margin_m"], ref[:, 4] + s["margin_m"] - along)
    slack = np.maximum(0.0, over)
    change = np.diff(np.r_[problem.d_previous, u[:, 0]])
    cost = s["q_position"] * np.sum((x[1:, :2] - ref[:, :2]) ** 2) + s["r_duty"] * np.sum(change**2)
    cost += s["r_delta_rate"] * np.sum(u[:, 1] ** 2) + s["s_slack"] * np.sum(slack**2)
    return float(cost), float(slack.max())


def stationarity_at_least(
    problem: Problem,
    x: Floats,
    u: Floats,
    f: ca.Function,
    settings: MpcSettings,
    car: Car,
) -> float:
    """Norm of the Lagrangian's gradient in the inputs for the *best* multipliers.

    Costates by the adjoint recursion with CasADi's Jacobian; the multipliers of active bounds
    with their proper signs by least squares.
    """
    n, ref, s = len(u), problem.reference, settings.parameters(car)
    jacobian = f.factory("partials", ["x", "u"], ["jac:x_next:x", "jac:x_next:u"])
    along = np.sum(ref[:, 2:4] * x[1:, :2], axis=1)
    over, under = along - ref[:, 5] + s["margin_m"], ref[:, 4] + s["margin_m"] - along
    push = 2 * s["s_slack"] * (np.maximum(0, over) - np.maximum(0, under))
    change = np.r_[np.diff(np.r_[problem.d_previous, u[:, 0]]), 0.0]
    gradient, p = np.zeros((n, 2)), np.zeros(7)
    rows: list[tuple[Floats, float]] = []
    for k in range(n, 0, -1):
        p[:2] += 2 * s["q_position"] * (x[k, :2] - ref[k - 1, :2]) + push[k - 1] * ref[k - 1, 2:4]
        a, b = (np.asarray(ca.densify(m)) for m in jacobian(x[k - 1], u[k - 1]))
        own = [2 * s["r_duty"] * (change[k - 1] - change[k]), 2 * s["r_delta_rate"] * u[k - 1, 1]]
        gradient[k - 1] = own + b.T @ p
        p = a.T @ p
        if abs(x[k, 6]) > car.delta_max_rad - AT_BOUND:  # delta_k = delta_0 + Ts sum of rates
            row = np.zeros((n, 2))
            row[:k, 1] = PREDICTION.step_s
            rows.append((row.ravel(), np.sign(x[k, 6])))
    for c, low, high in ((0, car.d_min, car.d_max), (1, -5.0, 5.0)):
        for k in range(n):
            row = np.zeros((n, 2))
            row[k, c] = 1.0
            for bound, side in ((low, -1.0), (high, 1.0)):
                if abs(u[k, c] - bound) < AT_BOUND:
                    rows.append((row.ravel(), side))
    if not rows:
        return float(np.linalg.norm(gradient))
    matrix = np.column_stack([side * row for row, side in rows])
    fit = lsq_linear(matrix, -gradient.ravel(), (0, np.inf), tol=1e-14)
    return float(np.linalg.norm(matrix @ fit.x + gradient.ravel()))


def check_residuals(
    step: NativeStep, problem: Problem, f: ca.Function, s: MpcSettings, car: Car
) -> float:
    """Asserts that info describes the plan; returns the independent stationarity."""
    x, u, info = step.plan_x, step.plan_u, step.info
    predicted = np.asarray(f(x[:-1].T, u.T)).T
    scale = np.array([1, 1, 1, 1, 1, 10, 1])
    defect = max(np.abs((predicted - x[1:]) / scale).max(), np.abs(x[0] - problem.x0).max())
    assert info.defect == pytest.approx(defect, rel=1e-9, abs=1e-13)
    beyond = max(
        np.max(u[:, 0] - car.d_max),
        np.max(car.d_min - u[:, 0]),
        np.max(np.abs(u[:, 1])) - car.delta_rate_max_radps,
        np.max(np.abs(x[1:, 6])) - car.delta_max_rad,
        0.0,
    )
    assert info.bound == pytest.approx(beyond, abs=1e-15)
    cost, slack = objective(problem, x, u, s.parameters(car))
    assert info.cost == pytest.approx(cost, rel=1e-10)
    assert info.slack_max_m == pytest.approx(slack, abs=1e-14)
    return stationarity_at_least(problem, x, u, f, s, car)


def test_residuals_of_converged_plans_are_true(
    exact: NativeStep, corrected: ca.Function, recorded: list[Problem], car: Car
) -> None:
    for problem in recorded[3::25]:
        assert solved(exact, problem)[0] is Status.CONVERGED
        assert check_residuals(exact, problem, corrected, EXACT, car) < 1e-8
        assert exact.info.bound < 1e-9


def test_residuals_of_real_time_steps_are_true(
    native: NativeStep, corrected: ca.Function, recorded: list[Problem], car: Car
) -> None:
    """One iteration a step: not stationary, and the step says so, never less than the truth."""
    native.reset()
    for k, problem in enumerate(recorded[:200]):
        status = native.solve(problem.x0, problem.d_previous, problem.reference)
        assert status.usable
        if k % 10:
            continue
        native.read_plan()
        best = check_residuals(native, problem, corrected, SETTINGS, car)
        size = max(1.0, *np.abs(native.plan_u).ravel())  # of gradients: far below 1 here
        if native.info.shortened == 0:
            assert best <= np.sqrt(40) * native.info.stationarity * size + 1e-10
        converged = max(native.info.stationarity, native.info.defect) <= SETTINGS.tolerance
        assert (status is Status.CONVERGED) == converged


@pytest.mark.parametrize(
    ("settings", "track"),
    [
        ({"constraints": False}, (0, 0, 0, 0, -100, 100)),
        ({"margin_m": 0.03}, (0, 0, 0, 0, 0.03, -0.03)),
    ],
    ids=["none is a very wide one", "margin"],
)
def test_a_setting_moves_the_tracks_edges(
    make: Make,
    exact: NativeStep,
    recorded: list[Problem],
    settings: dict[str, float],
    track: tuple[float, ...],
) -> None:
    other = make(**(MANY | settings))
    for problem in recorded[::50]:
        moved = replace(problem, reference=problem.reference + np.array(track))
        _, _, expected = solved(exact, moved)
        _, _, u = solved(other, problem)
        np.testing.assert_allclose(u, expected, rtol=0, atol=1e-8)
        assert other.info.slack_max_m == 0 or "margin_m" in settings


# --- symmetry and determinism ------------------------------------------------------------------


def test_a_mirrored_track_gives_mirrored_laps(
    make: Make, native: NativeStep, weights: Weights, circuit: Circuit
) -> None:
    track, line = circuit.track.mirrored(), mirrored_line(circuit.line)
    mirror = Circuit(track, line, make_path_table(track, line, default_car().tuning.path.spacing_m))
    other = make(mirrored_weights(weights))
    other.set_path(mirror.table)
    _, inputs = drive(native, circuit, 150)
    _, mirrored = drive(other, mirror, 150)
    np.testing.assert_allclose(mirrored * MIRROR_INPUT, inputs, rtol=0, atol=1e-6)


def test_another_controller_and_one_that_is_reset_give_the_same_bits(
    make: Make, native: NativeStep, circuit: Circuit
) -> None:
    first = drive(native, circuit, 60)[1]
    native.reset()
    for again in (make(), native):
        assert drive(again, circuit, 60)[1].tobytes() == first.tobytes()
