"""A control problem of one's own: generated, compiled, and stepped."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from time import perf_counter_ns
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import ArrayLike

from bayesrace.api.values import number, numbers, validated
from bayesrace.arrays import Floats
from bayesrace.codegen.problems.problem import Problem
from bayesrace.controller.native_step import NativeProblem, Status
from bayesrace.errors import InputError
from bayesrace.gp.weights import pack_outputs
from bayesrace.integrators import Discretisation

if TYPE_CHECKING:
    from sklearn.gaussian_process import GaussianProcessRegressor

__all__ = ["Mpc", "Solution"]

_SOLVER: Final = {
    "tolerance": 1e-6, "defect_max": 0.03, "early_stop_tol": 0.0, "iterations": 10,
    "iterations_cold": 50, "qp_steps": 100_000,
}  # fmt: skip


@dataclass(slots=True)
class Solution:
    """Result of one step; its arrays are copies."""

    u: Floats
    """First input, shape (nu,)."""
    plan: Floats
    """Predicted states, shape (N + 1, nx)."""
    plan_u: Floats
    """Planned inputs, shape (N, nu)."""
    status: Status
    """What became of the optimisation problem."""
    cost: float
    """Of the plan, as the problem states it."""
    iterations: int
    """Of the solver."""
    solve_us: float
    """Time of the compiled step, from state to input [us]."""

    @property
    def usable(self) -> bool:
        """Whether the input may be applied: solved to the tolerance, or acceptable."""
        return self.status.usable


class Mpc:
    """Model predictive control of any system that a :class:`bayesrace.Problem` describes, with
    Gaussian processes that correct its model if it has a residual. For one thread.

    It solves; there is no fallback, and no planner: the parameters of each stage are the caller's.
    A problem that follows a path is for :class:`bayesrace.Controller`, which has both.
    """

    def __init__(
        self,
        problem: Problem,
        horizon: int,
        step_s: float,
        parameters: Mapping[str, float],
        *,
        solver: Mapping[str, float] | None = None,
        gp_capacity: int = 1024,
    ) -> None:
        """Generates and compiles C the first time, and takes it from the cache then.

        ``horizon``: stages, 2 to 100. ``step_s``: length of a stage, that of ``problem.f``.
        ``parameters``: run-time parameters by name. ``solver``: tolerance, defect_max,
        early_stop_tol, iterations, iterations_cold, qp_steps, as of a controller's settings.
        ``gp_capacity``: training points of an output of the correction, at most.

        InputError names what cannot be used, or what ``problem.f`` and ``problem.advance`` say
        differently of a stage.
        """
        from bayesrace.codegen.build import build
        from bayesrace.codegen.settings import BuildSettings

        if not isinstance(problem, Problem):
            raise InputError(f"problem = {type(problem).__name__}: give a bayesrace.Problem")
        stage = validated(Discretisation, {"step_s": step_s})
        wanted = {"discretisation": stage, "horizon": horizon, "gp_capacity": gp_capacity}
        settings = validated(BuildSettings, wanted)
        _check_step(problem, step_s)
        unknown = sorted(set(solver or {}) - set(_SOLVER))
        if unknown:
            raise InputError(f"solver: no {', '.join(unknown)}; there are {', '.join(_SOLVER)}")
        self.problem = problem
        """What is solved."""
        self.step_s = step_s
        """Length of a stage [s]."""
        folder, _ = build(settings, problem=problem)
        self.native = NativeProblem(folder)
        """The compiled problem, for measurements."""
        if not isinstance(parameters, Mapping):
            raise InputError(f"parameters = {parameters!r:.60}: give values by name")
        self.native.set_values(_SOLVER | dict(parameters) | dict(solver or {}))
        self._parameters = {name: float(value) for name, value in parameters.items()}
        self._shape = horizon, len(problem.stage_parameters)
        self._u = np.zeros(len(problem.inputs))

    @property
    def parameters(self) -> Mapping[str, float]:
        """Run-time parameters in use, by name."""
        return MappingProxyType(self._parameters)

    def set_parameters(self, **values: float) -> None:
        """Changes run-time parameters from the next step on; InputError for an unknown name, or a
        value that the problem does not allow."""
        self.native.set_values(values)
        known = {one.name for one in self.problem.parameters}
        self._parameters |= {one: float(value) for one, value in values.items() if one in known}

    def set_regressors(self, regressors: "Sequence[GaussianProcessRegressor]") -> None:
        """Corrects the model by fitted regressors, one for each output of its residual, from the
        next step on; an empty sequence: no correction.

        Each predicts, from the problem's ``features`` (n, nz), what ``problem.f`` errs by in a
        step. InputError for kernels other than ConstantKernel * (RBF or Matern) + WhiteKernel.
        """
        from bayesrace.gp.scikit import output_of

        count, width = self.problem.outputs, len(self.problem.features)
        if len(regressors) not in (0, count):
            raise InputError(
                f"{len(regressors)} regressors: the residual of '{self.problem.name}' has {count} "
                "outputs; give one for each, or none"
            )
        named = [output_of(one, f"regressor {i}", width) for i, one in enumerate(regressors)]
        self.native.load_weights(pack_outputs(named), "scikit-learn" if named else "")

    def reset(self) -> None:
        """Forgets the last plan: the next step starts cold."""
        self.native.reset()
        self._u = np.zeros(len(self.problem.inputs))

    def step(
        self,
        x: ArrayLike,
        stages: ArrayLike,
        u_before: ArrayLike | None = None,
        *,
        dt: float | None = None,
        budget_s: float = 0.0,
    ) -> Solution:
        """One step from the measured state ``x`` (nx,).

        ``stages``: parameters of stages 1 to N, shape (N, np), or (np,) for the same at each.
        ``u_before``: input (nu,) that acts now; that of the step before, without. ``dt``: time
        since the step before [s], a stage without. ``budget_s``: how long it may iterate; 0: as
        often as ``solver`` says.
        InputError for another shape or a number that is not finite.
        """
        number(budget_s, "budget_s", 0.0, 1e3, "seconds, 0 or more")
        if dt is not None:
            number(dt, "dt", 0.0, 1e3, "seconds since the step before")
        before = self._u if u_before is None else numbers(u_before, "u_before")
        given = {
            "x": (numbers(x, "x"), (len(self.problem.states),)),
            "u_before": (before, (len(self.problem.inputs),)),
            "stages": (self._rows(numbers(stages, "stages")), self._shape),
        }
        for name, (array, shape) in given.items():
            if array.shape != shape or not np.isfinite(array).all():
                raise InputError(
                    f"{name}: an array of shape {array.shape}, expected {shape} with finite numbers"
                )
        (start, _), (before, _), (rows, _) = given.values()
        begin_ns = perf_counter_ns()
        status = self.native.solve(start, before, rows, elapsed_s=dt, budget_s=budget_s)
        solve_us = (perf_counter_ns() - begin_ns) * 1e-3
        info: Any = self.native.info
        plan, plan_u = self.native.read_plan()
        self._u = self.native.u.copy()
        return Solution(
            self._u.copy(), plan.copy(), plan_u.copy(), status,
            float(info.cost), int(info.iterations), solve_us,
        )  # fmt: skip

    def _rows(self, rows: Floats) -> Floats:
        """The same for each stage, if they are of one."""
        same = rows.shape == self._shape[1:]
        return np.broadcast_to(rows, self._shape).copy() if same else rows


def _check_step(problem: Problem, step_s: float) -> None:
    """InputError unless ``f`` is ``advance`` over a stage, at a place where neither is special."""
    x, u, e = (np.linspace(0.1, 0.2, problem.f.size1_in(i)) for i in range(3))
    over_stage = np.ravel(problem.advance(x, u, 0 * e, step_s))
    step = np.ravel(problem.f(x, u, 0 * e))
    if not np.allclose(step, over_stage, rtol=1e-6, atol=1e-9):
        raise InputError(
            f"step_s = {step_s:g}: problem.f gives {step}, problem.advance over so long "
            f"{over_stage}; both have to be the same model"
        )
