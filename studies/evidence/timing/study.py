"""Times what was recorded and what is hard, and judges it."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from pydantic import BaseModel

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.log import LogReader
from bayesrace.messages import STATE, State
from bayesrace.operation.preparation import prepare
from bayesrace.operation.terminal.terminal import Stages
from bayesrace.studies.evidence.timing.instructions import COUNTED, Counts, missing
from bayesrace.studies.evidence.timing.problems import COLUMNS, Case, Rig, search, work
from bayesrace.studies.evidence.timing.settings import TimingSettings
from bayesrace.studies.evidence.timing.tail import Tail, fit_tail
from bayesrace.studies.evidence.verdict import Check, Verdict

__all__ = ["PHASES", "Study", "TimingResult", "run_timing"]

PHASES: Final = ("estimate", "feedback", "answer", "prepare", "fallback")
"""Of a cycle; the answer is estimate and feedback, what a state waits for."""

_HARDEST: Final = 5
"""Starts that are named; the instructions of the first are counted."""

_BLOCK: Final = 5
"""Cycles of which the longest counts as one value of the tail: neighbours are alike."""


class Times(BaseModel):
    """Of a phase [ms]."""

    name: str
    """The problems, and the phase."""
    p50: float
    p99: float
    p999: float
    max: float
    tail: Tail | None
    """Of the answer and the fallback to recorded problems; None: not fitted, or too few."""

    @property
    def usable(self) -> Tail | None:
        """The tail, where it is not rejected."""
        return None if self.tail is None or self.tail.rejected else self.tail


class Hardest(BaseModel):
    """The most that a feedback without budget has taken, and can take."""

    name: str
    most: int
    bound: int
    """By construction."""


class Counted(BaseModel):
    """Instructions of a phase; its name is as that of its :class:`Times`."""

    name: str
    p50: int
    most: int


class TimingResult(BaseModel):
    """``timing.json``."""

    car: str
    tracks: tuple[str, ...]
    rate_hz: float
    limit_ms: float
    horizon: int
    cycles: dict[str, int]
    times: tuple[Times, ...]
    hardest: tuple[Hardest, ...]
    worst: tuple[str, ...]
    """The starts that take the most, hardest first."""
    instructions: tuple[Counted, ...]
    """Without budgets; of the hardest start in place of all adversarial ones."""
    not_counted: str
    """Why they are not; empty: they are."""
    statement: str


@dataclass(frozen=True, eq=False)
class Study:
    """All that was measured."""

    result: TimingResult
    verdict: Verdict
    values: dict[str, Floats]
    """Times [ms] by problems and phase."""


def run_timing(settings: TimingSettings, logs: Sequence[Path], stages: Stages) -> Study:
    """Prepares, measures and judges. InputError for logs or files that cannot be used."""
    runs = list(_runs(logs))
    prepared = prepare(
        settings, settings.driven_on, stages, weights=settings.weights, artefact=settings.artefact
    )
    rig = Rig(settings, prepared)
    with stages.stage("recorded problems"):
        recorded = list(_recorded(rig, runs, settings.problems))
    with stages.stage("search for the worst") as stage:
        found = list[tuple[Case, Floats]]()
        for one in search(rig, settings.cases, settings.seed):
            found.append(one)
            stage.update(len(found) / (2 * settings.cases))
    with stages.stage("adversarial problems"):
        adversarial = [rig.run(case) for case, _ in found]
    found.sort(key=lambda one: -work(one[1]))
    hardest, not_counted = found[:_HARDEST], missing() if settings.count else "--count is 0"
    instructions = tuple[Counted, ...]()
    if not not_counted:
        with stages.stage("count of instructions"):
            instructions = (
                *_counted("recorded", rig.count_recorded(settings.count, runs[0] if runs else ())),
                *_counted("adversarial", rig.count(hardest[0][0])),
            )
    drives = {"recorded": recorded, "adversarial": adversarial}
    everything = np.vstack([*recorded, *adversarial, *(rows for _, rows in found)])
    values = {
        f"{name} {phase}": ms
        for name, some in drives.items()
        for phase, ms in _phases(np.vstack(some)).items()
    }
    times = tuple(_times(name, ms, recorded, settings.exceedance) for name, ms in values.items())
    result = TimingResult(
        car=settings.car.name, tracks=tuple(one.track.name for one in rig.tracks),
        rate_hz=settings.rate_hz, limit_ms=settings.limit_ms, horizon=rig.horizon,
        cycles={name: sum(map(len, some)) for name, some in drives.items()},
        times=times, hardest=tuple(_hardest(rig, everything)), instructions=instructions,
        not_counted=not_counted, worst=tuple(_text(rig, case, rows) for case, rows in hardest),
        statement=_statement(next(one for one in times if one.name == "recorded answer")),
    )  # fmt: skip
    checks = sorted(_checks(result, len(everything)), key=lambda one: one.subject)
    return Study(result, Verdict("timing", tuple(checks)), values)


def _runs(logs: Sequence[Path]) -> Iterator[list[State]]:
    """States of each run in the logs that has some."""
    for path in logs:
        states = LogReader(path).select(STATE)
        if not states:
            raise InputError(f"{path}: no states in it; give the log of a drive")
        for run in sorted(Counter((one.epoch, one.run) for one in states)):
            yield [one for one in states if (one.epoch, one.run) == run]


def _recorded(rig: Rig, runs: Sequence[list[State]], problems: int) -> Iterator[Floats]:
    """Cycles of the logs, or else of drives. Logs are of the first track."""
    track = rig.tracks[0].track
    for states in runs:
        known = np.array([one.x[:2] for one in states if not one.estimated]).reshape(-1, 2)
        if len(known) and np.median(track.project_points(known).off_track_m) > 0:
            raise InputError(f"the log's car was not on {track.name}: name its --track")
        yield rig.replay(states)
    if not runs:
        for number in range(len(rig.tracks)):
            yield rig.drive(number, problems // len(rig.tracks))


def _phases(rows: Floats) -> dict[str, Floats]:
    estimate, feedback, prepare, fallback = rows[:, :4].T
    times = estimate, feedback, estimate + feedback, prepare, fallback
    return dict(zip(PHASES, times, strict=True))


def _blocks(drives: Sequence[Floats], phase: str) -> Floats:
    """The longest time of each block of a drive but the first, which holds the launch."""
    found = [_phases(rows)[phase] for rows in drives]
    whole = (one[_BLOCK : len(one) // _BLOCK * _BLOCK].reshape(-1, _BLOCK) for one in found)
    return np.concatenate([one.max(axis=1) for one in whole if one.size] or [np.zeros(0)])


def _times(name: str, ms: Floats, recorded: Sequence[Floats], exceedance: float) -> Times:
    p50, p99, p999, most = np.percentile(ms, [50, 99, 99.9, 100]).tolist()
    fitted = name in ("recorded answer", "recorded fallback")
    tail = fit_tail(_blocks(recorded, name.split()[1]), exceedance) if fitted else None
    return Times(name=name, p50=p50, p99=p99, p999=p999, max=most, tail=tail)


def _counted(problems: str, counts: Counts) -> Iterator[Counted]:
    for phase, column in zip(COUNTED, counts.T, strict=True):
        name = f"{problems} {phase}"
        yield Counted(name=name, p50=int(np.median(column)), most=int(column.max()))


def _hardest(rig: Rig, everything: Floats) -> Iterator[Hardest]:
    bounds = {"iterations": rig.most_iterations, "qp_steps": rig.most_qp_steps}
    for name, bound in bounds.items():
        most = int(everything[:, COLUMNS.index(name)].max())
        yield Hardest(name=name, most=most, bound=bound)


def _text(rig: Rig, case: Case, rows: Floats) -> str:
    iterations, qp_steps = rows[:, 4:6].max(axis=0).astype(int)
    track = rig.tracks[case.track].track.name
    return f"{case.kind} on {track}: {iterations} iterations, {qp_steps} QP steps"


def _checks(result: TimingResult, feedbacks: int) -> Iterator[Check]:
    limit = result.limit_ms
    for one in result.times:
        problems, phase = one.name.split()
        if phase in ("answer", "prepare", "fallback"):
            text = f"{one.max:.3g} ms of {result.cycles[problems]}"
            yield Check(phase, f"{problems}: at most {limit:g} ms", one.max <= limit, text)
        if one.usable:
            what = f"all but {one.usable.exceedance:g} of the blocks: at most {limit:g} ms"
            text = f"{one.usable.upper:.3g} ms with confidence {one.usable.confidence:.0%}"
            yield Check(phase, what, one.usable.upper <= limit, text)
    for hard in result.hardest:
        what = f"by construction at most {hard.bound} {hard.name}"
        text = f"{hard.most} of {feedbacks} feedbacks"
        yield Check("work of a feedback", what, hard.most <= hard.bound, text)


def _statement(answer: Times) -> str:
    if (tail := answer.usable) is None:
        rejected = answer.tail and f"the fit is rejected: {answer.tail.rejected}"
        why = rejected or "too few different times"
        return f"The answer took at most {answer.max:.3g} ms; nothing is stated beyond it: {why}."
    return (
        f"The controller answers within {tail.upper:.3g} ms with confidence {tail.confidence:.0%} "
        f"in all but {tail.exceedance:g} of the blocks of {_BLOCK} cycles after a launch, on this "
        f"machine, undisturbed, with these tracks and weights (shape {tail.shape:.2f}, "
        f"{tail.peaks} peaks, goodness of fit p = {tail.goodness_p:.2f})."
    )
