"""Python's view of the compiled step: loads the artefact, one object per controller.

ctypes with buffers made once: a step costs about 2 us beyond the C call.
"""

import ctypes as ct
import hashlib
from enum import IntEnum
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from bayesrace.cpu import cpu_digest
from bayesrace.errors import InputError
from bayesrace.gp.weights import KERNELS, GpWeights
from bayesrace.manifest import ABI, LIBRARY, Manifest, read_manifest
from bayesrace.vehicles import CarParameters
from controller.path_table import PATH_COLUMNS, PathTable
from controller.settings import MpcSettings

__all__ = ["NativeStep", "Reference", "StepInfo", "StepStatus"]

_ALIGNMENT: Final = 64
_DOUBLES = npt.NDArray[np.float64]


class StepStatus(IntEnum):
    """br_mpc_status: what became of the optimisation problem."""

    CONVERGED = 0
    ACCEPTABLE = 1
    DEFECT = 2
    INFEASIBLE = 3
    QP_LIMIT = 4
    NOT_FINITE = 5
    BAD_STATE = 6

    @property
    def usable(self) -> bool:
        """Whether the first input may go to the actuators."""
        return self <= StepStatus.ACCEPTABLE


class _Parameters(ct.Structure):
    _fields_ = [
        *(
            (name, ct.c_double)
            for name in (
                "q_position",
                "r_duty",
                "r_delta_rate",
                "s_slack",
                "margin_m",
                "d_min",
                "d_max",
                "delta_max_rad",
                "delta_rate_max_radps",
                "tolerance",
                "defect_max",
                "settle",
            )
        ),
        ("iterations", ct.c_int),
        ("iterations_cold", ct.c_int),
    ]


class _Gp(ct.Structure):
    _fields_ = [
        ("kernel", ct.c_int),
        ("n", ct.c_int),
        ("offset", ct.c_double),
        ("scale", ct.c_double),
        ("length_scales", ct.c_void_p),
        ("inputs", ct.c_void_p),
        ("alpha", ct.c_void_p),
    ]


class StepInfo(ct.Structure):
    """br_mpc_info: residuals at the returned plan, cost, and the car's place on the line."""

    _fields_ = [
        ("iterations", ct.c_int),
        ("qp_iterations", ct.c_int),
        ("regularised", ct.c_int),
        ("shortened", ct.c_int),
        ("stationarity", ct.c_double),
        ("defect", ct.c_double),
        ("bound", ct.c_double),
        ("cost", ct.c_double),
        ("slack_max_m", ct.c_double),
        ("s_ref_m", ct.c_double),
        ("lateral_m", ct.c_double),
    ]
    iterations: int
    qp_iterations: int
    regularised: int
    shortened: int
    stationarity: float
    defect: float
    bound: float
    cost: float
    slack_max_m: float
    s_ref_m: float
    lateral_m: float


Reference = _DOUBLES
"""Stages 1..N of the reference, shape (N, 6): x, y, normal (2), lower, upper."""


def _address(array: _DOUBLES) -> int:
    return array.ctypes.data


def _load(path: Path, manifest: Manifest) -> ct.CDLL:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error}): run 'bayesrace build'") from None
    if hashlib.sha256(data).hexdigest() != manifest.library_sha256:
        raise InputError(
            f"{path} is not the library its manifest describes: remove the folder and run "
            "'bayesrace build'"
        )
    if manifest.cpu != cpu_digest():
        raise InputError(
            f"{path} was compiled for another CPU: remove the folder and run 'bayesrace build' here"
        )
    try:
        library = ct.CDLL(str(path))
    except OSError as error:
        raise InputError(
            f"{path} cannot be loaded here ({error}): it was built for another machine; "
            "remove the folder and run 'bayesrace build'"
        ) from None
    library.br_mpc_memory_size.restype = ct.c_size_t
    library.br_mpc_error_text.restype = ct.c_char_p
    library.br_mpc_init.argtypes = [ct.c_void_p, ct.c_size_t, ct.POINTER(ct.c_void_p)]
    library.br_mpc_set_path.argtypes = [ct.c_void_p, ct.c_void_p, ct.c_int, ct.c_double]
    library.br_mpc_reset.argtypes = [ct.c_void_p]
    library.br_mpc_reset.restype = None
    pointers = ct.c_void_p
    library.br_mpc_step.argtypes = [pointers, pointers, ct.c_double, pointers, pointers, pointers]
    library.br_mpc_solve.argtypes = [
        pointers,
        pointers,
        ct.c_double,
        *[pointers] * 4,
    ]
    library.br_mpc_evaluate.argtypes = [pointers] * 6
    library.br_mpc_get_plan.argtypes = [pointers] * 3
    library.br_mpc_get_reference.argtypes = [pointers] * 2
    library.br_mpc_set_parameters.argtypes = [pointers] * 2
    library.br_mpc_set_weights.argtypes = [pointers] * 2
    return library


