"""The controller as an object with ``step``, for control loops of one's own."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter_ns
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from bayesrace.api.values import (
    Input,
    Range,
    State,
    car_of,
    finite_input,
    number,
    track_of,
    validated,
)
from bayesrace.arrays import Floats
from bayesrace.controller.assembly import PredictiveController, compiled_controller
from bayesrace.controller.driver import Driver, Level
from bayesrace.controller.native_step import NativeStep, Status
from bayesrace.controller.settings import CycleSettings, GateSettings, MpcSettings
from bayesrace.controller.weights.checks import Checks, Samples
from bayesrace.errors import InputError
from bayesrace.gp.weights import Weights, encode_weights, read_weights
from bayesrace.integrators import PERFECT, PREDICTION
from bayesrace.messages import SENSOR_FAULTS
from bayesrace.messages import State as Measured
from bayesrace.raceline import RaceLine, check_line, racing_line
from bayesrace.tracks import Track
from bayesrace.vehicles import Car

if TYPE_CHECKING:
    from bayesrace.codegen.problems.problem import Problem

__all__ = ["Controller", "Step", "Times"]


@dataclass(slots=True)
class Times:
    """How long the parts of a step took [us]."""

    solve_us: float
    """Execution time of the compiled step, from state to input."""
    prepare_us: float
    """Preparation of the next step, after the input was known; 0 if it is yet to be made."""


@dataclass(slots=True)
class Step:
    """Result of one control step; its arrays are copies."""

    u: Input
    """To apply until the next step."""
    plan: Floats
    """Predicted states, shape (N + 1, 7), from the moment at which the input acts; empty, (0, 7),
    where no plan was made."""
    plan_u: Floats
    """Planned inputs, shape (N, 2) or (0, 2)."""
    tube: Floats
    """How far the car may be off to either side at stages 1 to N [m], at the probability of the
    setting ``caution``, shape (N,) or (0,)."""
    status: Status
    """What became of the optimisation problem."""
    level: Level
    """Who gave the input: the solution, the plan before, the fallback's braking, or stop."""
    fault: str
    """Fault found in the state that was given (``"position"``, ``"steering"``, ``"frozen"`` and the
    like, docs/faults.md), also where ``dt`` is wrong or :meth:`Controller.reset` was forgotten;
    empty: none."""
    times: Times


_NO_PLAN: Final = np.zeros((0, 7)), np.zeros((0, 2)), np.zeros(0)
_STATUS: Final = {int(one): one for one in Status}
"""Found faster than by the enum itself."""


