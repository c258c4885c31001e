"""Python's view of the compiled step: loads the artefact, one object per controller.

ctypes with buffers made once: a step costs about 2 us beyond the C call.
"""

import ctypes as ct
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from bayesrace.errors import InputError
from bayesrace.gp.weights import KERNELS, GpWeights
from bayesrace.manifest import read_manifest
from bayesrace.vehicles import CarParameters
from controller.native_library import Gp, Parameters, StepInfo, StepStatus, load_library
from controller.path_table import PATH_COLUMNS, PathTable
from controller.settings import MpcSettings

__all__ = ["NativeStep", "Reference", "StepInfo", "StepStatus"]

_ALIGNMENT: Final = 64
_DOUBLES = npt.NDArray[np.float64]

Reference = _DOUBLES
"""Stages 1..N of the reference, shape (N, 6): x, y, normal (2), lower, upper."""


def _address(array: _DOUBLES) -> int:
    return array.ctypes.data


class NativeStep:
    """The compiled control step. Not thread-safe, but for :meth:`stage_weights`.

    ``u`` (2,), ``info`` and the plan arrays are overwritten by each step. Times are in seconds;
    budgets are measured by the system's monotonic clock.
    """

    def __init__(self, artefact: Path, car: CarParameters, settings: MpcSettings) -> None:
        self.manifest = read_manifest(artefact)
        built_for = (self.manifest.car, self.manifest.car_digest)
        if built_for != (car.name, car.digest()):
            raise InputError(
                f"{artefact} was built for car '{'-'.join(built_for)}', not "
                f"'{car.name}-{car.digest()}': run 'bayesrace build'"
            )
        self._library = load_library(artefact, self.manifest)
        self._mpc = self._new_object()
        n = self.manifest.horizon
        self._step_s = self.manifest.step_s
        self.u = np.zeros(2)
        self.info = StepInfo()
        self._x = np.zeros(7)
        self._u_held = np.zeros(2)
        self._predicted = np.zeros(7)
        self._status = ct.c_int()
        self._u_address = _address(self.u)
        self._x_address = _address(self._x)
        self._status_address = ct.addressof(self._status)
        self._info_address = ct.addressof(self.info)
        self.plan_x = np.zeros((n + 1, 7))
        self.plan_u = np.zeros((n, 2))
        self._u_held_address = _address(self._u_held)
        self._predicted_address = _address(self._predicted)
        self._step = self._library.br_mpc_step
        self._prepare = self._library.br_mpc_prepare
        self._predict = self._library.br_mpc_predict
        self._rehearse = self._library.br_mpc_rehearse
        # Holds on to the interpreter's lock, which is not to be had back within a microsecond.
        self._adopt = ct.PyDLL(self._library._name).br_mpc_adopt_weights
        self._adopt.argtypes = [ct.c_void_p]
        self._set_clock()
        self.set_parameters(car, settings)
        self.set_zero_weights()

    def _new_object(self) -> ct.c_void_p:
        size = self._library.br_mpc_memory_size()
        self._memory = ct.create_string_buffer(size + _ALIGNMENT)
        start = -ct.addressof(self._memory) % _ALIGNMENT
        mpc = ct.c_void_p()
        address = ct.c_void_p(ct.addressof(self._memory) + start)
        self._check(self._library.br_mpc_init(address, size, ct.byref(mpc)), "init")
        return mpc

    def _set_clock(self) -> None:
        clock = ct.cast(self._library.br_mpc_monotonic, ct.c_void_p)
        self._check(self._library.br_mpc_set_clock(self._mpc, clock, None), "clock")

    def _check(self, error: int, what: str) -> None:
        if error:
            text = self._library.br_mpc_error_text(error).decode()
            raise InputError(f"native controller, {what}: {text}")

    def set_parameters(self, car: CarParameters, settings: MpcSettings) -> None:
        """Weights, limits and tolerances of the OCP; effective from the next step."""
        parameters = Parameters(
            settings.q_position,
            settings.r_duty,
            settings.r_delta_rate,
            settings.s_slack if settings.constraints else 0.0,
            settings.margin_m,
            car.d_min,
            car.d_max,
            car.delta_max_rad,
            car.delta_rate_max_radps,
            settings.tolerance,
            settings.defect_max,
            settings.settle,
            settings.iterations,
            settings.iterations_cold,
        )
        error = self._library.br_mpc_set_parameters(self._mpc, ct.byref(parameters))
        self._check(error, "parameters")

    def set_speed_limit(self, limit_mps: float, rate_mps2: float = 0.0) -> None:
        """The reference moves at most this fast, and by the rate less along the horizon."""
        error = self._library.br_mpc_set_speed_limit(self._mpc, limit_mps, rate_mps2)
        self._check(error, "speed limit")

    def set_path(self, table: PathTable) -> None:
        """Racing line and track; copied."""
        rows = np.ascontiguousarray(table.rows, dtype=np.float64)
        if rows.ndim != 2 or rows.shape[1] != PATH_COLUMNS:
            raise InputError(f"path table has shape {rows.shape}, not (n, {PATH_COLUMNS})")
        error = self._library.br_mpc_set_path(self._mpc, _address(rows), len(rows), table.spacing_m)
        self._check(error, "path")

    def set_weights(self, weights: GpWeights) -> None:
        """Uses the weights from the next step on; InputError if they are for another model."""
        if weights.discretisation != self.manifest.discretisation:
            raise InputError(
                f"weights '{weights.version}' were learned for {weights.discretisation}, this "
                f"controller predicts with {self.manifest.discretisation}: train with the same car "
                "and discretisation"
            )
        outputs = (Gp * 3)()
        for target, output in zip(outputs, weights.outputs, strict=True):
            if len(output.alpha) > self.manifest.gp_capacity:
                raise InputError(
                    f"weights '{weights.version}' have {len(output.alpha)} points, the controller "
                    f"was built for {self.manifest.gp_capacity}: train with fewer points or build "
                    "with a larger capacity"
                )
            target.kernel = KERNELS.index(output.kernel)
            target.n = len(output.alpha)
            target.offset = output.y_mean
            target.scale = output.y_scale * output.signal_variance
            target.length_scales = _address(output.length_scales)
            target.inputs = _address(output.inputs)
            target.alpha = _address(output.alpha)
        self._check(self._library.br_mpc_set_weights(self._mpc, outputs), "weights")

    def stage_weights(self, outputs: "ct.Array[Gp]") -> None:
        """Copies the three outputs beside those in use, for :meth:`adopt_weights`.

        The one method that another thread may call; the interpreter goes on meanwhile. InputError
        if they are unusable; they are not compared with the manifest.
        """
        self._check(self._library.br_mpc_stage_weights(self._mpc, outputs), "weights")

    def adopt_weights(self) -> None:
        """Puts what is staged into use, between two steps; InputError if there is nothing."""
        self._check(self._adopt(self._mpc), "weights")

    def set_zero_weights(self) -> None:
        """No correction: WorstCase with the e-kinematic model, BestCase with the dynamic one."""
        self._check(self._library.br_mpc_set_weights(self._mpc, (Gp * 3)()), "weights")

    def reset(self) -> None:
        """Forgets plan, working set and place on the line."""
        self._library.br_mpc_reset(self._mpc)

    def step(
        self,
        x: _DOUBLES,
        d_previous: float,
        *,
        elapsed_s: float | None = None,
        budget_s: float = 0.0,
    ) -> StepStatus:
        """One control step from the measured state x (7,); results in ``u`` and ``info``.

        ``elapsed_s``: since the state of the call before, of whatever status; None: one stage Ts.
        ``budget_s``: iterate until settled or within this time from now; 0: the iteration limits
        of the settings alone. InputError if ``elapsed_s`` is negative or not finite.
        """
        self._x[:] = x
        self._check(
            self._step(
                self._mpc,
                self._x_address,
                d_previous,
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
        x: _DOUBLES,
        d_previous: float,
        reference: Reference,
        *,
        elapsed_s: float | None = None,
        budget_s: float = 0.0,
    ) -> StepStatus:
        """As :meth:`step`, with the reference (N, 6) of another planner."""
        rows = np.ascontiguousarray(reference, dtype=np.float64)
        if rows.shape != (self.manifest.horizon, 6):
            raise InputError(f"reference has shape {rows.shape}, not ({self.manifest.horizon}, 6)")
        self._x[:] = x
        error = self._library.br_mpc_solve(
            self._mpc,
            self._x_address,
            d_previous,
            self._step_s if elapsed_s is None else elapsed_s,
            budget_s,
            _address(rows),
            self._u_address,
            self._status_address,
            self._info_address,
        )
        self._check(error, "solve")
        return StepStatus(self._status.value)

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

    def predict(
        self, x: _DOUBLES, u: _DOUBLES, duration_s: float, out: _DOUBLES | None = None
    ) -> _DOUBLES:
        """State (7,) after x (7,) with u (2,) held, by the model and the weights in use.

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

    def read_plan(self) -> tuple[_DOUBLES, _DOUBLES]:
        """The last plan, x (N + 1, 7) and u (N, 2), in buffers that the next call overwrites."""
        self._library.br_mpc_get_plan(self._mpc, _address(self.plan_x), _address(self.plan_u))
        return self.plan_x, self.plan_u

    def read_reference(self) -> Reference:
        """The last reference, (N, 6)."""
        rows = np.zeros((self.manifest.horizon, 6))
        self._library.br_mpc_get_reference(self._mpc, _address(rows))
        return rows

    def evaluate(self, v: _DOUBLES, costate: _DOUBLES) -> tuple[_DOUBLES, _DOUBLES, _DOUBLES]:
        """Corrected model at v = [x; u] (9,): x_next (7,), J (7, 9), H of lambda' x_next (9, 9)."""
        v = np.ascontiguousarray(v, dtype=np.float64)
        costate = np.ascontiguousarray(costate, dtype=np.float64)
        if v.shape != (9,) or costate.shape != (7,):
            raise InputError(f"evaluate takes v (9,), costate (7,), not {v.shape}, {costate.shape}")
        x_next, jacobian, hessian = np.zeros(7), np.zeros((7, 9)), np.zeros((9, 9))
        arrays = (v, costate, x_next, jacobian, hessian)
        self._check(
            self._library.br_mpc_evaluate(self._mpc, *(_address(a) for a in arrays)), "evaluate"
        )
        return x_next, jacobian, hessian
