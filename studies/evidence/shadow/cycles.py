"""The cycles of a log in which a shadow has answered beside the controller that drove."""

from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from bayesrace.arrays import Floats, Rows
from bayesrace.columns import columns_of, with_estimates
from bayesrace.controller.native_step import Status
from bayesrace.errors import InputError
from bayesrace.learning.sources import CYCLES, STATES
from bayesrace.log import LogReader
from bayesrace.messages import (
    ACTUATION,
    EVENT,
    SHADOW_ACTUATION,
    SHADOW_TELEMETRY,
    STATE,
    TELEMETRY,
    Actuation,
    State,
    Telemetry,
)

__all__ = ["Beside", "Side", "read_cycles"]

_TOPICS: Final = (STATE, ACTUATION, TELEMETRY, EVENT, SHADOW_ACTUATION, SHADOW_TELEMETRY)
_NOT_DRIVEN: Final = (Status.HALTED, Status.NO_STATE)

_Cycle = tuple[Actuation, Telemetry]


@dataclass(frozen=True, eq=False)
class Side:
    """What one of the two has decided, a row for each cycle that both have."""

    u: Floats
    """Shape (n, 2): d [command], delta_rate [rad/s]."""
    level: Rows
    """Of the fallback; 0: a solution."""
    solve_us: Floats
    missed: int
    """Cycles that took longer than their period."""
    begins_s: Floats
    """Plant time at which each plan begins."""
    plans: list[Floats]
    """Predicted states (N + 1, 7); empty where there are none."""
    step_s: float
    """From one row of a plan to the next; 0: no plan tells."""
    versions: tuple[str, ...]
    """Of the weights in use."""


@dataclass(frozen=True, eq=False)
class Beside:
    """One shadow in one run."""

    run: int
    name: str
    lockstep: bool
    inputs: int
    """That the controller has sent while it drove."""
    driving: Side
    shadow: Side
    time_s: Floats
    """When each of the cycles was decided, shape (n,)."""
    x: Floats
    """State in which it was decided (n, 7), as it was measured or estimated."""
    came_s: Floats
    came: Floats
    """What came: times (m,) and states (m, 7) of the run."""


@dataclass
class _Run:
    """Messages of a run by their sender: the controller, "", or a shadow."""

    states: list[State] = field(default_factory=list)
    halted: set[tuple[int, float]] = field(default_factory=set)
    """Cycles in which the car was not to be driven."""
    sent: dict[str, list[Actuation]] = field(default_factory=lambda: defaultdict(list))
    reports: dict[str, list[Telemetry]] = field(default_factory=lambda: defaultdict(list))


def read_cycles(log: Path) -> list[Beside]:
    """Of each run and shadow; InputError without any."""
    runs: dict[int, _Run] = defaultdict(_Run)
    stopped = False
    for entry in LogReader(log).messages(_TOPICS):
        one: Any = entry.message
        parts = entry.key.split("/")
        sender = parts[3] if parts[2] == "shadow" else ""
        if isinstance(one, State):
            runs[one.run].states.append(one)
        elif isinstance(one, Telemetry):
            runs[one.run].reports[sender].append(one)
        elif isinstance(one, Actuation):
            runs[one.run].sent[sender].append(one)
            if not sender and (stopped or one.status in _NOT_DRIVEN):
                runs[one.run].halted.add((one.state_seq, one.decided_at_s))
        elif one.kind in ("stop", "hold_lost", "go", "run_started"):
            stopped = one.kind in ("stop", "hold_lost")
    found = [
        _beside(log, number, name, run)
        for number, run in sorted(runs.items())
        for name in sorted(run.sent.keys() - {""})
    ]
    if not found:
        raise InputError(f"{log}: no shadow has decided in it; start one with --shadow NAME")
    return found


def _beside(log: Path, number: int, name: str, run: _Run) -> Beside:
    own, other = _cycles(run, ""), _cycles(run, name)
    answered = {(one.state_seq, one.decided_at_s) for one in run.sent[name]}
    if len(answered) < len(run.sent[name]):
        raise InputError(
            f"{log}: run {number} has two shadows '{name}'; give each a name of its own"
        )
    known = with_estimates(
        columns_of(State, run.states, f"{STATES} lockstep"),
        columns_of(Telemetry, run.reports[""], CYCLES),
    )
    places = {seq: row for row, seq in enumerate(known["seq"].tolist())}
    driven = own.keys() - run.halted
    both = [one for one in own if one in driven and one in other and one[0] in places]
    if not both:
        raise InputError(f"{log}: run {number}: shadow '{name}' has answered no input")
    return Beside(
        run=number, name=name, lockstep=bool(known["lockstep"].any()), inputs=len(driven),
        driving=_side([own[one] for one in both]), shadow=_side([other[one] for one in both]),
        time_s=np.array([decided_at_s for _, decided_at_s in both]),
        x=known["x"][[places[seq] for seq, _ in both]],
        came_s=known["time_s"], came=known["x"],
    )  # fmt: skip


def _cycles(run: _Run, sender: str) -> dict[tuple[int, float], _Cycle]:
    """Inputs and how they came about, by the state and the time of the decision."""
    reports: dict[int, list[Telemetry]] = defaultdict(list)
    for one in run.reports[sender]:
        reports[one.state_seq].append(one)
    return {
        (sent.state_seq, sent.decided_at_s): (sent, reports[sent.state_seq].pop(0))
        for sent in run.sent[sender]
        if reports[sent.state_seq]
    }


def _side(cycles: list[_Cycle]) -> Side:
    plans = [np.reshape(report.plan_x, (-1, 7)) for _, report in cycles]
    return Side(
        u=np.array([sent.u for sent, _ in cycles]),
        level=np.array([report.fallback for _, report in cycles]),
        solve_us=np.array([report.solve_us for _, report in cycles]),
        missed=sum(report.missed for _, report in cycles),
        begins_s=np.array([sent.decided_at_s + report.delay_s for sent, report in cycles]),
        plans=plans,
        step_s=_step_s(plans, [np.reshape(report.plan_u, (-1, 2)) for _, report in cycles]),
        versions=tuple(dict.fromkeys(sent.weights_version for sent, _ in cycles)),
    )


def _step_s(plans: list[Floats], inputs: list[Floats]) -> float:
    """The steering angle is the integral of the planned rate: that tells the step."""
    pairs = [(np.diff(x[:, 6]), u[:, 1]) for x, u in zip(plans, inputs, strict=True) if len(x)]
    if not pairs:
        return 0.0
    turned, rate = map(np.concatenate, zip(*pairs, strict=True))
    return round(float(turned @ rate / max(rate @ rate, 1e-12)), 4)