class Controller:
    """The predictive controller of one car on one track, as a controller process has it: planner,
    delay compensation, monitor of the states, step, and fallback. For one thread.

    A step costs some 13 us beyond the compiled code. A run begins with the first step, and after
    each :meth:`reset`.
    """

    def __init__(
        self,
        car: Car | Path | str,
        track: Track | Path | str,
        line: RaceLine | None = None,
        *,
        problem: "str | Problem" = "tracking",
        model: Literal["e_kinematic", "dynamic"] = "e_kinematic",
        weights: Weights | Path | str | None = None,
        horizon: int | None = None,
        settings: Mapping[str, Any] | None = None,
        parameters: Mapping[str, float] | None = None,
        delay_s: float | None = None,
    ) -> None:
        """Generates and compiles C the first time, which takes some seconds, and takes it from the
        cache from then on.

        - ``line``: what is followed; None: :func:`bayesrace.racing_line` of car and track.
        - ``problem``: ``"tracking"`` (the paper's: follow the line at its speed), ``"progress"``
          (as fast as possible), or one of your own, made by ``bayesrace.ocp.driving_problem``.
        - ``model``: what it predicts by, ``"e_kinematic"``, which weights correct, or
          ``"dynamic"``, the simulator's own: BestCase.
        - ``weights``: the correction to begin with, or its file.
        - ``horizon``: stages that it looks ahead, 2 to 100; None: as the car's file says.
        - ``settings``: of the optimisation by name, such as ``{"caution": 0}``; those of
          ``bayesrace controller --settings`` (``controller/settings.py``).
        - ``parameters``: values of what a problem of your own has beyond the settings.
        - ``delay_s``: from a state to the moment at which its input acts, where that is known and
          constant; None: what :meth:`step` is given counts.

        InputError names what does not fit together.
        """
        from bayesrace.codegen.build import build
        from bayesrace.codegen.settings import BuildSettings

        self.car = car = car_of(car)
        """Whose limits hold."""
        self.track = track = track_of(track, car)
        """Where it is driven."""
        if line is not None and not isinstance(line, RaceLine):
            raise InputError(
                f"line = {type(line).__name__}: give what bayesrace.racing_line returns"
            )
        self.line = line if line is not None else racing_line(track, car)
        """What is followed."""
        _check_direction(self.line, track)
        check_line(self.line, track, car, "the racing line")
        wanted: dict[str, Any] = {"car": car, "model": model, "horizon": horizon}
        if model == "dynamic":
            wanted |= {"discretisation": PERFECT, "gp_capacity": 8}
        own = None if isinstance(problem, str) else problem
        if own is None:
            wanted["problem"] = problem
        else:
            _check_problem(own, car, model)
        self._settings: MpcSettings = validated(MpcSettings, dict(settings or {}))
        self.artefact, _ = build(validated(BuildSettings, wanted), problem=own)
        """Folder of the compiled controller, as ``bayesrace build`` names it."""
        self._predictive: PredictiveController = compiled_controller(
            self.artefact, car, track, self.line, None, self._settings, parameters=parameters
        )
        self._parameters = dict(parameters or {})
        compensation = None if delay_s is None else {"mode": "fixed", "delay_s": delay_s}
        self._cycle_settings = validated(CycleSettings, {"compensation": compensation})
        self._driver = Driver(self._predictive, car, self._cycle_settings)
        self._range = Range(car, track)
        self._run = self._seq = 0
        self._weights: Weights | None = None
        self.reset()
        if weights is not None:
            self.weights = read_weights(weights) if isinstance(weights, Path | str) else weights

    @property
    def native(self) -> NativeStep:
        """The compiled step, for measurements: its info, reference, evaluation."""
        return self._predictive.native

    @property
    def step_s(self) -> float:
        """Length of a stage, and the usual time between two steps [s]."""
        return self.native.manifest.step_s

    @property
    def weights(self) -> Weights | None:
        """The correction of the model that drives from the next step on; None: none.

        Weights are checked when they are set, as published ones are: InputError for those of
        another car or model, with absurd corrections, or that predict worse than no correction, on
        their own samples or on what the car has done last.
        """
        return self._weights

    @weights.setter
    def weights(self, weights: Weights | None) -> None:
        if weights is None:
            self.native.load_weights(b"")
        elif not isinstance(weights, Weights):
            raise InputError(
                f"weights = {type(weights).__name__}: give what bayesrace.train or "
                "Weights.from_sklearn returns"
            )
        else:
            checks = Checks(GateSettings(), self.artefact, self.car, self._parameters)
            recent = Samples(*self.native.samples())
            packed = checks.check_start(encode_weights(weights), recent)
            self.native.load_weights(packed, weights.version)
        self._weights = weights

    def set_parameters(self, **values: float) -> None:
        """Changes weights and limits of the optimisation by name, such as ``margin_m``, from the
        next step on; InputError for a name that the problem has not, or an impossible value."""
        self.native.set_values(values)

    def __repr__(self) -> str:
        name, problem = self.track.name, self.native.manifest.problem.name
        return f"<Controller of '{self.car.name}' on '{name}': {problem}, {self._weights!r}>"

    def reset(self) -> None:
        """The next state is the first of a run: nothing is known of the car's past."""
        self._driver.lost(silent=False)
        self._run += 1
        self._steps, self._dt, self._begin_s = 0, 0.0, 0.0
        self._u = (0.0, 0.0)
        self._first = True

    def step(
        self,
        state: State | ArrayLike | None,
        dt: float | None = None,
        *,
        u_applied: Input | ArrayLike | None = None,
        delay_s: float | None = None,
        prepare: bool = True,
    ) -> Step:
        """One control step from a measured state.

        - ``state``: in the order of :class:`.State`, SI units; None: nothing was measured. The
          last one is then predicted forward for a while, until the fallback brakes.
        - ``dt``: time since the state before [s]; None: :attr:`step_s`. The first state has none.
        - ``u_applied``: the input that acted meanwhile, on average; None: what the step before
          returned.
        - ``delay_s``: how long after its state the newest input began to act; later states are
          predicted by as much.
        - ``prepare``: False leaves it to you to call :meth:`prepare` once the input is on its way.

        InputError for a state, an input or a time that cannot be; nothing has happened then.
        """
        x = None if state is None else self._range.checked(state)
        applied = self._u if u_applied is None else finite_input(u_applied, "u_applied")
        if delay_s is not None:
            number(delay_s, "delay_s", 0.0, 1.0, "seconds, at most 1")
        time_s = self._clock(self.step_s if dt is None else dt)
        driver = self._driver
        if x is not None:
            delays = () if delay_s is None else (float(max(self._seq - 1, 0)), delay_s, delay_s)
            driver.observe(
                Measured(
                    seq=self._seq, source_time_ns=0, epoch=1, run=self._run, time_s=time_s, x=x,
                    u_applied=applied, lap=0, lockstep=True, actuation_delays=delays, final=False,
                    estimated=False, readings=(),
                )
            )  # fmt: skip
            self._seq += 1
            time_s = driver.time_s  # not the state's own where that is not believed
        elif self._first:
            raise InputError("state = None: the first step of a run needs a state")
        self._first = False
        decision = driver.decide(time_s)
        self._u = decision.d, decision.delta_rate
        plan, plan_u, tube = _NO_PLAN
        if decision.stepped:
            native = self.native
            plan, plan_u = native.read_plan()
            plan, plan_u, tube = plan.copy(), plan_u.copy(), native.read_tube().copy()
        return Step(
            Input(*self._u), plan, plan_u, tube, _STATUS[decision.status], decision.level,
            SENSOR_FAULTS[decision.fault],
            Times(decision.step_us, self.prepare() if prepare else 0.0),
        )  # fmt: skip

    def prepare(self) -> float:
        """Prepares the next step, for a state that comes an interval after the last; how long it
        took [us]."""
        begin_ns = perf_counter_ns()
        self._driver.prepare(self._driver.interval_s, 0.0)
        return (perf_counter_ns() - begin_ns) * 1e-3

    def _clock(self, dt: float) -> float:
        """Plant time of the state, without the rounding of a sum; InputError for no time."""
        if not (isinstance(dt, int | float | np.number) and 0.0 < dt <= 10.0):
            raise InputError(f"dt = {dt!r:.60}: give seconds since the state before, above 0")
        if self._first:
            return 0.0
        dt = float(dt)
        if dt != self._dt:
            self._begin_s, self._steps, self._dt = self._begin_s + self._steps * self._dt, 0, dt
        self._steps += 1
        return self._begin_s + self._steps * dt


