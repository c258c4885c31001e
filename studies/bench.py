"""The control step as it is driven, and the paper's formulation in CasADi + IPOPT beside it.

A case is a problem (tracking, progress) with a caution (the default, none). Its states are those of
drives on several tracks, with hairpins, by the controller as in real time; the weights come from
another track. The control cycle gets these states again, with nothing else between: without any
preparation, which gives the inputs of lockstep, and prepared as in real time. Either goes on from
its own plan before. Then once more: before a step the controller's memory is copied, the step is
iterated to convergence, and the memory put back. So each first input is compared with the solution
that the same plan, with the same caution about it, leads to.

Evenly spread among the steps of tracking without caution, ``peers`` are solved as the published
code does: forward Euler, expanded to scalars, IPOPT with its default options, from zeros. (With our
discretisation, whose pose depends on the GP too, that takes four times as long: no fair peer.)
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel
from rich.console import Console

from bayesrace.arrays import Floats
from bayesrace.codegen.ocp import OcpNlp
from bayesrace.codegen.problems.tracking import tracking
from bayesrace.codegen.settings import ProblemName
from bayesrace.controller.assembly import PredictiveController, compiled_controller
from bayesrace.controller.cycle import Cycle
from bayesrace.controller.native_step import NativeStep, Status
from bayesrace.controller.process_settings import ControllerSettings
from bayesrace.controller.settings import MpcSettings
from bayesrace.gp.expression import corrected_function
from bayesrace.gp.weights import Weights, read_weights
from bayesrace.integrators import PREDICTION, Discretisation
from bayesrace.messages import State
from bayesrace.operation.closed_loop import built_in_car
from bayesrace.operation.preparation import prepare, progress_artefact
from bayesrace.operation.run_plan import RunPlan, run_request
from bayesrace.operation.terminal.terminal import Stages, plain_table
from bayesrace.plant.car import CarRun, drive_lockstep
from bayesrace.plant.simulator import PLANT
from bayesrace.plant.vehicle import Vehicle
from bayesrace.studies.settings import PUBLISHED, BenchSettings
from bayesrace.tracks import Track
from bayesrace.vehicles import Car
from bayesrace.vehicles.models import e_kinematic

__all__ = ["BenchResult", "BenchSettings", "run_bench"]

Part = Literal["whole step", "preparation", "feedback"]

_PUBLISHED_STEP: Final = Discretisation(scheme="euler", step_s=PREDICTION.step_s)
"""The published controller predicts with forward Euler; the mean changes the velocities alone."""

_PREPARATION_S: Final = 0.8 * PLANT.step_s
"""Budget of a preparation in real time."""
_WARM_UP: Final = 50
"""Steps that are not timed."""

_CONVERGED: Final[dict[ProblemName, tuple[float, int]]] = {
    "tracking": (1e-9, 1), "progress": (1e-8, 6)
}  # fmt: skip
"""KKT residual of a converged solution, and of every how many steps one is sought. Some
of progress take many iterations."""

_STRICT: Final = {
    "tol": 1e-12, "constr_viol_tol": 1e-12, "compl_inf_tol": 1e-15, "bound_relax_factor": 0.0,
    "mu_init": 1e-9,
}  # fmt: skip
"""Of IPOPT as a check: a barrier left at its usual size would push weakly active bounds inwards."""


class BenchError(RuntimeError):
    """There is nothing to compare with."""


class Times(BaseModel):
    """In microseconds."""

    p50: float
    p90: float
    p99: float
    max: float


class Errors(BaseModel):
    """Absolute difference to the converged solution."""

    p95: float
    p99: float


class Row(BaseModel):
    """A part of the control step in one case."""

    problem: ProblemName
    caution: float
    part: Part
    """The whole step, not prepared; the preparation, with the budget of real time; what is left of
    the step after it, which a state waits for."""
    us: Times
    d: Errors | None
    """Of this part's own first input, drive command; None: it gives no input."""
    delta_rate: Errors | None
    """The same of the steering rate [rad/s]."""
    compared: int
    """Steps behind the errors: usable, and with a converged solution, which was sought ..."""
    sought: int
    """... for so many."""


class Peer(BaseModel):
    """IPOPT, on some of the published problems."""

    us: Times
    peers: int
    solved: int
    """Peers for which IPOPT reported success."""
    speedup_p50: float
    """Of our whole step."""
    agreement: float
    """Largest difference of first inputs between IPOPT, started from our converged plan, and it."""


