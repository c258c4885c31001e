"""BestCase with a Model Exchange FMU as truth: the OCP is the one of the built-in equations."""

import os
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest

from bayesrace.errors import InputError
from bayesrace.integrators import PERFECT, PREDICTION
from bayesrace.vehicles import CarParameters
from bayesrace.vehicles.fmu import model_from_fmu
from bayesrace.vehicles.models import INPUTS, STATES, Model, dynamic
from codegen.ocp import OcpNlp
from codegen.problems.tracking import tracking
from controller.native_step import NativeStep, StepStatus
from tests.car_fmu import packed_car
from tests.conftest import SETTINGS, Circuit, Problem

EXACT: Final = SETTINGS.model_copy(
    update={"iterations": 60, "iterations_cold": 60, "tolerance": 1e-11}
)
IPOPT: Final = {
    "tol": 1e-10,
    "bound_relax_factor": 0.0,
    "mu_init": 1e-6,
    "warm_start_init_point": "yes",
    "warm_start_bound_push": 1e-9,
    "warm_start_slack_bound_push": 1e-9,
    "warm_start_mult_bound_push": 1e-9,
}


@pytest.fixture(scope="module")
def exchange() -> Path:
    """Our own export for Model Exchange."""
    return packed_car(3, "me")


@pytest.fixture(scope="module")
def truth(exchange: Path, car: CarParameters) -> Model:
    return model_from_fmu(exchange, car)


def edited(fmu: Path, out: Path, change: Callable[[str], str]) -> Path:
    """The FMU with another model description."""
    with zipfile.ZipFile(fmu) as old, zipfile.ZipFile(out, "w") as new:
        for name in old.namelist():
            data = old.read(name)
            new.writestr(name, change(data.decode()) if name == "modelDescription.xml" else data)
    return out


def test_the_fmu_is_the_model_and_so_are_its_derivatives(truth: Model, car: CarParameters) -> None:
    """First ones are exact; CasADi takes differences of them for second ones."""
    import casadi as ca

    built_in = dynamic(car)
    assert (truth.states, truth.inputs, truth.car) == (STATES, INPUTS, car)
    x, u, costate = ca.MX.sym("x", 7), ca.MX.sym("u", 2), ca.MX.sym("l", 7)
    v = ca.vertcat(x, u)

    def derivatives(ode: Any) -> Any:
        xdot = ode(x, u)
        hessian = ca.hessian(ca.dot(costate, xdot), v)[0]
        return ca.Function("all", [x, u, costate], [xdot, ca.jacobian(xdot, v), hessian])

    ours, theirs = derivatives(built_in.ode), derivatives(truth.ode)
    random = np.random.default_rng(0)
    at = np.array([0.4, -1.0, 0.3, 1.8, 0.1, 1.0, 0.1])
    for speed in (0.0, 0.05, 1.0, 2.5):
        state = at * [1, 1, 1, 0, 1, 1, 1] + [0, 0, 0, speed, 0, 0, 0]
        arguments = (state, random.uniform([-0.1, -5], [1, 5]), random.normal(size=7))
        exact, box = ours(*arguments), theirs(*arguments)
        for k, tolerance in enumerate((1e-12, 1e-12, 1e-5)):
            expected = np.asarray(ca.densify(exact[k]))
            scale = max(1.0, float(np.abs(expected).max()))
            difference = np.abs(np.asarray(ca.densify(box[k])) - expected).max()
            assert difference <= tolerance * scale, (speed, k)


@pytest.mark.parametrize("scheme", [PERFECT, PREDICTION])
def test_it_is_discretised_like_any_other(truth: Model, car: CarParameters, scheme: Any) -> None:
    x, u = np.array([0.4, -1, 0.3, 1.8, 0.1, 1, 0.1]), np.array([0.5, 1.0])
    e, h = np.array([0.01, -0.02, 0.1]), 0.013
    for model_function in ("discretise", "corrected", "over"):
        ours = getattr(scheme, model_function)(dynamic(car))
        theirs = getattr(scheme, model_function)(truth)
        arguments = (x, u, e, h)[: ours.n_in()]
        np.testing.assert_allclose(
            np.asarray(theirs(*arguments)), np.asarray(ours(*arguments)), rtol=0, atol=1e-12
        )
    assert scheme.identity(truth.name, car) != scheme.identity("dynamic", car)


@pytest.fixture
def best_case(dynamic_artefact: Path, car: CarParameters, circuit: Circuit) -> NativeStep:
    """The compiled controller with the built-in equations, iterated until converged."""
    step = NativeStep(dynamic_artefact, car, EXACT)
    step.set_path(circuit.table)
    return step


@pytest.fixture(scope="module")
def ocp(truth: Model, car: CarParameters) -> OcpNlp:
    """Exact first derivatives, and IPOPT's Newton steps with differences of them as Hessian."""
    return OcpNlp(tracking(dynamic(car), PERFECT), PERFECT.discretise(truth), 20, options=IPOPT)


