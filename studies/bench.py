"""The compiled step beside the paper's formulation in CasADi + IPOPT, on the same problems.

Closed loops on several tracks, with hairpins, give the problems; the weights come from another one.
Each is solved by the real-time step, which is timed, by a copy that is prepared beforehand and
timed from the state to the input, and by one that iterates to convergence, from which the first
input's and the cost's distance are taken. Evenly spread among them, ``peers`` are solved as the
published code does: forward Euler, expanded to scalars, IPOPT with its default options, from zeros.
(With our discretisation, whose pose depends on the GP too, that takes four times as long: no fair
peer.)
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from pydantic import BaseModel, Field
from rich.console import Console
from rich.table import Table

from bayesrace.arrays import Floats
from bayesrace.gp.corrected import corrected_function
from bayesrace.gp.weights import GpWeights, read_weights
from bayesrace.integrators import PREDICTION, Discretisation
from bayesrace.manifest import read_manifest
from bayesrace.tracks import DEFAULT_RACE_TRACK
from bayesrace.vehicles import CarParameters
from bayesrace.vehicles.models import e_kinematic
from codegen.ocp import OcpNlp
from codegen.problems.tracking import tracking
from controller.assembly import compiled_controller
from controller.interface import Environment, StepOutput
from controller.native_step import NativeStep, StepStatus
from controller.python_controller import PythonController
from controller.settings import MpcSettings
from operation.closed_loop import ClosedLoop
from operation.preparation import prepare
from operation.settings import PreparationSettings
from operation.terminal.progress import Stages
from plant.simulator import PLANT

__all__ = ["BenchResult", "BenchSettings", "run_bench"]


_NOMINAL: Final = MpcSettings(caution=0.0)
"""The problem that IPOPT and acados solve knows no uncertainty."""

_PREPARATION_S: Final = 0.8 * PLANT.step_s
"""Budget of a preparation in real time."""

_CONVERGED: Final = MpcSettings(
    caution=0.0, iterations=100, iterations_cold=100, tolerance=1e-9, early_stop_tol=0
)
_PUBLISHED: Final = Discretisation(scheme="euler", step_s=PREDICTION.step_s)
"""The published controller predicts with forward Euler; the mean changes the velocities alone."""


class BenchError(RuntimeError):
    """There is nothing to compare with."""


class BenchSettings(PreparationSettings):
    """What is measured."""

    tracks: tuple[str, ...] = Field(
        (), description="driven on; none: the car's race track, and two beside the 1:43 one"
    )
    problems: int = Field(900, ge=10, description="control steps in closed loop, all tracks")
    peers: int = Field(25, ge=1, description="of these, solved by IPOPT")

    @property
    def driven_on(self) -> tuple[str, ...]:
        """The tracks, in order; random ones are 1:43 circuits."""
        race = self.car.race_track
        more = ("random:11", "random:15") if race == DEFAULT_RACE_TRACK else ()
        return self.tracks or (race, *more)


class Times(BaseModel):
    """Of one solver, in microseconds."""

    p50: float
    p90: float
    p99: float
    max: float


class Errors(BaseModel):
    """Absolute difference to the converged solution."""

    p95: float
    p99: float


class InputErrors(BaseModel):
    """Of the first input: duty cycle [-], steering rate [rad/s]."""

    d: Errors
    delta_rate: Errors


class CostGap(BaseModel):
    """Objective of the planned inputs, rolled out through the model, over the optimum, less 1."""

    p50: float
    p95: float


class BenchResult(BaseModel):
    """What ``bayesrace bench --json`` writes."""

    step_us: Times
    """The whole step, without preparation."""
    feedback_us: Times
    """The same steps, to the same bits, after their preparation: from the state to the input."""
    ipopt_us: Times
    speedup_p50: float
    u0_error: InputErrors
    cost_gap: CostGap
    gp_points: int
    problems: int
    peers: int
    ipopt_solved: int
    """Peers for which IPOPT reported success."""
    unconverged: int
    """Problems without a converged solution to compare with; left out of the errors."""
    second_starts: int
    """Steps that looked for another plan beside the one that went on from before."""
    ipopt_agreement: float
    """Largest difference of first inputs between IPOPT, started from our converged plan, and it."""

    def print(self, console: Console) -> None:
        """A table for a person."""
        table = Table(title=f"one GP-MPC step, N = 20, 3 x {self.gp_points} points")
        for name in ("solver", "problems", "p50 us", "p90 us", "p99 us", "max us"):
            table.add_column(name, justify="left" if name == "solver" else "right")
        rows = (("compiled step", self.problems, self.step_us),
                ("after preparation", self.problems, self.feedback_us),
                ("CasADi + IPOPT, expanded, cold", self.peers, self.ipopt_us))  # fmt: skip
        for name, count, t in rows:
            times = (f"{us:.0f}" for us in (t.p50, t.p90, t.p99, t.max))
            table.add_row(name, str(count), *times)
        console.print(table)
        d, rate = self.u0_error.d, self.u0_error.delta_rate
        console.print(
            f"{self.speedup_p50:.0f} times faster (p50). First input against the converged "
            f"solution: d p95 {d.p95:.2g}, p99 {d.p99:.2g}; delta_rate p95 {rate.p95:.2g}, "
            f"p99 {rate.p99:.2g} rad/s. Cost gap p50 {self.cost_gap.p50:.1e}, "
            f"p95 {self.cost_gap.p95:.1e}. IPOPT from the converged plan differs by at most "
            f"{self.ipopt_agreement:.1e}. Second starts: {self.second_starts}.",
            highlight=False,
        )


@dataclass
class _Problem:
    """One control step: what was asked, what the real-time step and the converged one answered."""

    x: Floats
    d_previous: float
    reference: Floats
    plan: tuple[Floats, Floats]
    converged: tuple[Floats, Floats]
    converged_cost: float
    has_converged: bool


@dataclass
class _Recording:
    problems: list[_Problem] = field(default_factory=list)
    step_us: list[float] = field(default_factory=list)
    feedback_us: list[float] = field(default_factory=list)
    second_starts: int = 0

    def __iadd__(self, other: "_Recording") -> "_Recording":
        self.problems += other.problems
        self.step_us += other.step_us
        self.feedback_us += other.feedback_us
        self.second_starts += other.second_starts
        return self


def run_bench(settings: BenchSettings, stages: Stages) -> BenchResult:
    """Measures; takes about a minute, most of it IPOPT's."""
    car = settings.driven_car
    prepared = prepare(settings, settings.driven_on, stages)
    weights, artefact = read_weights(prepared.weights), prepared.artefacts[0]
    horizon = read_manifest(artefact).horizon
    with stages.stage("closed loop"):
        recording = _Recording()
        for one in prepared.tracks:
            steps = (
                compiled_controller(artefact, car, one.track, one.line, weights, mpc).native
                for mpc in (_NOMINAL, _NOMINAL, _CONVERGED)
            )
            recorder = _Recorder(*steps)
            controller = PythonController(artefact, recorder)
            loop = ClosedLoop(car, one.track, one.line, controller)
            for count in (50, -(-settings.problems // len(prepared.tracks))):
                recorder.recording = _Recording()  # without those that warm up
                loop.drive(0, count * PLANT.step_s)
            recording += recorder.recording
    with stages.stage("IPOPT, expanded (builds for some 15 s)") as stage:
        peers = _peers(recording, settings.peers)
        problem = tracking(e_kinematic(car), PREDICTION)
        published = corrected_function(e_kinematic(car), _PUBLISHED, weights, check_identity=False)
        times, solved = _published(
            OcpNlp(problem, published, horizon, expand=True), car, peers, stage.update
        )
    with stages.stage("check against IPOPT"):
        # A barrier left at its usual size would push weakly active bounds inwards.
        strict = {
            "tol": 1e-12,
            "constr_viol_tol": 1e-12,
            "compl_inf_tol": 1e-15,
            "bound_relax_factor": 0.0,
            "mu_init": 1e-9,
        }
        f = corrected_function(e_kinematic(car), PREDICTION, weights)
        oracle = OcpNlp(problem, f, horizon, options=strict)
        agreement = _agreement(oracle, car, peers)
        gaps = [_gap(oracle, car, recorder.whole, p) for p in recording.problems if p.has_converged]
    return _result(settings, weights, recording, times, solved, agreement, gaps)


class _Recorder:
    """Drives by the real-time step, whole and unprepared; two copies solve the same problems: one
    that is prepared as in the control loop, and one that iterates to convergence."""

    def __init__(self, whole: NativeStep, prepared: NativeStep, converged: NativeStep) -> None:
        self.whole, self._prepared, self._converged = whole, prepared, converged
        self.recording = _Recording()

    def reset(self) -> None:
        """All start cold."""
        for step in (self.whole, self._prepared, self._converged):
            step.reset()

    def predict(self, x: Floats, u: Floats, duration_s: float) -> Floats:
        """By the model of all."""
        return self.whole.predict(x, u, duration_s)

    def step(
        self,
        x: Floats,
        u_previous: Floats,
        environment: Environment,
        elapsed_s: float,
        budget_s: float = 0.0,
    ) -> StepOutput:
        """Records the problem and the answers."""
        step, converged, recording = self.whole, self._converged, self.recording
        begin_ns = time.perf_counter_ns()
        status = step.step(x, u_previous, elapsed_s=elapsed_s, budget_s=budget_s)
        recording.step_us.append((time.perf_counter_ns() - begin_ns) * 1e-3)
        step.read_plan()
        self._prepared.rehearse()
        begin_ns = time.perf_counter_ns()
        self._prepared.step(x, u_previous, elapsed_s=elapsed_s, budget_s=budget_s)
        recording.feedback_us.append((time.perf_counter_ns() - begin_ns) * 1e-3)
        self._prepared.prepare(elapsed_s, _PREPARATION_S)
        recording.second_starts += step.info.second_start > 0
        other = converged.step(x, u_previous, elapsed_s=elapsed_s)
        converged.read_plan()
        recording.problems.append(
            _Problem(
                x.copy(),
                float(u_previous[0]),
                step.read_reference(),
                (step.plan_x.copy(), step.plan_u.copy()),
                (converged.plan_x.copy(), converged.plan_u.copy()),
                converged.info.cost,
                status.usable and other is StepStatus.CONVERGED,
            )
        )
        return StepOutput(
            step.u,
            0 if status.usable else status,
            plan_u=step.plan_u,
            plan_step_s=step.manifest.step_s,
        )


def _peers(recording: _Recording, count: int) -> list[_Problem]:
    rows = np.linspace(0, len(recording.problems) - 1, count).round().astype(int)
    return [recording.problems[row] for row in dict.fromkeys(rows.tolist())]


def _parameters(car: CarParameters) -> dict[str, float]:
    return _NOMINAL.parameters(car)


def _published(
    ocp: OcpNlp, car: CarParameters, problems: list[_Problem], progress: Callable[[float], None]
) -> tuple[list[float], int]:
    times: list[float] = []
    solved = 0
    for problem in problems:
        progress(len(times) / len(problems))
        out = ocp.solve(problem.x, problem.d_previous, problem.reference, _parameters(car))
        times.append(out.seconds * 1e6)
        solved += out.success
    return times, solved


def _agreement(oracle: OcpNlp, car: CarParameters, problems: list[_Problem]) -> float:
    differences = []
    for p in (p for p in problems if p.has_converged):
        out = oracle.solve(p.x, p.d_previous, p.reference, _parameters(car), p.converged)
        if out.success:
            differences.append(float(np.abs(out.u[0] - p.converged[1][0]).max()))
    if not differences:
        raise BenchError("IPOPT solved none of the problems that it was to check")
    return max(differences)


def _gap(oracle: OcpNlp, car: CarParameters, step: NativeStep, problem: _Problem) -> float:
    """What the planned inputs really cost, relative to the optimum."""
    x = [problem.x]
    for u in problem.plan[1]:
        x.append(step.evaluate(np.concatenate([x[-1], u]), np.zeros(7))[0])
    cost = oracle.cost(
        np.array(x),
        problem.plan[1],
        problem.d_previous,
        problem.reference,
        _parameters(car),
    )
    return cost / problem.converged_cost - 1.0


def _times(values: list[float]) -> Times:
    p50, p90, p99, most = np.percentile(values, [50, 90, 99, 100])
    return Times(p50=float(p50), p90=float(p90), p99=float(p99), max=float(most))


def _errors(values: Floats) -> Errors:
    p95, p99 = np.percentile(values, [95, 99])
    return Errors(p95=float(p95), p99=float(p99))


def _result(
    settings: BenchSettings, weights: GpWeights, recording: _Recording, ipopt_us: list[float],
    solved: int, agreement: float, gaps: list[float],
) -> BenchResult:  # fmt: skip
    good = [p for p in recording.problems if p.has_converged]
    error = np.abs([p.plan[1][0] - p.converged[1][0] for p in good])
    step, ipopt = _times(recording.step_us), _times(ipopt_us)
    p50, p95 = np.percentile(gaps, [50, 95])
    return BenchResult(
        step_us=step,
        feedback_us=_times(recording.feedback_us),
        ipopt_us=ipopt,
        speedup_p50=ipopt.p50 / step.p50,
        u0_error=InputErrors(d=_errors(error[:, 0]), delta_rate=_errors(error[:, 1])),
        cost_gap=CostGap(p50=float(p50), p95=float(p95)),
        gp_points=max(weights.counts),
        problems=len(recording.problems),
        peers=len(ipopt_us),
        ipopt_solved=solved,
        unconverged=len(recording.problems) - len(good),
        second_starts=recording.second_starts,
        ipopt_agreement=agreement,
    )