class BenchResult(BaseModel):
    """What ``bayesrace bench --json`` writes."""

    gp_points: int
    problems: int
    """Steps behind the times of each row."""
    rows: tuple[Row, ...]
    ipopt: Peer

    @property
    def published(self) -> Row:
        """Our whole step on the problems that IPOPT solves."""
        return next(row for row in self.rows if (row.problem, row.caution) == PUBLISHED)

    def print(self, console: Console) -> None:
        """A table for a person."""
        known = min(row.compared / row.sought for row in self.rows)
        table = plain_table(
            "problem at caution", "time\np50", "µs\np90", "\np99", "\nmax",
            "steering\np95", "rad/s\np99", "command\np95", "\np99", padding=0,
        )  # fmt: skip
        for row in self.rows:
            if row.part == "whole step":
                table.add_row(f"{row.problem} at {row.caution:g}")
            errors = [e for one in (row.delta_rate, row.d) if one for e in (one.p95, one.p99)]
            table.add_row(f"  {row.part}", *_texts(row.us), *(f"{e:.2g}" for e in errors))
        table.add_row("paper's, in IPOPT", *_texts(self.ipopt.us))
        console.print(table)
        console.print(
            f"{self.problems} steps a case, 3 x {self.gp_points} points. Whole step: not prepared, "
            "with the inputs of lockstep. Preparation and feedback: in real time; feedback is what "
            "a state waits for. Steering, command: error of the line's own first input against the "
            f"converged solution, known for {known:.0%} of the steps or more. IPOPT: the paper's "
            "formulation in CasADi, expanded, cold, on "
            f"{self.ipopt.peers} steps of tracking without caution; our whole step is "
            f"{self.ipopt.speedup_p50:.0f} times as fast (p50). From our converged plans IPOPT "
            f"differs by {self.ipopt.agreement:.1e} at most.",
            highlight=False,
        )


def _texts(times: Times) -> list[str]:
    return [f"{us:.0f}" for us in (times.p50, times.p90, times.p99, times.max)]


class _Solution(NamedTuple):
    """A control step, solved to convergence."""

    x: Floats
    d_before: float
    reference: Floats
    plan: tuple[Floats, Floats]


class _Steps(NamedTuple):
    """The steps of a drive, made in one way."""

    step_us: Floats
    prepare_us: Floats
    error: Floats
    """Of the first input, shape (compared, 2)."""
    solutions: list[_Solution]
    sought: int