@pytest.mark.check
def test_best_case_with_the_fmu_has_the_solution_of_the_built_in_equations(
    ocp: OcpNlp, best_case: NativeStep, car: CarParameters, recorded: list[Problem]
) -> None:
    """Found from a guess that is somewhat off."""
    random = np.random.default_rng(0)
    compared = 0
    for problem in recorded[5::40]:
        best_case.reset()
        status = best_case.solve(problem.x0, problem.d_previous, problem.reference)
        if status is not StepStatus.CONVERGED:
            continue
        plan_x, plan_u = best_case.read_plan()
        guess = plan_x + 1e-3 * random.normal(size=plan_x.shape), 0.97 * plan_u
        found = ocp.solve(
            problem.x0, problem.d_previous, problem.reference, EXACT.parameters(car), guess
        )
        assert found.success, found.status
        np.testing.assert_allclose(found.u, plan_u, rtol=0, atol=1e-5)
        np.testing.assert_allclose(found.x, plan_x, rtol=0, atol=1e-6)
        assert found.cost == pytest.approx(best_case.info.cost, rel=1e-6)
        compared += 1
    assert compared >= 6


@pytest.mark.check
def test_it_drives(
    ocp: OcpNlp, best_case: NativeStep, truth: Model, car: CarParameters, circuit: Circuit
) -> None:
    """Some .4 s with the FMU as plant and in the OCP: where the built-in ones go."""
    with_fmu, built_in = PERFECT.discretise(truth), PERFECT.discretise(dynamic(car))
    start, steps = circuit.start(v_mps=1.5), 20
    x, d = start, 0.0
    for _ in range(steps):
        assert best_case.step(x, d).usable
        solution = ocp.solve(
            x, d, best_case.read_reference(), EXACT.parameters(car), best_case.read_plan()
        )
        assert solution.success, solution.status
        d, x = float(solution.u[0, 0]), np.asarray(with_fmu(x, solution.u[0])).ravel()
    best_case.reset()
    own, d = start, 0.0
    for _ in range(steps):
        assert best_case.step(own, d).usable
        d, own = float(best_case.u[0]), np.asarray(built_in(own, best_case.u)).ravel()
    assert best_case.info.s_ref_m > 0.5
    np.testing.assert_allclose(x, own, rtol=0, atol=1e-5)


# What cannot be used ---------------------------------------------------------------------------


def test_other_fmus_are_refused_with_the_reason(
    exchange: Path, car: CarParameters, tmp_path: Path
) -> None:
    def refused(path: Path, words: str) -> None:
        with pytest.raises(InputError, match=words) as caught:
            model_from_fmu(path, car)
        assert str(path) in str(caught.value)

    refused(tmp_path / "none.fmu", "cannot be read")
    text = tmp_path / "text.fmu"
    text.write_text("no archive")
    refused(text, "is not an FMU")
    refused(packed_car(3, "cs"), "no Model Exchange FMU")
    out = tmp_path / "edited.fmu"
    plain = edited(exchange, out, lambda xml: xml.replace("providesDirectionalDerivatives", "x"))
    refused(plain, "no directional derivatives")
    renamed = edited(exchange, out, lambda xml: xml.replace('name="vx"', 'name="speed"'))
    refused(renamed, "lacks vx and has speed besides")
    renamed = edited(exchange, out, lambda xml: xml.replace('name="delta_rate"', 'name="rate"'))
    refused(renamed, "inputs must be d, delta_rate, but it lacks delta_rate")
    with zipfile.ZipFile(exchange) as old, zipfile.ZipFile(out, "w") as new:
        for name in old.namelist():
            moved = name.replace("binaries/", "binaries/riscv64-plan9-")
            new.writestr(moved, old.read(name))
    refused(out, "not for")


def test_nothing_is_written_beside_the_fmu_and_nothing_is_left_over(
    exchange: Path, car: CarParameters, tmp_path: Path
) -> None:
    """CasADi itself would extract it to where it is."""
    import subprocess
    import sys

    folder = tmp_path / "read only"
    folder.mkdir()
    fmu = shutil.copy(exchange, folder / "car.fmu")
    folder.chmod(0o500)
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    code = (
        "import sys, os, tempfile, pathlib; import numpy as np\n"
        "from bayesrace.vehicles import get_car\n"
        "from bayesrace.vehicles.fmu import model_from_fmu\n"
        "model = model_from_fmu(pathlib.Path(sys.argv[1]), get_car('orca'))\n"
        "assert len(os.listdir(tempfile.gettempdir())) == 1\n"
        "print(model.ode(np.ones(7), np.ones(2)))\n"
    )
    root = Path(__file__).resolve().parents[1]
    done = subprocess.run(
        [sys.executable, "-c", code, str(fmu)],
        capture_output=True, text=True, check=False, cwd=root, timeout=120,
        env={**os.environ, "TMPDIR": str(temporary)},
    )  # fmt: skip
    folder.chmod(0o700)
    assert done.returncode == 0, done.stderr
    assert list(temporary.iterdir()) == []
    assert [path.name for path in folder.iterdir()] == ["car.fmu"]
