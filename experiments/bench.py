"""The compiled step beside the paper's formulation in CasADi + IPOPT, on the same problems.

Closed loops on several tracks, with hairpins, give the problems; the weights come from another one.
Each is solved by the real-time step, which is timed, and by a second copy that iterates to
convergence, from which the first input's and the cost's distance are taken. Evenly spread among
them, ``peers`` are solved as the published code does: forward Euler, expanded to scalars, IPOPT
with its default options, from zeros. (With our discretisation, whose pose depends on the GP too,
that takes four times as long: no fair peer.)
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field
from rich.console import Console
from rich.table import Table

from bayesrace.gp.corrected import corrected_function
from bayesrace.gp.weights import GpWeights
from bayesrace.integrators import PREDICTION, Discretisation
from bayesrace.raceline.cached import racing_line
from bayesrace.tracks import DEFAULT_RACE_TRACK, DEFAULT_TRAINING_TRACK, Track, load_track
from bayesrace.vehicles import CarParameters, CarSetting, default_car
from bayesrace.vehicles.models import dynamic, e_kinematic
from codegen.build import build
from codegen.compiler import find_compiler
from codegen.ocp import OcpNlp
from codegen.problems.tracking import tracking
from codegen.settings import BuildSettings
from controller.native_step import NativeStep, StepStatus
from controller.path_table import make_path_table
from controller.settings import MpcSettings
from experiments.preparation import trained_weights, training_samples
from experiments.progress import Stages
from learning.training import TrainingSettings
from plant.simulator import Simulator

__all__ = ["BenchResult", "BenchSettings", "run_bench"]

Floats = NDArray[np.float64]

_START_SPEED_MPS: Final = 0.1
_CONVERGED: Final = MpcSettings(iterations=100, iterations_cold=100, tolerance=1e-9, settle=0)
_PUBLISHED: Final = Discretisation(scheme="euler", step_s=PREDICTION.step_s)
"""The published controller predicts with forward Euler; the mean changes the velocities alone."""


class BenchError(RuntimeError):
    """There is nothing to compare with."""


class BenchSettings(BaseModel):
    """What is measured."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    tracks: tuple[str, ...] = Field(
        (DEFAULT_RACE_TRACK, "random:11", "random:15"), min_length=1, description="driven on"
    )
    train_track: str = DEFAULT_TRAINING_TRACK
    car: CarSetting = Field(default_factory=default_car)
    problems: int = Field(900, ge=10, description="control steps in closed loop, all tracks")
    peers: int = Field(25, ge=1, description="of these, solved by IPOPT")
    points: int = Field(400, ge=20, le=1024, description="training points per output")
    seed: int = Field(0, ge=0)


class Times(BaseModel):
    """Of one solver, in microseconds."""

    p50: float
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
        for name in ("solver", "problems", "p50 us", "p99 us", "max us"):
            table.add_column(name, justify="left" if name == "solver" else "right")
        rows = (("compiled step", self.problems, self.step_us),
                ("CasADi + IPOPT, expanded, cold", self.peers, self.ipopt_us))  # fmt: skip
        for name, count, t in rows:
            table.add_row(name, str(count), f"{t.p50:.0f}", f"{t.p99:.0f}", f"{t.max:.0f}")
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
    second_starts: int = 0

    def __iadd__(self, other: "_Recording") -> "_Recording":
        self.problems += other.problems
        self.step_us += other.step_us
        self.second_starts += other.second_starts
        return self


def run_bench(settings: BenchSettings, stages: Stages) -> BenchResult:
    """Measures; takes about a minute, most of it IPOPT's."""
    find_compiler()  # what is missing is told now, not after the training
    car = settings.car
    with stages.stage("racing lines and training drive"):
        courses = [load_track(name, car.width_m) for name in settings.tracks]
        lines = [racing_line(course, car) for course in courses]
        training = load_track(settings.train_track, car.width_m)
        samples = training_samples(training, car, car.tuning.pursuit.drive_s, settings.seed)
    with stages.stage("train the residual") as stage:
        options = TrainingSettings(capacity=settings.points, seed=settings.seed)
        weights = trained_weights(samples, PREDICTION, options, progress=stage.update)
    with stages.stage("build"):
        artefact, manifest = build(BuildSettings(car=car))
        horizon = manifest.horizon
        step, converged = (_controller(artefact, car, s, weights) for s in _pair())
    with stages.stage("closed loop"):
        recording = _Recording()
        for course, line in zip(courses, lines, strict=True):
            for one in (step, converged):
                one.set_path(make_path_table(course, line, car.tuning.path.spacing_m))
            _record(step, converged, course, car, 50)  # caches, branch predictors, clock frequency
            recording += _record(
                step, converged, course, car, -(-settings.problems // len(courses))
            )
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
        gaps = [_gap(oracle, car, step, p) for p in recording.problems if p.has_converged]
    return _result(settings, weights, recording, times, solved, agreement, gaps)


def _pair() -> tuple[MpcSettings, MpcSettings]:
    return MpcSettings(), _CONVERGED


def _controller(
    artefact: Path, car: CarParameters, mpc: MpcSettings, weights: GpWeights
) -> NativeStep:
    step = NativeStep(artefact, car, mpc)
    step.set_weights(weights)
    return step


def _record(
    step: NativeStep, converged: NativeStep, track: Track, car: CarParameters, count: int
) -> _Recording:
    """Closed loop from the start line; the real-time step drives, the other one looks on."""
    simulator, recording = Simulator(dynamic(car)), _Recording()
    x, y, psi = track.start_pose()
    simulator.reset([x, y, psi, _START_SPEED_MPS, 0.0, 0.0, 0.0])
    for one in (step, converged):
        one.reset()
    for _ in range(count):
        state, d_previous = simulator.x.copy(), simulator.u_applied[0]
        begin_ns = time.perf_counter_ns()
        status = step.step(state, d_previous)
        recording.step_us.append((time.perf_counter_ns() - begin_ns) * 1e-3)
        recording.second_starts += step.info.second_start > 0
        plan = tuple(part.copy() for part in step.read_plan())
        other = converged.step(state, d_previous)
        best = tuple(part.copy() for part in converged.read_plan())
        recording.problems.append(
            _Problem(
                state, d_previous, step.read_reference(), (plan[0], plan[1]), (best[0], best[1]),
                converged.info.cost, status.usable and other is StepStatus.CONVERGED,
            )
        )  # fmt: skip
        simulator.step(step.u.tolist() if status.usable else None)
    return recording


def _peers(recording: _Recording, count: int) -> list[_Problem]:
    rows = np.linspace(0, len(recording.problems) - 1, count).round().astype(int)
    return [recording.problems[row] for row in dict.fromkeys(rows.tolist())]


def _parameters(car: CarParameters) -> dict[str, float]:
    return MpcSettings().parameters(car)


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
    p50, p99, most = np.percentile(values, [50, 99, 100])
    return Times(p50=float(p50), p99=float(p99), max=float(most))


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
