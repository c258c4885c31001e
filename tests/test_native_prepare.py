"""The preparation phase: saves the step time, and changes nothing else."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from bayesrace.arrays import Floats
from bayesrace.controller.native_step import NativeStep
from bayesrace.controller.settings import MpcSettings
from bayesrace.vehicles import Car
from tests.conftest import SETTINGS, Circuit, Make, Problem
from tests.test_native_time import TS, Clock, residual, solve

DEFAULTS = {name: getattr(MpcSettings(), name) for name in ("early_stop_tol", "iterations")}


def result(step: NativeStep) -> bytes:
    """All of the last step that is not about preparation."""
    step.read_plan()
    names = (
        *("iterations", "qp_iterations", "regularised", "shortened", "shifts", "cost", "pace"),
        *("widening", "stationarity", "defect"),
    )
    numbers = [float(getattr(step.info, name)) for name in names]
    parts = (step.u, step.plan_x, step.plan_u, step.read_tube(), np.array(numbers))
    return b"".join(part.tobytes() for part in parts)


@pytest.mark.parametrize("changes", [{}, DEFAULTS, DEFAULTS | {"caution": 0.95}])
def test_prepared_steps_are_the_same_to_the_bit(
    make: Make, recorded: list[Problem], changes: dict[str, float]
) -> None:
    prepared, plain = make(**changes), make(**changes)
    for k, p in enumerate(recorded[:150]):
        assert solve(prepared, p) is solve(plain, p)
        assert result(prepared) == result(plain)
        assert (prepared.info.prepared, plain.info.prepared) == (int(k > 0), 0)
        prepared.prepare()


@pytest.mark.parametrize("caution", [0.0, 0.95])
@pytest.mark.parametrize("expected", [0.0, 0.002, TS, 3 * TS, 0.39, 5.0])
@pytest.mark.parametrize("elapsed", [0.0, 0.009, TS, 2 * TS, 5 * TS, 0.395, 1.0])
def test_an_unexpected_time_is_corrected(
    make: Make, recorded: list[Problem], expected: float, elapsed: float, caution: float
) -> None:
    """Also by a controller that learns of what it is shown."""
    prepared, plain = make(caution=caution), make(caution=caution)
    for p, after in pairwise(recorded[:9]):
        assert solve(prepared, p) is solve(plain, p)
        for step in (prepared, plain):
            step.observe(p.x0, plain.u, TS, after.x0)
    for p, after in pairwise(recorded[8:12]):
        for step in (prepared, plain):
            step.observe(p.x0, plain.u, TS, after.x0)
        prepared.prepare(expected)
        prepared.rehearse()
        assert solve(prepared, p, elapsed_s=elapsed) is solve(plain, p, elapsed_s=elapsed)
        assert result(prepared) == result(plain)


def test_preparing_again_counts_from_the_last_step(make: Make, recorded: list[Problem]) -> None:
    prepared, plain = make(), make()
    for p in recorded[:20]:
        assert solve(prepared, p) is solve(plain, p)
        assert result(prepared) == result(plain)
        for expected in (TS, TS, 4 * TS, 0.0, TS):
            prepared.prepare(expected)


Between = Callable[[NativeStep, Circuit, Car], object]


def changed(**changes: float) -> Between:
    """Sets the parameters so changed."""
    return lambda step, _, car: step.set_parameters(car, SETTINGS.model_copy(update=changes))


BETWEEN: dict[str, Between] = {
    "other weights": lambda step, *_: step.load_weights(b""),
    "reset": lambda step, *_: step.reset(),
    "other parameters": changed(q_position=2.0, r_duty=0.02, margin_m=0.02),
    "no constraints": changed(constraints=False),
    "caution": changed(caution=0.95),
    "path": lambda step, circuit, _: step.set_path(circuit.table),
    "bad state": lambda step, *_: step.step(np.full(7, np.nan), 0.0),
    "prediction": lambda step, circuit, _: step.predict(
        circuit.start(), np.array([0.5, 1.0]), 0.05
    ),
}


@pytest.mark.parametrize("elapsed", [TS, 0.0])
@pytest.mark.parametrize("what", BETWEEN)
def test_what_happens_in_between_is_seen(
    make: Make, recorded: list[Problem], circuit: Circuit, car: Car, what: str, elapsed: float
) -> None:
    """Also by a step that comes sooner than prepared for, which goes back to the plan before."""
    prepared, plain = make(), make()
    for k, p in enumerate(recorded[:24]):
        if k == 12:
            for one in (prepared, plain):
                BETWEEN[what](one, circuit, car)
        after = elapsed if k == 12 else TS
        assert solve(prepared, p, elapsed_s=after) is solve(plain, p, elapsed_s=after)
        assert result(prepared) == result(plain)
        prepared.prepare()


def test_rows_switched_off_start_no_step_from_the_plan_before_the_preparation(
    make: Make, recorded: list[Problem], circuit: Circuit, car: Car
) -> None:
    """Their multipliers and places in the working set are of a problem that is no more."""
    prepared, plain = make(), make()
    for p in recorded[:60]:
        for allowed, elapsed in ((True, TS), (False, 0.0)):
            for step in (prepared, plain):
                changed(constraints=allowed)(step, circuit, car)
            assert solve(prepared, p, elapsed_s=elapsed) is solve(plain, p, elapsed_s=elapsed)
            assert result(prepared) == result(plain)
            prepared.prepare()


def test_the_plan_of_the_last_step_stays_readable(make: Make, recorded: list[Problem]) -> None:
    step = make()
    Clock(step, 1e-6)
    for p in recorded[:5]:
        solve(step, p)
        x, u = (part.copy() for part in step.read_plan())
        step.prepare(2 * TS, 1.0)
        again_x, again_u = step.read_plan()
        assert (x == again_x).all()
        assert (u == again_u).all()


def test_a_budget_converges_the_last_problem(make: Make, recorded: list[Problem]) -> None:
    step, iterations, converged = make(), 0, 0
    Clock(step, 1e-6)
    for p in recorded[:60]:
        solve(step, p)
        step.prepare(0.0, 1.0)
        solve(step, p, elapsed_s=0.0)
        iterations += step.info.prepared_iterations
        assert step.info.iterations == 1 or step.info.second_start
        converged += residual(step) <= 1e-6
        step.prepare(TS)
    assert iterations > 60
    assert converged >= 55  # not where the Hessian is indefinite


def test_a_budget_never_makes_the_plan_worse(make: Make, recorded: list[Problem]) -> None:
    """Also where the Hessian is indefinite and single iterations do."""
    for k in range(10, 290, 20):
        improved, plain = make(), make()
        Clock(improved, 1e-6)
        for step in (improved, plain):
            for p in recorded[k - 3 : k + 1]:
                solve(step, p)
        improved.prepare(0.0, 1.0)
        for step in (improved, plain):
            solve(step, recorded[k], elapsed_s=0.0)
        assert residual(improved) <= residual(plain) + 1e-12


@pytest.mark.parametrize("caution", [0.0, 0.95])
def test_the_preparation_ends_within_its_budget(
    make: Make, recorded: list[Problem], caution: float
) -> None:
    step = make(tolerance=1e-14, caution=caution)
    clock = Clock(step, 1e-3)
    done = []
    for k, p in enumerate(recorded[:60]):
        solve(step, p)
        done.append(step.info.prepared_iterations)
        begin_s, readings = clock.now_s, 1 + k % 20
        step.prepare(TS, readings * 1e-3)
        most = max(readings + 1.5, 4.5 if caution else 0)  # caution itself is not left out
        assert clock.now_s - begin_s <= most * 1e-3
    assert max(done) >= 2
    assert min(done) == 0


def drive(
    step: NativeStep, circuit: Circuit, budget_s: float
) -> list[tuple[Floats, float, Floats, int]]:
    """A lap of a car as the model has it, in which each step is prepared with this budget: its
    states, inputs before, inputs, and iterations."""
    x, d, seen = circuit.start(), 0.0, []
    for _ in range(150):
        assert step.step(x, d).usable
        seen.append((x, d, step.u.copy(), step.info.iterations))
        step.prepare(TS, budget_s)
        d, x = float(step.u[0]), step.predict(x, step.u, TS).copy()
    return seen


def test_with_a_budget_the_next_problem_is_solved_ahead(make: Make, circuit: Circuit) -> None:
    """So that nearly all steps need one iteration, from a start nearer to the solution."""
    more, error = [], []
    for budget_s in (0.1, 0.0):
        seen = drive(make(**DEFAULTS), circuit, budget_s)
        more.append(np.mean([iterations > 1 for *_, iterations in seen[5:]]))
        exact, off = make(iterations=60, iterations_cold=60, tolerance=1e-10), []
        for x, d, u, _ in seen:
            exact.step(x, d)
            off.append(abs(exact.u[1] - u[1]))
        error.append(np.percentile(off, 95))
    assert more[0] < 0.05 < 0.1 < more[1]
    assert error[0] < 0.5 * error[1]


@pytest.mark.parametrize("elapsed_s", [0.0, 2 * TS, 0.39])
def test_what_was_solved_ahead_and_does_not_come_does_no_harm(
    make: Make, circuit: Circuit, elapsed_s: float
) -> None:
    """Sooner, the plan is the one before; later, that of the problem ahead goes on."""
    ahead, plain = make(), make()
    for step in (ahead, plain):
        Clock(step, 1e-6)
        drive(step, circuit, 0.0)
        x, d = circuit.start(3.0, 1.5), 0.3
        step.step(x, d)
        if step is ahead:
            step.prepare(TS, 1.0)
        assert step.step(x, d, elapsed_s=elapsed_s).usable
    if elapsed_s == 0:
        assert result(ahead) == result(plain)
    np.testing.assert_allclose(ahead.u, plain.u, rtol=0, atol=0.05)


def test_without_a_plan_there_is_nothing_to_prepare(make: Make, recorded: list[Problem]) -> None:
    step, fresh = make(), make()
    step.prepare(TS, 1.0)
    broken = recorded[0].x0.copy()
    broken[6] = 0.6  # cannot be brought back: infeasible
    step.solve(broken, 0.0, recorded[0].reference)
    step.prepare(TS, 1.0)
    assert solve(step, recorded[1]) is solve(fresh, recorded[1])
    assert result(step) == result(fresh)
    assert (step.info.shifts, step.info.prepared) == (-1, 0)
