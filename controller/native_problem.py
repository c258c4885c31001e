"""Python's view of any compiled problem: loads the artefact, one object per controller.

ctypes with buffers made once: a step costs about 2 us beyond the C call. The sizes and names are
those of the artefact's manifest.
"""

import ctypes as ct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.native_interface import INSTRUCTIONS, SAMPLES
from controller.interface import Environment
from controller.native_library import (
    Artefact,
    EnvironmentStructure,
    Gp,
    StepInfo,
    StepStatus,
    aligned_memory,
    parameters_type,
)

__all__ = ["NativeProblem", "Reference"]


Reference = Floats
"""Parameters of the stages 1..N, shape (N, np), in the order of the manifest."""


def _address(array: Floats) -> int:
    return array.ctypes.data


class NativeProblem:
    """A compiled control problem. Not thread-safe, but for :meth:`stage_weights`.

    With nx states and nu inputs, ``u`` (nu,), ``info`` and the plan arrays are overwritten by each
    step. Times are in seconds; budgets are measured by the system's monotonic clock.
    """

    def __init__(self, artefact: Path) -> None:
        """Without parameters, and with a residual of zero. InputError for no usable artefact."""
        self.artefact = Artefact(artefact)
        self.manifest, self._library = self.artefact.manifest, self.artefact.library
        self._check = self.artefact.check
        self._memory, memory = aligned_memory(self._library.br_mpc_memory_size())
        self._mpc = ct.c_void_p()
        size = self._library.br_mpc_memory_size()
        self._check(self._library.br_mpc_init(memory, size, ct.byref(self._mpc)), "init")
        problem, n = self.manifest.problem, self.manifest.horizon
        self._nx, self._nu = len(problem.states), len(problem.inputs)
        self._step_s = self.manifest.step_s
        self._reference_shape = (n, len(problem.stage_parameters))
        self._parameters = parameters_type(problem)()
        self.u = np.zeros(self._nu)
        self.info = StepInfo()
        self._x = np.zeros(self._nx)
        self._u_before = np.zeros(self._nu)
        self._u_held = np.zeros(self._nu)
        self._predicted = np.zeros(self._nx)
        self._status = ct.c_int()
        self._u_address = _address(self.u)
        self._x_address = _address(self._x)
        self._u_before_address = _address(self._u_before)
        self._status_address = ct.addressof(self._status)
        self._info_address = ct.addressof(self.info)
        self.plan_x = np.zeros((n + 1, self._nx))
        self.plan_u = np.zeros((n, self._nu))
        self.tube = np.zeros(n)
        self._tube_address = _address(self.tube)
        self._plan_addresses = _address(self.plan_x), _address(self.plan_u)
        self._u_held_address = _address(self._u_held)
        self._predicted_address = _address(self._predicted)
        self._step = self._library.br_mpc_step
        self._prepare = self._library.br_mpc_prepare
        self._predict = self._library.br_mpc_predict
        self._rehearse = self._library.br_mpc_rehearse
        # They hold on to the interpreter's lock, which is not to be had back within a microsecond.
        quick = ct.PyDLL(self._library._name)
        self._adopt, self._prove, self._revert = (
            quick.br_mpc_adopt_weights, quick.br_mpc_prove_weights, quick.br_mpc_revert_weights
        )  # fmt: skip
        self._get_watch = quick.br_mpc_get_watch
        for function in (self._adopt, self._prove, self._revert):
            function.argtypes = [ct.c_void_p]
        self._get_watch.argtypes = [ct.c_void_p, ct.c_void_p]
        self._watch = self.artefact.Watch()
        self._watch_address = ct.addressof(self._watch)
        self._set_clock()
        self.set_zero_weights()

    @property
    def handle(self) -> ct.c_void_p:
        """The br_mpc, for other functions of the library."""
        return self._mpc

    def _set_clock(self) -> None:
        clock = ct.cast(self._library.br_mpc_monotonic, ct.c_void_p)
        self._check(self._library.br_mpc_set_clock(self._mpc, clock, None), "clock")

    @property
    def instructions(self) -> str:
        """What the step is compiled for, a name of INSTRUCTIONS; at first the fastest here."""
        return INSTRUCTIONS[self._library.br_mpc_get_instructions(self._mpc)][0]

    def set_instructions(self, name: str) -> None:
        """Others, whose results differ by rounding; InputError if the processor lacks them."""
        names = [known for known, _ in INSTRUCTIONS]
        error = self._library.br_mpc_set_instructions(self._mpc, names.index(name))
        self._check(error, f"instructions {name}")

    def set_values(self, values: Mapping[str, float]) -> None:
        """Sets run-time parameters and solver settings by name; effective from the next step.

        All of them the first time. InputError for a name that there is not, or a value that the
        problem does not allow.
        """
        known = {field[0] for field in self._parameters._fields_}
        if unknown := sorted(set(values) - known):
            raise InputError(
                f"problem '{self.manifest.problem.name}' has no parameter {', '.join(unknown)}; "
                f"it has {', '.join(sorted(known))}"
            )
        for name, value in values.items():
            setattr(self._parameters, name, value)
        error = self._library.br_mpc_set_parameters(self._mpc, ct.byref(self._parameters))
        self._check(error, "parameters")

    def stage_weights(self, outputs: "ct.Array[Gp]") -> None:
        """Copies the outputs beside those in use, for :meth:`adopt_weights`.

        The one method that another thread may call; the interpreter goes on meanwhile. InputError
        if they are unusable; they are not compared with the manifest.
        """
        if len(outputs) != self.manifest.problem.outputs:
            raise InputError(
                f"{len(outputs)} outputs of a residual are not the {self.manifest.problem.outputs} "
                f"of problem '{self.manifest.problem.name}'"
            )
        self._check(self._library.br_mpc_stage_weights(self._mpc, outputs), "weights")

    def adopt_weights(self) -> None:
        """Puts what is staged into use, between two steps; InputError if there is nothing.

        They are on probation: :meth:`watch` compares them with those that were proven before.
        """
        self._check(self._adopt(self._mpc), "weights")

    def prove_weights(self) -> None:
        """Ends the probation of the weights in use."""
        self._check(self._prove(self._mpc), "weights")

    def revert_weights(self) -> None:
        """Goes back to the proven weights, between two steps."""
        self._check(self._revert(self._mpc), "weights")

    def watch(self) -> Any:
        """How the weights in use do beside the proven ones: see WATCH; overwritten by the next."""
        self._get_watch(self._mpc, self._watch_address)
        return self._watch

    def samples(self) -> tuple[Floats, Floats]:
        """The newest samples of what the car has done, by the thread that steps: features (n, nz)
        and residuals of the model without correction (n, ne), per stage."""
        problem, count = self.manifest.problem, ct.c_int()
        features = np.zeros((SAMPLES, len(problem.features)))
        residuals = np.zeros((SAMPLES, problem.outputs))
        addresses = _address(features), _address(residuals), ct.addressof(count)
        self._check(self._library.br_mpc_get_samples(self._mpc, *addresses), "samples")
        return features[: count.value], residuals[: count.value]

    def set_zero_weights(self) -> None:
        """No correction of the model."""
        self._check(
            self._library.br_mpc_set_weights(self._mpc, (Gp * self.manifest.problem.outputs)()),
            "weights",
        )

    def reset(self) -> None:
        """Forgets plan, working set and place on the line."""
        self._library.br_mpc_reset(self._mpc)

    def step(
        self,
        x: Floats,
        u_before: npt.ArrayLike,
        *,
        elapsed_s: float | None = None,
        budget_s: float = 0.0,
        environment: Environment | None = None,
    ) -> StepStatus:
        """One control step from the measured state x (nx,); results in ``u`` and ``info``.

        ``u_before`` (nu,): the input that acts now; a number stands for all components.
        ``elapsed_s``: since the state of the call before, of whatever status; None: one stage Ts.
        ``budget_s``: iterate until converged or within this time from now; 0: the iteration limits
        of the settings alone. InputError if ``elapsed_s`` is negative or not finite, or a limit of
        the ``environment`` no limit.
        """
        self._x[:] = x
        self._u_before[:] = u_before
        self._check(
            self._step(
                self._mpc,
                self._x_address,
                self._u_before_address,
                None if environment is None else ct.byref(EnvironmentStructure(*environment)),
                self._step_s if elapsed_s is None else elapsed_s,
                budget_s,
                self._u_address,
                self._status_address,
                self._info_address,
            ),
            "step",
        )
        return StepStatus(self._status.value)

    def solve(
        self,
        x: Floats,
        u_before: npt.ArrayLike,
        reference: Reference,
        *,
        elapsed_s: float | None = None,
        budget_s: float = 0.0,
    ) -> StepStatus:
        """As :meth:`step`, with the stage parameters (N, np) of another planner."""
        rows = np.ascontiguousarray(reference, dtype=np.float64)
        if rows.shape != self._reference_shape:
            raise InputError(f"reference has shape {rows.shape}, not {self._reference_shape}")
        self._x[:] = x
        self._u_before[:] = u_before
        error = self._library.br_mpc_solve(
            self._mpc,
            self._x_address,
            self._u_before_address,
            self._step_s if elapsed_s is None else elapsed_s,
            budget_s,
            _address(rows),
            self._u_address,
            self._status_address,
            self._info_address,
        )
        self._check(error, "solve")
        return StepStatus(self._status.value)

    def observe(self, x: Floats, u: Floats, duration_s: float, x_next: Floats) -> None:
        """What the car did between two measured states (nx,), under u (nu,) on average.

        Where such errors are larger than the posterior's standard deviations, caution widens these:
        ``info.widening``. InputError for a duration that is not above 0 and at most 1, or numbers
        that are not finite.
        """
        self._x[:] = x
        self._u_held[:] = u
        self._predicted[:] = x_next
        error = self._library.br_mpc_observe(
            self._mpc, self._x_address, self._u_held_address, duration_s, self._predicted_address
        )
        self._check(error, "observe")

    def prepare(self, elapsed_s: float | None = None, budget_s: float = 0.0) -> None:
        """Makes ready what of the next step needs no state; call it after :meth:`step`.

        ``elapsed_s``: expected of the next step; None: one stage Ts. With ``budget_s`` the last
        problem is iterated on first. Results in ``u``, ``info`` and the plan stay. Leaving it out,
        or another ``elapsed_s`` in the step, changes nothing but the time that the step takes.
        """
        elapsed = self._step_s if elapsed_s is None else elapsed_s
        self._check(self._prepare(self._mpc, elapsed, budget_s), "prepare")

    def rehearse(self) -> None:
        """Does the preparation over, to the same bits, so that the step finds its caches warm."""
        self._check(self._rehearse(self._mpc), "rehearse")

    def predict(self, x: Floats, u: Floats, duration_s: float, out: Floats | None = None) -> Floats:
        """State (nx,) after x (nx,) with u (nu,) held, by the model and the weights in use.

        Written into ``out`` (may be x) if given. ``duration_s``: 0 to 1. InputError if it is not,
        or if a number is not finite or absurd.
        """
        self._x[:] = x
        self._u_held[:] = u
        self._check(
            self._predict(
                self._mpc,
                self._x_address,
                self._u_held_address,
                duration_s,
                self._predicted_address,
            ),
            "predict",
        )
        if out is None:
            return self._predicted.copy()
        out[:] = self._predicted
        return out

    def read_plan(self) -> tuple[Floats, Floats]:
        """The last plan, x (N + 1, nx) and u (N, nu), in buffers that the next call overwrites."""
        self._library.br_mpc_get_plan(self._mpc, *self._plan_addresses)
        return self.plan_x, self.plan_u

    def read_tube(self) -> Floats:
        """How uncertain the stages of the last plan are, (N,): :attr:`StepOutput.tube_m`. In a
        buffer that the next call overwrites."""
        self._library.br_mpc_get_tube(self._mpc, self._tube_address)
        return self.tube

    def read_reference(self) -> Reference:
        """The stage parameters of the last step, (N, np)."""
        rows = np.zeros(self._reference_shape)
        self._library.br_mpc_get_reference(self._mpc, _address(rows))
        return rows

    def variance(self, v: Floats) -> Floats:
        """Posterior variance of the residual's outputs at v = [x; u] (nv,), noise included."""
        v = np.ascontiguousarray(v, dtype=np.float64)
        if v.shape != (self._nx + self._nu,):
            raise InputError(f"variance takes v ({self._nx + self._nu},), not {v.shape}")
        variance = np.zeros(self.manifest.problem.outputs)
        self._check(
            self._library.br_mpc_variance(self._mpc, _address(v), _address(variance)), "variance"
        )
        return variance

    def evaluate(self, v: Floats, costate: Floats) -> tuple[Floats, Floats, Floats]:
        """Corrected model at v = [x; u] (nv,): x_next (nx,), J (nx, nv), H of lambda' x_next."""
        nx, nv = self._nx, self._nx + self._nu
        v = np.ascontiguousarray(v, dtype=np.float64)
        costate = np.ascontiguousarray(costate, dtype=np.float64)
        if v.shape != (nv,) or costate.shape != (nx,):
            raise InputError(
                f"evaluate takes v ({nv},), costate ({nx},), not {v.shape}, {costate.shape}"
            )
        x_next, jacobian, hessian = np.zeros(nx), np.zeros((nx, nv)), np.zeros((nv, nv))
        arrays = (v, costate, x_next, jacobian, hessian)
        self._check(
            self._library.br_mpc_evaluate(self._mpc, *(_address(a) for a in arrays)), "evaluate"
        )
        return x_next, jacobian, hessian
