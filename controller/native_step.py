"""The compiled controller in Python: its library, any control problem, the step of a car.

Names and sizes come from the headers in controller/native, which cffi reads from the artefact. A
step costs about 2 us beyond the C call.
"""

import ctypes
from collections.abc import Mapping
from enum import IntEnum
from mmap import ACCESS_COPY, mmap
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from bayesrace.arrays import Floats
from bayesrace.controller.interface import Environment
from bayesrace.controller.settings import MpcSettings
from bayesrace.errors import InputError
from bayesrace.gp.weights import OUTPUT_HEAD, Weights, pack_weights
from bayesrace.manifest import DECLARATIONS, LIBRARY, opened_library, read_manifest
from bayesrace.trusted_files import loadable
from bayesrace.vehicles import Car

if TYPE_CHECKING:
    from bayesrace.controller.assembly import PathTable

__all__ = ["PATH_COLUMNS", "Artefact", "NativeProblem", "NativeStep", "Reference", "Status"]

PATH_COLUMNS: Final = 7
"""BR_PATH_COLUMNS in controller/native/bayesrace_mpc.h."""

Reference = Floats
"""Parameters of the stages 1..N, shape (N, np), in the order of the manifest."""


class Status(IntEnum):
    """What became of a step's optimisation problem, or why there was none; 0 and 1 are driven. The
    numbers are this project's, not those of other solvers: br_mpc_status in
    controller/native/bayesrace_mpc.h and, from 251 on, br_no_step in bayesrace_cycle.h."""

    CONVERGED = 0
    """Solved to the tolerance; of a :class:`Step` also what is acceptable."""
    ACCEPTABLE = 1
    """Not to the tolerance, but the plan follows the model and keeps the bounds."""
    DEFECT = 2
    """The plan does not follow the model."""
    INFEASIBLE = 3
    """A quadratic programme has no solution: hard bounds contradict each other."""
    QP_LIMIT = 4
    """A quadratic programme took too many iterations."""
    NOT_FINITE = 5
    """A number is not finite, as of a cost that is not convex in the states."""
    BAD_STATE = 6
    """The state, or the input before, is absurd."""
    TIME_LIMIT = 7
    """The time was up before there was a usable plan."""
    DOUBTED = 251
    """States contradict each other, for longer than they may be old."""
    UNPREDICTABLE = 252
    """The state could not be predicted to the moment of acting."""
    HALTED = 253
    """The car is not to be driven."""
    NO_STATE = 254
    """The newest one is too old."""
    STEP_FAILED = 255
    """The step itself is broken."""

    @property
    def usable(self) -> bool:
        """Whether the first input may go to the actuators."""
        return self <= Status.ACCEPTABLE


class Artefact:
    """A built controller: its manifest, its library, and ``ffi`` with the types of its header.

    The functions of ``library`` release the interpreter's lock while they run.
    """

    def __init__(self, folder: Path) -> None:
        """InputError if it cannot be used here."""
        self.manifest = read_manifest(folder)
        with opened_library(folder, self.manifest) as (declarations, library):
            self.path = loadable(library, self.manifest.library_sha256)
        declared: dict[str, Any] = {}
        exec(compile(declarations, DECLARATIONS, "exec"), declared)  # noqa: S102
        self.ffi: Any = declared["ffi"]
        try:
            self.library: Any = self.ffi.dlopen(str(self.path))
        except OSError as error:
            raise InputError(
                f"{folder / LIBRARY} cannot be loaded here ({error}): it was built for another "
                "machine, its file system allows no programs (noexec), or /proc is missing; remove "
                "the folder and run 'bayesrace build', with BAYESRACE_CACHE set to another folder "
                "if need be"
            ) from None

    def memory(self, size: int) -> Any:
        """A block for an object of the library, zeros.

        It is mapped page by page: a page that is never written, such as one for more GP points than
        the weights have, takes no physical memory.
        """
        return self.ffi.from_buffer(mmap(-1, size, access=ACCESS_COPY))

    def check_cycle(self) -> None:
        """InputError if it has no control cycle: its problem does not follow a path."""
        if not hasattr(self.library, "br_cycle_init"):
            raise InputError(
                f"problem '{self.manifest.problem.name}' drives no car: run 'bayesrace build'"
            )

    def check(self, error: int, what: str) -> None:
        """InputError with the library's words, if there is an error."""
        if error:
            text = self.text(self.library.br_mpc_error_text(error))
            raise InputError(f"native controller, {what}: {text}")

    def text(self, characters: Any) -> str:
        """A string of the library's."""
        return str(self.ffi.string(characters).decode())


