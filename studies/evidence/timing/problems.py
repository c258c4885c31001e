"""What the controller has to solve, recorded and adversarial, and how long each phase takes.

Every cycle is made as the controller's process makes it: the state is taken (estimate), answered
(feedback), and the next one prepared. A second controller gets the same states too late for a step:
its answer is the fallback's. Times are the thread's processor time, so that neither other processes
nor waiting count.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from msgspec import structs

from bayesrace.arrays import Floats
from bayesrace.controller.assembly import compiled_controller
from bayesrace.controller.cycle import Cycle
from bayesrace.controller.native_step import Artefact
from bayesrace.controller.settings import CycleSettings, MpcSettings
from bayesrace.files import temporary_folder
from bayesrace.gp.weights import Weights, read_weights
from bayesrace.messages import State
from bayesrace.operation.closed_loop import built_in_car
from bayesrace.operation.host import HostProgram
from bayesrace.operation.preparation import Prepared
from bayesrace.operation.run_plan import RunPlan, run_request
from bayesrace.operation.training_drives import PreparedTrack
from bayesrace.plant.car import CarRun, drive_lockstep
from bayesrace.plant.simulator import PLANT
from bayesrace.raceline import RaceLine
from bayesrace.realtime import uncollected
from bayesrace.studies.evidence.timing.instructions import Counts, count_instructions
from bayesrace.studies.evidence.timing.settings import TimingSettings
from bayesrace.tracks import Track
from bayesrace.vehicles import Car

__all__ = ["COLUMNS", "KINDS", "Case", "Rig", "search", "work"]

COLUMNS: Final = (
    "estimate", "feedback", "prepare", "fallback", "iterations", "qp_steps"
)  # fmt: skip
"""Of a cycle: times [ms], then counts of the feedback."""

_CYCLES: Final = 10
"""Of an adversarial case, from its start on."""

_TOO_LATE_S: Final = 2 * max(CycleSettings().stale_s, PLANT.step_s)
"""No step is made by a state of that age."""

_Range = tuple[Sequence[float], Sequence[float]]
KINDS: Final[dict[str, _Range]] = {
    "launch": ((0, -0.5, -3.14, 0, 0, 0, -0.5), (1, 0.5, 3.14, 0.1, 0, 0, 0.5)),
    "hairpin": ((-0.05, -1, -0.6, 0.4, -0.1, -0.1, -1), (0.05, 1, 0.6, 1.2, 0.1, 0.1, 1)),
    "spin": ((0, -1, -3.14, 0.1, -0.6, -0.3, -1), (1, 1, 3.14, 1, 0.6, 0.3, 1)),
    "off track": ((0, -4, -3.14, 0, -0.3, -0.1, -1), (1, 4, 3.14, 1, 0.3, 0.1, 1)),
    "weights": ((0, -1, -1, 0, -0.3, -0.1, -1), (1, 1, 1, 1, 0.3, 0.1, 1)),
}
"""Least and largest start: along the track, from its tightest bend for a hairpin, as a share of its
length; beside it, in half widths; heading off the track's; vx, vy as shares of the line's top
speed; yaw rate as one of top speed over wheelbase; steering angle of the largest."""


@dataclass(frozen=True)
class Case:
    """A start from which the controller drives for some cycles."""

    kind: str
    track: int
    start: tuple[float, ...]
    """As in :data:`KINDS`."""

    @classmethod
    def drawn(cls, kind: str, tracks: int, random: np.random.Generator) -> "Case":
        """Anywhere in its range."""
        start = random.uniform(*KINDS[kind])
        return cls(kind, int(random.integers(tracks)), tuple(start.tolist()))

    def changed(self, random: np.random.Generator) -> "Case":
        """Nearby, within its range."""
        low, high = np.array(KINDS[self.kind])
        start = np.array(self.start) + 0.1 * (high - low) * random.standard_normal(len(low))
        return replace(self, start=tuple(np.clip(start, low, high).tolist()))


class Rig:
    """Controllers of each track, with weights as given and with rough ones at full capacity."""

    def __init__(self, settings: TimingSettings, prepared: Prepared) -> None:
        self._settings, self._files = settings, prepared
        self.tracks: tuple[PreparedTrack, ...] = prepared.tracks
        self._car, self._vehicle = settings.driven_car, built_in_car(settings.driven_car)
        self._weights, self._run = read_weights(prepared.weights), 0
        self._made: dict[tuple[int, bool], tuple[Cycle, Cycle]] = {}
        self._states: list[State] = []
        """In the newest drive."""
        artefact, mpc = Artefact(prepared.artefacts[0]), MpcSettings()
        library, self._capacity = artefact.library, artefact.manifest.gp_capacity
        self.horizon = artefact.manifest.horizon
        starts = (library.BR_COLD_GUESSES + 1) * library.BR_SECOND_START_ITERATIONS
        self.most_qp_steps = mpc.qp_steps
        self.most_iterations = max(mpc.iterations, mpc.iterations_cold) + starts
        """Of a feedback, by construction: br_step.c."""

    def _answered(self, cycles: tuple[Cycle, Cycle], state: State, budget_s: float) -> list[float]:
        """Of a cycle by this state: what :data:`COLUMNS` says."""
        cycle, blind = cycles
        self._states.append(state)
        estimate = _timed(lambda: cycle.driver.observe(state))
        feedback, info = _timed(lambda: cycle.decide(state.time_s, budget_s)), cycle.driver.info
        counts = (info.iterations, info.qp_iterations) if cycle.driver.decision.stepped else (0, 0)
        prepare = _timed(lambda: cycle.prepare(PLANT.step_s, budget_s))
        blind.driver.observe(state)
        fallback = _timed(lambda: blind.decide(state.time_s + _TOO_LATE_S))
        return [estimate, feedback, prepare, fallback, *counts]

    def _begin(self, track: int, rough: bool = False) -> tuple[Cycle, Cycle]:
        """One that drives, and one for the fallback, for another run: its first state counts."""
        self._run += 1
        if (track, rough) not in self._made:
            files = self._parts(track, rough)
            cycle, blind = (
                Cycle(compiled_controller(*files), self._car, CycleSettings()) for _ in range(2)
            )
            self._made[track, rough] = cycle, blind
        for each in self._made[track, rough]:
            each.driver.lost(silent=False)
        self._states.clear()
        return self._made[track, rough]

    def _parts(self, track: int, rough: bool) -> tuple[Path, Car, Track, RaceLine, Weights]:
        """What a controller is made of."""
        one, weights = self.tracks[track], self._weights
        if rough:
            weights = _roughened(weights, self._capacity, self._settings.seed)
        return self._files.artefacts[0], self._car, one.track, one.line, weights

    def replay(self, states: Sequence[State]) -> Floats:
        """Cycles (n, 6) by the states of one run on the first track, whatever the answers are."""
        cycles = self._begin(0)
        again = (structs.replace(one, run=self._run) for one in states if not one.final)
        with uncollected():
            return np.array([self._answered(cycles, one, self._budget_s) for one in again])

    def drive(self, track: int, count: int) -> Floats:
        """Cycles (n, 6) of a drive from the start line."""
        return self._driven(self._begin(track), track, count, self._budget_s)

    def run(self, case: Case, budget_s: float | None = None) -> Floats:
        """Cycles (n, 6) from the case's start, with that budget; None: that of the settings."""
        cycles = self._begin(case.track, case.kind == "weights")
        budget_s = self._budget_s if budget_s is None else budget_s
        return self._driven(cycles, case.track, _CYCLES, budget_s, self._start(case))

    def count(self, case: Case) -> Counts:
        """Instructions of the phases (n, 3) in the case's cycles, without budgets."""
        self.run(case, budget_s=0.0)
        return self._count(case.track, case.kind == "weights")

    def count_recorded(self, most: int, states: Sequence[State] = ()) -> Counts:
        """The same of the first cycles of a run of logs, or of a drive from the start line."""
        if states:
            self.replay(states[:most])
        else:
            self.drive(0, most)
        return self._count(0)

    def _count(self, track: int, rough: bool = False) -> Counts:
        states = [structs.replace(one, lockstep=True) for one in self._states]
        with temporary_folder() as folder:
            host = HostProgram.made(folder, *self._parts(track, rough), MpcSettings())
            return count_instructions(host, states)

    @property
    def _budget_s(self) -> float:
        return self._settings.budget * self._settings.period_s

    def _driven(
        self, cycles: tuple[Cycle, Cycle], track: int, count: int, budget_s: float,
        x0: Sequence[float] = (),
    ) -> Floats:  # fmt: skip
        rows, decision = list[list[float]](), cycles[0].driver.decision

        def exchange(state: State, _: tuple[float, ...]) -> tuple[float, float]:
            if not state.final:
                rows.append(self._answered(cycles, state, budget_s))
            return decision.d, decision.delta_rate

        plan = RunPlan(self._run, "", 0, count * PLANT.step_s, lockstep=True)
        request = run_request(self.tracks[track].track, plan)
        request = structs.replace(request, x0=tuple(x0) or request.x0)
        run = CarRun(request, self._vehicle, 1, self._settings.instruments)
        with uncollected():
            drive_lockstep(run, 0, exchange)
        return np.array(rows)

    def _start(self, case: Case) -> list[float]:
        """The state (7,)."""
        along, beside, heading, vx, vy, yaw, steered = case.start
        one, car = self.tracks[case.track], self._car
        track, fastest = one.track, float(one.line.vx_mps.max())
        s = along * track.length_m
        if case.kind == "hairpin":
            nodes = np.linspace(0, track.length_m, 400, endpoint=False)
            s += float(nodes[np.argmax(np.abs(track.curvature(nodes)))])
        right, left = track.widths(s)
        x, y = track.position(s) + 0.5 * beside * (right + left) * track.normal(s)
        numbers = (
            x, y, float(track.heading(s)) + heading, vx * fastest, vy * fastest,
            yaw * fastest / car.wheelbase_m, steered * car.delta_max_rad,
        )  # fmt: skip
        return [float(one) for one in numbers]


