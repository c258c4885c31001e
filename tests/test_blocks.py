"""Blocks of stages whose inputs a QP changes alike: IPOPT's solution, shifts, and limits."""

import numpy as np
import pytest
from pydantic import ValidationError

from bayesrace.arrays import Floats
from bayesrace.codegen.ocp import OcpNlp
from bayesrace.codegen.problems.problem import Problem
from bayesrace.codegen.settings import BuildSettings
from bayesrace.controller.native_step import NativeProblem, Status
from bayesrace.vehicles import Car, default_car
from tests.test_problems import (
    HORIZON,
    IPOPT,
    STEP_S,
    VALUES,
    assert_preparation_changes_no_bit,
    compiled,
    corrected,
    craft,
    note_active,
    stages,
)

BLOCKS = [0, 1, 2, 3, 4, 4, 4, 5, 5, 5, 6, 6]
"""Four free stages, then blocks of three, of which the last is shorter."""
START = np.array([-1.3, -0.9, 0.5, -0.6, 0.3])


@pytest.fixture(scope="module")
def problem() -> Problem:
    return craft()


@pytest.fixture(scope="module")
def native(problem: Problem) -> NativeProblem:
    return compiled(problem, free_stages=4, block_stages=3)


@pytest.fixture(scope="module")
def ocp(problem: Problem) -> OcpNlp:
    return OcpNlp(problem, corrected(problem), HORIZON, options=IPOPT, blocks=BLOCKS)


def spans(of_stages: Floats) -> Floats:
    """Of each block, by how much its stages differ."""
    blocks = [of_stages[[b == block for b in BLOCKS]] for block in range(BLOCKS[-1] + 1)]
    return np.array([np.ptp(block, axis=0) for block in blocks])


def test_from_a_constant_guess_it_solves_to_the_solution_of_ipopt(
    native: NativeProblem, ocp: OcpNlp
) -> None:
    """With one input for each block; and that is not the solution without blocks."""
    x, u = START, np.zeros(3)
    active = {"hard": 0, "lane": 0, "input": 0, "obstacle": 0}
    for k in range(12):
        native.reset()
        assert native.solve(x, u, stages(k)) is Status.CONVERGED
        plan_x, plan_u = (part.copy() for part in native.read_plan())
        assert spans(plan_u).max() < 1e-12
        assert np.ptp(plan_u[3:], axis=0).max() > 0.01
        oracle = ocp.solve(x, u, stages(k), VALUES, (plan_x, plan_u))
        assert oracle.success, oracle.status
        np.testing.assert_allclose(plan_u, oracle.u, rtol=0, atol=1e-6)
        np.testing.assert_allclose(plan_x, oracle.x, rtol=0, atol=1e-6)
        assert native.info.cost == pytest.approx(oracle.cost, rel=1e-8)
        note_active(active, plan_x, plan_u)
        u = native.u.copy()
        x = native.predict(x, u, STEP_S)
    assert min(active.values()) > 0


def rolled_out(native: NativeProblem, x: Floats, inputs: Floats) -> Floats:
    states = [x]
    for u in inputs:
        states.append(native.evaluate(np.r_[states[-1], u], np.zeros(5))[0])
    return np.array(states)


def test_a_shifted_plan_changes_by_blocks_and_no_such_change_is_better(
    native: NativeProblem, ocp: OcpNlp
) -> None:
    """Stages of a shifted plan that are in one block now keep what was different between them."""
    native.reset()
    x, u, random = START, np.zeros(3), np.random.default_rng(0)
    apart = 0.0
    for k in range(8):
        before = native.read_plan()[1].copy()
        shifted = np.vstack([before[1:], before[-1] * [1, 1, 0]])
        assert native.solve(x, u, stages(k)) is Status.CONVERGED
        plan_x, plan = (part.copy() for part in native.read_plan())
        if k:
            assert spans(plan - shifted).max() < 1e-12
            apart = max(apart, spans(plan).max())
        cost = ocp.cost(plan_x, plan, u, stages(k), VALUES)
        for _ in range(40):
            change = 1e-3 * random.normal(size=(BLOCKS[-1] + 1, 3))[BLOCKS]
            other = plan + change
            states = rolled_out(native, x, other)
            within = (np.abs(other[:, :2]) <= VALUES["a_max"]).all() and (other[:, 2] >= 0).all()
            if within and (other[:, 2] <= 1).all() and states[:, 4].max() <= VALUES["heat_max"]:
                assert ocp.cost(states, other, u, stages(k), VALUES) >= cost
        u = native.u.copy()
        native.prepare()
        x = native.predict(x, u, STEP_S)
    assert apart > 0.01


def test_limits_that_come_nearer_hold_for_each_stage_of_a_block(native: NativeProblem) -> None:
    """Also where no common change brings all of them within."""
    native.reset()
    x, u = START, np.zeros(3)
    for k in range(6):
        assert native.solve(x, u, stages(k)).usable
        u = native.u.copy()
        x = native.predict(x, u, STEP_S)
    plan = native.read_plan()[1]
    least = 0.2 * float(spans(plan)[:, :2].max())
    assert least > 0.01
    native.set_values({"a_max": least})
    try:
        assert native.solve(x, np.clip(u, -least, least), stages(6)).usable
        assert np.abs(native.read_plan()[1][:, :2]).max() <= least + 1e-9
    finally:
        native.set_values({"a_max": VALUES["a_max"]})


def test_blocks_of_one_stage_change_nothing(problem: Problem) -> None:
    plans = []
    for blocks in ({}, {"free_stages": HORIZON - 1, "block_stages": 2}):
        step = compiled(problem, **blocks)
        x, u = START, np.zeros(3)
        for k in range(8):
            assert step.solve(x, u, stages(k)).usable
            u = step.u.copy()
            step.prepare()
            x = step.predict(x, u, STEP_S)
        plans.append(step.read_plan()[1].copy())
    np.testing.assert_allclose(plans[0], plans[1], rtol=0, atol=1e-9)


def test_the_preparation_changes_no_bit(native: NativeProblem) -> None:
    assert_preparation_changes_no_bit(native, START)


def test_the_car_states_its_blocks_and_settings_others() -> None:
    car = default_car()
    own = car.tuning.progress
    assert BuildSettings(car=car).blocks == (20, 1)  # tracking has none
    progress = BuildSettings(car=car, problem="progress")
    assert progress.blocks == (own.free_stages, own.block_stages)
    assert progress.model_copy(update={"free_stages": 3, "block_stages": 4}).blocks == (3, 4)
    assert progress.model_copy(update={"horizon": 8}).blocks[0] == 8
    assert progress.model_copy(update={"block_stages": 1}).blocks == (own.horizon, 1)
    for bad in ({"free_stages": 0}, {"block_stages": 0}):
        data = car.model_dump()
        data["tuning"]["progress"] |= bad
        with pytest.raises(ValidationError, match=next(iter(bad))):
            Car.model_validate(data)