class NativeStep:
    """The compiled control step. Not thread-safe.

    ``u`` (2,), ``info`` and the plan arrays are overwritten by each step.
    """

    def __init__(self, artefact: Path, car: CarParameters, settings: MpcSettings) -> None:
        self.manifest = read_manifest(artefact)
        built_for = (self.manifest.car, self.manifest.car_digest)
        if built_for != (car.name, car.digest()):
            raise InputError(
                f"{artefact} was built for car '{'-'.join(built_for)}', not "
                f"'{car.name}-{car.digest()}': run 'bayesrace build'"
            )
        self._library = _load(artefact / LIBRARY, self.manifest)
        if self._library.br_mpc_abi() != ABI:
            raise InputError(f"{artefact}: library and manifest disagree: run 'bayesrace build'")
        self._mpc = self._new_object()
        n = self.manifest.horizon
        self.u = np.zeros(2)
        self.info = StepInfo()
        self._x = np.zeros(7)
        self._status = ct.c_int()
        self._u_address = _address(self.u)
        self._x_address = _address(self._x)
        self._status_address = ct.addressof(self._status)
        self._info_address = ct.addressof(self.info)
        self.plan_x = np.zeros((n + 1, 7))
        self.plan_u = np.zeros((n, 2))
        self._step = self._library.br_mpc_step
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

    def _check(self, error: int, what: str) -> None:
        if error:
            text = self._library.br_mpc_error_text(error).decode()
            raise InputError(f"native controller, {what}: {text}")

    def set_parameters(self, car: CarParameters, settings: MpcSettings) -> None:
        """Weights, limits and tolerances of the OCP; effective from the next step."""
        parameters = _Parameters(
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
        outputs = (_Gp * 3)()
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

    def set_zero_weights(self) -> None:
        """No correction: WorstCase with the e-kinematic model, BestCase with the dynamic one."""
        self._check(self._library.br_mpc_set_weights(self._mpc, (_Gp * 3)()), "weights")

    def reset(self) -> None:
        """Forgets plan, working set and place on the line."""
        self._library.br_mpc_reset(self._mpc)

    def step(self, x: _DOUBLES, d_previous: float) -> StepStatus:
        """One control step from the measured state x (7,); results in ``u`` and ``info``."""
        self._x[:] = x
        self._check(
            self._step(
                self._mpc,
                self._x_address,
                d_previous,
                self._u_address,
                self._status_address,
                self._info_address,
            ),
            "step",
        )
        return StepStatus(self._status.value)

    def solve(self, x: _DOUBLES, d_previous: float, reference: Reference) -> StepStatus:
        """As :meth:`step`, with the reference (N, 6) of another planner."""
        rows = np.ascontiguousarray(reference, dtype=np.float64)
        if rows.shape != (self.manifest.horizon, 6):
            raise InputError(f"reference has shape {rows.shape}, not ({self.manifest.horizon}, 6)")
        self._x[:] = x
        error = self._library.br_mpc_solve(
            self._mpc,
            self._x_address,
            d_previous,
            _address(rows),
            self._u_address,
            self._status_address,
            self._info_address,
        )
        self._check(error, "solve")
        return StepStatus(self._status.value)

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