def _timed(call: Callable[[], object]) -> float:
    """Processor time that this thread takes [ms]."""
    begin_ns = time.thread_time_ns()
    call()
    return 1e-6 * (time.thread_time_ns() - begin_ns)


def _roughened(weights: Weights, capacity: int, seed: int) -> Weights:
    """With as many points as fit, strewn about those learned, and shorter length scales."""
    random, outputs = np.random.default_rng(seed), []
    for one in weights.outputs:
        scales = one.length_scales * random.uniform(0.3, 1.0, one.length_scales.size)
        chosen = random.integers(max(one.count, 1), size=capacity)
        about = one.inputs[chosen] if one.count else np.zeros((capacity, scales.size))
        inputs = about + scales * random.standard_normal(about.shape)
        alpha = random.standard_normal(capacity) / np.sqrt(capacity)
        outputs.append(replace(one, length_scales=scales, inputs=inputs, alpha=alpha))
    first, second, third = outputs
    return replace(weights, version="rough", outputs=(first, second, third))


def work(rows: Floats) -> float:
    """Of the hardest cycle: iterations times QP steps. The same each time, as times are not."""
    return float((rows[:, 4] * rows[:, 5]).max())


def search(rig: Rig, cases: int, seed: int) -> Iterator[tuple[Case, Floats]]:
    """So many cases drawn at random, all kinds in turn, then as many that climb from the worst,
    each with its cycles, which have no budget: their work depends on nothing else."""
    random, names = np.random.default_rng(seed), tuple(KINDS)
    worst: list[tuple[float, Case]] = []
    for number in range(2 * cases):
        if number < cases:
            case = Case.drawn(names[number % len(names)], len(rig.tracks), random)
        else:
            case = worst[int(random.integers(len(worst)))][1].changed(random)
        rows = rig.run(case, budget_s=0.0)
        worst = sorted([*worst, (work(rows), case)], key=lambda one: -one[0])[:5]
        yield case, rows