def _check_problem(problem: "Problem", car: Car, model: str) -> None:
    """InputError unless it drives this car along a line, and predicts as weights are learned."""
    from bayesrace.vehicles.models import MODELS

    if not problem.path:
        raise InputError(
            f"problem '{problem.name}' drives no car along a line: step it by bayesrace.Mpc"
        )
    stage = PERFECT if model == "dynamic" else PREDICTION
    x, u, e = np.array([0.0, 0, 0.1, 1.5, 0.1, 1, 0.1]), np.array([0.3, 0.2]), np.zeros(3)
    expected = stage.corrected(MODELS[model](car))(x, u, e)
    if not np.allclose(problem.f(x, u, e), expected, rtol=1e-9, atol=1e-12):
        raise InputError(
            f"problem '{problem.name}' does not predict as the {model} model of '{car.name}' does "
            f"over {stage.step_s:g} s: make it of bayesrace.ocp.{model}(car) and "
            f"{'PERFECT' if model == 'dynamic' else 'PREDICTION'}"
        )


def _check_direction(line: RaceLine, track: Track) -> None:
    """InputError for a line that is driven the other way round."""
    heading = track.heading(track.project_path(line.xy_m).s_m)
    if float(np.mean(np.cos(line.psi_rad - heading))) < 0:
        raise InputError(
            f"the racing line '{line.track_name}' runs against the track '{track.name}': turn one "
            "of them round, the track by track.driven_from(reverse=True)"
        )