class NativeProblem:
    """A compiled control problem. Not thread-safe, but for :meth:`stage_weights`.

    With nx states and nu inputs, ``u`` (nu,), ``info`` (br_mpc_info in bayesrace_mpc.h) and the
    plan arrays are overwritten by each step. Times are in seconds; budgets are measured by the
    system's monotonic clock.
    """

    def __init__(self, artefact: Path) -> None:
        """Without parameters, and with a residual of zero. InputError for no usable artefact."""
        self.artefact = Artefact(artefact)
        self.manifest, self._library = self.artefact.manifest, self.artefact.library
        self._check, ffi = self.artefact.check, self.artefact.ffi
        self._ffi, size = ffi, self._library.br_mpc_memory_size()
        self._memory, handle = self.artefact.memory(size), ffi.new("br_mpc **")
        self._check(self._library.br_mpc_init(self._memory, size, handle), "init")
        self.handle: Final = handle[0]
        """The br_mpc, for other functions of the library."""
        problem, n = self.manifest.problem, self.manifest.horizon
        self._nx, self._nu = nx, nu = len(problem.states), len(problem.inputs)
        self._reference_shape = (n, len(problem.stage_parameters))
        self._parameters, self._complete = ffi.new("br_mpc_parameters *"), False
        self.info, self._status = ffi.new("br_mpc_info *"), ffi.new("br_mpc_status *")
        # Made once: to make arguments of arrays takes longer than to copy into these.
        self._x, self._x_given = self._made(nx)
        self._u_before, self._u_before_given = self._made(nu)
        self.u, self._u = self._made(nu)
        self.plan_x, self._plan_x = self._made(n + 1, nx)
        self.plan_u, self._plan_u = self._made(n, nu)
        self.tube, self._tube = self._made(n)
        # Functions of PyDLL hold on to the interpreter's lock, which takes longer to get back than
        # they run; those of cffi release it.
        self._quick = ctypes.PyDLL(str(self.artefact.path))
        self._address = self._pointer(self.handle)
        clock = ffi.addressof(self._library, "br_mpc_monotonic")
        self._check(self._library.br_mpc_set_clock(self.handle, clock, ffi.NULL), "clock")
        self._rows = 0
        self.weights_version = self._proven_version = ""
        """Of the weights in use; empty while there is no correction."""
        self.load_weights(b"")

    def _made(self, *shape: int) -> tuple[Floats, Any]:
        """Zeros, and the same as an argument for C."""
        array = np.zeros(shape)
        return array, self._ffi.from_buffer("double[]", array)

    def _given(self, what: str, values: npt.ArrayLike, *shape: int) -> Any:
        """The values as an argument for C; InputError if they have another shape."""
        array = np.ascontiguousarray(values, dtype=np.float64)
        if array.shape != shape:
            raise InputError(f"{what} has shape {array.shape}, not {shape}")
        return self._ffi.from_buffer("double[]", array)

    @property
    def instructions(self) -> str:
        """What the step is compiled for, a name of br_instructions; at first the fastest here."""
        number = self._library.br_mpc_get_instructions(self.handle)
        return str(self._ffi.string(self._ffi.cast("br_instructions", number))).removeprefix("BR_")

    def set_instructions(self, name: str) -> None:
        """Others, whose results differ by rounding; InputError if the processor lacks them."""
        number = getattr(self._library, f"BR_{name}")
        self._check(self._library.br_mpc_set_instructions(self.handle, number), "instructions")

    def set_values(self, values: Mapping[str, float]) -> None:
        """Sets run-time parameters and solver settings by name; effective from the next step.

        All of them the first time. InputError for a name that there is not, or a value that the
        problem does not allow.
        """
        known = dir(self._parameters)
        if unknown := sorted(set(values) - set(known)):
            raise InputError(
                f"problem '{self.manifest.problem.name}' has no parameter {', '.join(unknown)}; "
                f"it has {', '.join(known)}"
            )
        names = [] if self._complete else [one.name for one in self.manifest.problem.parameters]
        if missing := [name for name in names if name not in values]:
            problem = self.manifest.problem.name
            raise InputError(f"parameters: {', '.join(missing)} of '{problem}' are missing")
        given = self._ffi.new("br_mpc_parameters *", self._parameters[0])
        for name, value in values.items():
            try:
                setattr(given, name, value)
            except TypeError:
                raise InputError(f"parameter {name} = {value!r:.60}: give a number") from None
        error = self._library.br_mpc_set_parameters(self.handle, given)
        if error:
            self._check(error, f"parameters ({', '.join(self._doubtful(given)) or 'their limits'})")
        self._parameters, self._complete = given, True

    def _doubtful(self, parameters: Any) -> list[str]:
        """Those of the problem whose values it does not allow, with these."""
        known = self.manifest.problem.parameters
        given = [(one, getattr(parameters, one.name)) for one in known]
        return [
            f"{one.name} = {value:g}, which has to be "
            + ("above 0" if one.positive else f"from {one.low:g} to {one.high:g}")
            for one, value in given
            if not one.low <= value <= one.high or (one.positive and not value > 0)
        ]

    def _outputs(self, packed: bytes) -> Any:
        """A br_mpc_gp for each output, with its arrays where they are in ``packed``."""
        problem, ffi, at = self.manifest.problem, self._ffi, 0
        nz, data = len(problem.features), ffi.from_buffer(packed)
        outputs = ffi.new("br_mpc_gp[]", problem.outputs)
        for one in outputs if packed else ():
            if at + OUTPUT_HEAD.size > len(packed):
                break
            one.kernel, one.n, *amplitudes = OUTPUT_HEAD.unpack_from(packed, at)
            one.offset, one.scale, one.signal, one.noise = amplitudes
            at += OUTPUT_HEAD.size
            one.length_scales = numbers = ffi.cast("double *", data + at)
            one.inputs, one.alpha = numbers + nz, numbers + nz * (1 + one.n)
            at += 8 * (nz * (1 + one.n) + one.n)
        if at != len(packed):
            raise InputError(
                f"these are not the weights of the {problem.outputs} outputs that the residual of "
                f"problem '{problem.name}' has"
            )
        return outputs

    def load_weights(self, packed: bytes, version: str = "") -> None:
        """Uses weights (``bayesrace.gp.weights.pack_weights``) from the next step on; empty: no
        correction of the model. They are not compared with the manifest."""
        outputs = self._outputs(packed)
        self._check(self._library.br_mpc_set_weights(self.handle, outputs), "weights")
        self.weights_version = self._proven_version = version

    def stage_weights(self, packed: bytes) -> None:
        """Copies weights beside those in use, for :meth:`adopt_weights`; else as
        :meth:`load_weights`.

        The one method that another thread may call; the interpreter goes on meanwhile. InputError
        if they are unusable.
        """
        outputs = self._outputs(packed)
        self._check(self._library.br_mpc_stage_weights(self.handle, outputs), "weights")

    def adopt_weights(self, version: str = "") -> None:
        """Puts what is staged into use, between two steps; InputError if there is nothing.

        They are on probation: :meth:`watch` compares them with those that were proven before.
        """
        self._check(self._quick.br_mpc_adopt_weights(self._address), "weights")
        self.weights_version = version

    def prove_weights(self) -> None:
        """Ends the probation of the weights in use."""
        self._check(self._quick.br_mpc_prove_weights(self._address), "weights")
        self._proven_version = self.weights_version

    def revert_weights(self) -> None:
        """Goes back to the proven weights, between two steps."""
        self._check(self._quick.br_mpc_revert_weights(self._address), "weights")
        self.weights_version = self._proven_version

    def new_trial(self, probation: Mapping[str, Any]) -> Any:
        """A br_mpc_trial of weights that have just been adopted; ``probation``: a br_mpc_probation
        by name."""
        trial = self._ffi.new("br_mpc_trial *")
        self._probation = self._ffi.new("br_mpc_probation *", dict(probation))
        return trial

    def observe_trial(self, trial: Any, vx_mps: float, fallen_back: bool | None) -> None:
        """A state, and whether the fallback drove the cycle before; None: the car was not."""
        fell = ctypes.c_int(-1 if fallen_back is None else fallen_back)
        self._quick.br_mpc_observe_trial(self._pointer(trial), ctypes.c_double(vx_mps), fell)

    def judge_trial(self, trial: Any) -> int:
        """What is to be done about the weights on trial, between two steps: a br_mpc_ruling."""
        given = self._pointer(self._probation), self._pointer(trial)
        return int(self._quick.br_mpc_judge_trial(self._address, *given))

    def _pointer(self, to: Any) -> ctypes.c_void_p:
        return ctypes.c_void_p(int(self._ffi.cast("uintptr_t", to)))

    def samples(self) -> tuple[Floats, Floats, Floats]:
        """The newest samples of what the car has done, by the thread that steps: features (n, nz),
        residuals of the model without correction (n, ne), per stage, and the variances (n, ne) of
        these by what is estimated."""
        problem, count = self.manifest.problem, self._ffi.new("int *")
        widths, most = (len(problem.features), *[problem.outputs] * 2), self._library.BR_SAMPLES
        rows, given = zip(*(self._made(most, width) for width in widths), strict=True)
        self._check(self._library.br_mpc_get_samples(self.handle, *given, count), "samples")
        features, residuals, noise = (one[: count[0]] for one in rows)
        return features, residuals, noise

    def reset(self) -> None:
        """Forgets plan, working set and place on the line."""
        self._library.br_mpc_reset(self.handle)

    def step(
        self,
        x: Floats,
        u_before: npt.ArrayLike,
        *,
        elapsed_s: float | None = None,
        budget_s: float = 0.0,
        environment: Environment | None = None,
    ) -> Status:
        """One control step from the measured state x (nx,); results in ``u`` and ``info``.

        ``u_before`` (nu,): the input that acts now; a number stands for all components.
        ``elapsed_s``: since the state of the call before, of whatever status; None: one stage Ts.
        ``budget_s``: iterate until converged or within this time from now; 0: the iteration limits
        of the settings alone. InputError if ``elapsed_s`` is negative or not finite, or a limit of
        the ``environment`` no limit.
        """
        around = self._ffi.NULL
        if environment is not None:
            around = self._ffi.new("br_environment *", environment)
        return self._solved("step", x, u_before, around, self._elapsed(elapsed_s), budget_s)

    def solve(
        self,
        x: Floats,
        u_before: npt.ArrayLike,
        reference: Reference,
        *,
        elapsed_s: float | None = None,
        budget_s: float = 0.0,
    ) -> Status:
        """As :meth:`step`, with the stage parameters (N, np) of another planner."""
        numbers = self._given("reference", reference, *self._reference_shape)
        stages = self._ffi.cast("br_mpc_reference *", numbers)
        return self._solved("solve", x, u_before, self._elapsed(elapsed_s), budget_s, stages)

    def _solved(self, what: str, x: Floats, u_before: npt.ArrayLike, *arguments: Any) -> Status:
        if np.shape(x) != (self._nx,):
            raise InputError(f"x has shape {np.shape(x)}, not ({self._nx},)")
        self._x[:], self._u_before[:] = x, u_before
        given = self._x_given, self._u_before_given
        results = self._u, self._status, self.info
        call = getattr(self._library, f"br_mpc_{what}")
        self._check(call(self.handle, *given, *arguments, *results), what)
        return Status(self._status[0])

    def _elapsed(self, elapsed_s: float | None) -> float:
        return self.manifest.step_s if elapsed_s is None else elapsed_s

    def observe(
        self,
        x: Floats,
        u: Floats,
        duration_s: float,
        x_next: Floats,
        step_variance: Floats | None = None,
    ) -> None:
        """What the car did between two measured states (nx,), under u (nu,) on average.

        With caution, what the corrected model errs by is estimated, and corrected from then on.
        ``step_variance`` (nx,), of states that are estimates: by which their step differs from the
        car's. Of the mismatch they say nothing: an estimator has more to say (br_mpc_noise).
        InputError for a duration that is not above 0 and at most 1, or numbers that are not finite.
        """
        given = self._given("x", x, self._nx), self._given("u", u, self._nu)
        after = self._given("x_next", x_next, self._nx)
        noise = self._ffi.NULL
        if step_variance is not None:
            variances = self._given("step_variance", step_variance, self._nx)
            noise = self._ffi.new("br_mpc_noise *")
            self._ffi.memmove(noise.step, variances, self._ffi.sizeof(noise.step))
        error = self._library.br_mpc_observe(self.handle, *given, duration_s, after, noise)
        self._check(error, "observe")

    def prepare(self, elapsed_s: float | None = None, budget_s: float = 0.0) -> None:
        """Makes ready what of the next step needs no state; call it after :meth:`step`.

        ``elapsed_s``: expected of the next step; None: one stage Ts. With ``budget_s`` the last
        problem is iterated on first. Results in ``u``, ``info`` and the plan stay. Leaving it out,
        or another ``elapsed_s`` in the step, changes nothing but the time that the step takes.
        """
        elapsed = self._elapsed(elapsed_s)
        self._check(self._library.br_mpc_prepare(self.handle, elapsed, budget_s), "prepare")

    def rehearse(self) -> None:
        """Does the preparation over, to the same bits, so that the step finds its caches warm."""
        self._check(self._library.br_mpc_rehearse(self.handle), "rehearse")

    def predict(self, x: Floats, u: Floats, duration_s: float) -> Floats:
        """State (nx,) after x (nx,) with u (nu,) held, by the model and the weights in use.

        ``duration_s``: 0 to 1. InputError if it is not, or if a number is not finite or absurd.
        """
        given = self._given("x", x, self._nx), self._given("u", u, self._nu)
        x_next, result = self._made(self._nx)
        error = self._library.br_mpc_predict(self.handle, *given, duration_s, result)
        self._check(error, "predict")
        return x_next

    def propagate(
        self,
        x: Floats,
        u: Floats,
        duration_s: float,
        variance: Floats,
        begin: Floats | None = None,
        disturbance: Floats | None = None,
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """State (nx,) after at most a stage with u (nu,) held, its Jacobians (nx, nx) in x and
        (nx, ne) in the ``disturbance`` (ne,), a rate of change beside the residual, and the
        covariance (nx, nx) that the residual's ``variance`` (ne,) adds. ``begin`` (nx,): where the
        stage has begun, if not in x."""
        nx, problem = self._nx, self.manifest.problem
        at = self._given("begin", x if begin is None else begin, nx)
        outputs = problem.outputs
        beside = np.zeros(outputs) if disturbance is None else disturbance
        given = (
            self._given("x", x, nx), at, self._given("u", u, self._nu), duration_s,
            self._given("variance", variance, outputs),
            self._given("disturbance", beside, outputs),
        )  # fmt: skip
        shapes = (nx,), (nx, nx), (nx, outputs), (nx, nx)
        made = [self._made(*shape) for shape in shapes]
        results = (result for _, result in made)
        error = self._library.br_mpc_propagate(self.handle, *given, *results)
        self._check(error, "propagate")
        (x_next, _), (jacobian, _), (by_disturbance, _), (covariance, _) = made
        return x_next, jacobian, by_disturbance, covariance

    def read_plan(self) -> tuple[Floats, Floats]:
        """The last plan, x (N + 1, nx) and u (N, nu), in buffers that the next call overwrites."""
        self._library.br_mpc_get_plan(self.handle, self._plan_x, self._plan_u)
        return self.plan_x, self.plan_u

    def read_tube(self) -> Floats:
        """How uncertain the stages of the last plan are, (N,): :attr:`StepOutput.tube_m`. In a
        buffer that the next call overwrites."""
        self._library.br_mpc_get_tube(self.handle, self._tube)
        return self.tube

    def read_reference(self) -> Reference:
        """The stage parameters of the last step, (N, np)."""
        rows, numbers = self._made(*self._reference_shape)
        stages = self._ffi.cast("br_mpc_reference *", numbers)
        self._library.br_mpc_get_reference(self.handle, stages)
        return rows

    def variance(self, v: Floats) -> tuple[Floats, Floats]:
        """Posterior variance of the residual's outputs at v = [x; u] (nv,), noise included; and
        that of the noise."""
        made = self._made(outputs := self.manifest.problem.outputs), self._made(outputs)
        given = self._given("v", v, self._nx + self._nu)
        results = (result for _, result in made)
        self._check(self._library.br_mpc_variance(self.handle, given, *results), "variance")
        return made[0][0], made[1][0]

    def evaluate(self, v: Floats, costate: Floats) -> tuple[Floats, Floats, Floats]:
        """Corrected model at v = [x; u] (nv,): x_next (nx,), J (nx, nv), H of lambda' x_next."""
        nx, nv = self._nx, self._nx + self._nu
        given = self._given("v", v, nv), self._given("costate", costate, nx)
        made = self._made(nx), self._made(nx, nv), self._made(nv, nv)
        results = (result for _, result in made)
        self._check(self._library.br_mpc_evaluate(self.handle, *given, *results), "evaluate")
        (x_next, _), (jacobian, _), (hessian, _) = made
        return x_next, jacobian, hessian


class NativeStep(NativeProblem):
    """The control step of a car that follows a racing line."""

    def __init__(
        self,
        artefact: Path,
        car: Car,
        settings: MpcSettings,
        parameters: Mapping[str, float] | None = None,
    ) -> None:
        """``parameters``: what the problem has beyond those of ``settings``. InputError if it was
        built for another car."""
        super().__init__(artefact)
        self.manifest.check_car(car, artefact)
        self._line_mps, self._spacing_m = np.zeros(0), 0.0
        values = settings.parameters(car, self.manifest.problem.name) | dict(parameters or {})
        self.set_values(values)

    def set_parameters(self, car: Car, settings: MpcSettings) -> None:
        """Weights, limits and tolerances of the OCP; effective from the next step."""
        self.set_values(settings.parameters(car, self.manifest.problem.name))

    def set_path(self, table: "PathTable") -> None:
        """Racing line and track; copied. InputError if it has more rows than fit."""
        self.manifest.check_rows(count := len(table.rows))
        rows = self._given("path table", table.rows, count, PATH_COLUMNS)
        error = self._library.br_mpc_set_path(self.handle, rows, count, table.spacing_m)
        self._check(error, "path")
        self._rows = count

    def speeds(self) -> Floats:
        """The line's speeds at the path's rows (n,), as far as the weights in use know the car. The
        thread that stages weights may ask, too."""
        made, given = self._made(count := self._rows)
        self._check(self._library.br_mpc_get_speeds(self.handle, given, count), "speeds")
        return made

    @property
    def unknown_s(self) -> float:
        """What a lap loses to the line because the weights in use do not know the car there."""
        lost_s = self._ffi.new("double *")
        self._check(self._library.br_mpc_get_loss(self.handle, lost_s), "speeds")
        return float(lost_s[0])

    def set_weights(self, weights: Weights) -> None:
        """Uses the weights from the next step on; InputError if they are for another model."""
        weights.check_fit(self.manifest.discretisation, self.manifest.gp_capacity)
        self.load_weights(pack_weights(weights), weights.version)
