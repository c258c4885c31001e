"""The same library uses what the processor has: each instruction set against the same oracles."""

import platform
from pathlib import Path

import numpy as np
import pytest

from bayesrace.controller.native_step import NativeStep
from bayesrace.controller.settings import MpcSettings
from bayesrace.errors import InputError
from bayesrace.gp.expression import corrected_function
from bayesrace.gp.weights import KERNELS
from bayesrace.integrators import PREDICTION
from bayesrace.learning.validation import predictive_sigma
from bayesrace.vehicles import Car
from bayesrace.vehicles.models import e_kinematic
from tests.conftest import Make, Problem, fit_weights
from tests.test_native_gp import check, points
from tests.test_native_time import solve

NAMES = ["BASELINE", "AVX2", "AVX512"]


def using(step: NativeStep, name: str) -> NativeStep:
    """Skips the test where the processor lacks them."""
    if NAMES.index(name) > NAMES.index(step.instructions):
        with pytest.raises(InputError, match="processor lacks"):
            step.set_instructions(name)
        pytest.skip(f"no {name} here")
    step.set_instructions(name)
    assert step.instructions == name
    return step


def test_the_best_that_there_is_is_used_at_first(make: Make) -> None:
    flags = set(Path("/proc/cpuinfo").read_text().split())
    if platform.machine() != "x86_64" or "avx2" not in flags:
        assert make().instructions == "BASELINE"
    else:
        assert make().instructions == ("AVX512" if "avx512dq" in flags else "AVX2")


@pytest.mark.parametrize("kind", KERNELS)
@pytest.mark.parametrize("name", NAMES)
def test_model_and_variance_are_those_of_the_oracles(
    kinematic_artefact: Path, car: Car, kind: str, name: str
) -> None:
    """But for the second derivative of Matern 1/2, which the compiled Hessian leaves out."""
    weights = fit_weights(car, (kind, kind, kind), count=131)
    step = using(NativeStep(kinematic_artefact, car, MpcSettings()), name)
    step.set_weights(weights)
    function = corrected_function(e_kinematic(car), PREDICTION, weights)
    vs = points(car)
    check(step, function, vs, hessian=kind != "matern05")
    ours = np.array([step.variance(v)[0] for v in vs])
    theirs = predictive_sigma(weights, vs[:, 3:]) ** 2
    prior = np.array([sum(output.amplitudes[2:]) for output in weights.outputs])
    np.testing.assert_allclose(ours / prior, theirs / prior, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_steps_are_the_same_but_for_rounding(
    make: Make, recorded: list[Problem], name: str
) -> None:
    """Also by weights that another code has loaded, and changed between two steps."""
    changes = {"caution": 0.95}
    best, other = make(**changes), using(make(**changes), name)
    for k, p in enumerate(recorded[:150]):
        best.prepare()
        other.prepare()
        if k % 20 == 10:
            other.set_instructions(NAMES[0])
        if k % 20 == 15:
            other.set_instructions(name)
        assert solve(best, p) is solve(other, p)
        assert best.info.iterations == other.info.iterations
        np.testing.assert_allclose(other.u, best.u, rtol=0, atol=1e-7)


def test_other_instructions_change_no_bit_of_a_prepared_step(
    make: Make, recorded: list[Problem]
) -> None:
    prepared, plain = make(), make()
    best = prepared.instructions
    for k, p in enumerate(recorded[:30]):
        if k % 3:
            prepared.prepare()
        for one in (prepared, plain):
            one.set_instructions(best if k % 2 else "BASELINE")
        assert solve(prepared, p) is solve(plain, p)
        assert prepared.u.tobytes() == plain.u.tobytes()