def run_bench(settings: BenchSettings, stages: Stages) -> BenchResult:
    """Measures; takes some three minutes."""
    car = settings.driven_car
    prepared = prepare(settings, settings.driven_on, stages)
    weights, count = read_weights(prepared.weights), -(-settings.problems // len(prepared.tracks))
    vehicle, artefacts = built_in_car(car), {"tracking": prepared.artefacts[0]}
    if ("progress", 0.0) in settings.cases:
        with stages.stage("build the controller of progress"):
            artefacts["progress"] = progress_artefact(settings)
    rows: list[Row] = []
    published: list[_Solution] = []
    for problem, caution in settings.cases:
        with stages.stage(f"{problem}, caution {caution:g}"):
            mpc = MpcSettings(caution=caution)
            whole, fast = [], []
            for one in prepared.tracks:
                files = artefacts[problem], car, one.track, one.line, weights, mpc
                drive = _Drive(problem, car, mpc, partial(compiled_controller, *files))
                drive.record(one.track, vehicle, count)
                whole.append(drive.steps(None))
                fast.append(drive.steps(_PREPARATION_S))
            parts: tuple[tuple[Part, list[_Steps]], ...] = (
                ("whole step", whole), ("preparation", fast), ("feedback", fast)
            )  # fmt: skip
            rows += [_row(problem, caution, part, steps) for part, steps in parts]
        if (problem, caution) == PUBLISHED:
            published = [solution for one in whole for solution in one.solutions]
            step_us = rows[-3].us
    return BenchResult(
        gp_points=max(weights.counts),
        problems=count * len(prepared.tracks),
        rows=tuple(rows),
        ipopt=_peer(settings, weights, published, step_us.p50, stages),
    )


class _Drive:
    """A drive on one track, whose steps can be made again."""

    def __init__(
        self,
        problem: ProblemName,
        car: Car,
        mpc: MpcSettings,
        make: Callable[[], PredictiveController],
    ) -> None:
        """``make``: a new controller for this problem with these settings."""
        tolerance, self._every = _CONVERGED[problem]
        endless = {"iterations": 1000, "iterations_cold": 1000, "early_stop_tol": 0.0}
        endless["qp_steps"] = 1_000_000
        self._exact = mpc.model_copy(update=endless | {"tolerance": tolerance})
        self._car, self._make = car, make
        self.states: list[State] = []

    def _cycle(self, controller: PredictiveController) -> Cycle:
        return Cycle(controller, self._car, ControllerSettings(car=self._car))

    def record(self, track: Track, vehicle: Vehicle, count: int) -> None:
        """Drives so many steps from the start line, prepared as in real time."""
        cycle = self._cycle(self._make())

        def exchange(state: State, _: tuple[float, ...]) -> tuple[float, float]:
            self.states.append(state)
            cycle.driver.observe(state)
            decision = cycle.decide(state.time_s)
            cycle.prepare(PLANT.step_s, _PREPARATION_S)
            return decision.d, decision.delta_rate

        request = run_request(track, RunPlan(1, "", 0, count * PLANT.step_s, lockstep=True))
        drive_lockstep(CarRun(request, vehicle, epoch=1), 0, exchange)
        self.states.pop()  # nothing answers the last one

    def steps(self, budget_s: float | None) -> _Steps:
        """All of them, each prepared with that budget; None: none is prepared."""
        controller, found = self._make(), {}
        self._replay(controller, self.states[:_WARM_UP], budget_s)
        *_, step_us, prepare_us = self._replay(controller, self.states, budget_s).T
        sought = range(0, len(self.states), self._every)

        def solve(k: int) -> None:
            if k in sought and (solution := self._converged(controller.native, self.states[k])):
                found[k] = solution

        d, delta_rate, usable, *_ = self._replay(controller, self.states, budget_s, solve).T
        own = np.column_stack((d, delta_rate))
        pairs = [(own[k], one.plan[1][0]) for k, one in found.items() if usable[k]]
        error = np.array([np.abs(u - exact) for u, exact in pairs]).reshape(-1, 2)
        return _Steps(step_us, prepare_us, error, list(found.values()), len(sought))

    def _replay(
        self,
        controller: PredictiveController,
        states: Sequence[State],
        budget_s: float | None,
        before: Callable[[int], None] = lambda k: None,
    ) -> Floats:
        """Of each step a row: drive command, steering rate, usable, time of step and preparation.

        ``before`` is called with the number of a state before its step.
        """
        cycle, rows = self._cycle(controller), []
        for k, state in enumerate(states):
            cycle.driver.observe(state)
            before(k)
            one = cycle.decide(state.time_s)
            row = one.d, one.delta_rate, one.status == 0, one.step_us
            if budget_s is not None:
                cycle.prepare(PLANT.step_s, budget_s)
            rows.append((*row, cycle.timing.prepare_us))
        return np.array(rows)

    def _converged(self, native: NativeStep, state: State) -> _Solution | None:
        """What the next step would iterate to; leaves the controller as it was."""
        size = native.artefact.library.br_mpc_memory_size()
        memory = native.artefact.ffi.buffer(native.handle, size)
        before = memory[:]
        native.set_parameters(self._car, self._exact)
        x = np.array(state.x)
        status = native.step(x, state.u_applied)
        plan_x, plan_u = native.read_plan()
        plan = plan_x.copy(), plan_u.copy()
        solution = _Solution(x, state.u_applied[0], native.read_reference(), plan)
        memory[:] = before
        return solution if status is Status.CONVERGED else None


def _row(problem: ProblemName, caution: float, part: Part, steps: list[_Steps]) -> Row:
    """One line: the steps of all drives."""
    gives_input = part != "preparation"
    us = np.concatenate([one.step_us if gives_input else one.prepare_us for one in steps])
    error = np.concatenate([one.error for one in steps])
    if not len(error):
        raise BenchError(f"{problem}, caution {caution:g}: no step has a converged solution")
    d, delta_rate = map(_errors, error.T) if gives_input else (None, None)
    return Row(
        problem=problem, caution=caution, part=part, us=_times(us), d=d, delta_rate=delta_rate,
        compared=len(error), sought=sum(one.sought for one in steps),
    )  # fmt: skip


def _peer(
    settings: BenchSettings, weights: Weights, solutions: list[_Solution], step_p50: float,
    stages: Stages,
) -> Peer:  # fmt: skip
    """IPOPT, on steps evenly spread among these."""
    car, horizon = settings.driven_car, len(solutions[0].reference)
    chosen = np.linspace(0, len(solutions) - 1, settings.peers).round().astype(int)
    steps = [solutions[k] for k in dict.fromkeys(chosen.tolist())]
    model, parameters = e_kinematic(car), MpcSettings(caution=0.0).parameters(car)
    problem, solved = tracking(model, PREDICTION), 0
    times: list[float] = []
    apart: list[float] = []
    with stages.stage("IPOPT, expanded (builds for some 15 s)") as stage:
        f = corrected_function(model, _PUBLISHED_STEP, weights, check_identity=False)
        ocp = OcpNlp(problem, f, horizon, expand=True)
        for step in steps:
            stage.update(len(times) / len(steps))
            out = ocp.solve(step.x, step.d_before, step.reference, parameters)
            times.append(out.seconds * 1e6)
            solved += out.success
    with stages.stage("check against IPOPT"):
        f = corrected_function(model, PREDICTION, weights)
        oracle = OcpNlp(problem, f, horizon, options=_STRICT)
        for step in steps:
            out = oracle.solve(step.x, step.d_before, step.reference, parameters, step.plan)
            if out.success:
                apart.append(float(np.abs(out.u[0] - step.plan[1][0]).max()))
    if not apart:
        raise BenchError("IPOPT solved none of the problems that it was to check")
    us = _times(np.array(times))
    return Peer(
        us=us, peers=len(steps), solved=solved, speedup_p50=us.p50 / step_p50, agreement=max(apart)
    )


def _times(values: Floats) -> Times:
    p50, p90, p99, most = np.percentile(values, [50, 90, 99, 100]).tolist()
    return Times(p50=p50, p90=p90, p99=p99, max=most)


def _errors(values: Floats) -> Errors:
    p95, p99 = np.percentile(values, [95, 99]).tolist()
    return Errors(p95=p95, p99=p99)
