"""A run directory in memory: settings, track, racing line, and the messages of each run."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from pydantic import BaseModel, BeforeValidator, Field, ValidationError

from bayesrace.arrays import Floats
from bayesrace.columns import Columns, LogColumns, with_estimates
from bayesrace.errors import InputError, faults_in
from bayesrace.files import read_text
from bayesrace.integrators import PREDICTION, Discretisation
from bayesrace.learning.sources import CYCLES, STATES, TRUE_STATES
from bayesrace.messages import ACTUATION, EVENT, STATE, TELEMETRY, TRUTH, Numbering, Topic
from bayesrace.operation.analysis.laps import Trajectory
from bayesrace.raceline import RaceLine, read_raceline
from bayesrace.tracks import Track, read_track
from bayesrace.vehicles import Car, default_car, described_car

__all__ = [
    "LIMIT_FILES",
    "RUN_COLUMNS",
    "RUN_EVENT",
    "PlannedRun",
    "Recording",
    "RunRecord",
    "TrainingRecord",
    "read_recording",
    "runs_of",
]

_log = logging.getLogger("bayesrace.report")


LIMIT_FILES: Final = {"standing": "limit-standing.csv", "flying": "limit-flying.csv"}
"""In a run directory: the fastest laps that the car can drive, by their kind."""

RUN_EVENT: Final = "run"
"""Kind of the event that announces a run of a race before it starts."""


RUN_COLUMNS: Final[Mapping[Topic[Any], str]] = {
    STATE: f"{STATES} source_time_ns lap lockstep",
    TRUTH: f"{TRUE_STATES} lap",
    ACTUATION: "seq run weights_version",
    TELEMETRY: f"seq {CYCLES} solve_us",
    EVENT: "run source kind text data",
}
"""What is read of a run, in the order of the fields of a :class:`RunRecord`."""

_REMARKS: Final = ("weights_rolled_back", "weights_slowed")
_WORDS: Final = ("weights_version", "refused")


@dataclass(frozen=True)
class PlannedRun:
    """The controller of a run: the data of a ``kind="run"`` event from the race."""

    run: int
    controller: str
    weights_version: str
    refused: str = ""
    """Why the controller has refused its weights, so that it was not driven; else empty."""

    @classmethod
    def of_event(cls, data: Mapping[str, Any]) -> "PlannedRun | None":
        """The plan in the data of an event; None if it names no run."""
        run, controller = data.get("run"), data.get("controller")
        if type(run) is not int or type(controller) is not str:
            return None
        return cls(run, controller, *(str(data.get(one, "")) for one in _WORDS))


@dataclass(frozen=True, eq=False)
class RunRecord(Trajectory):
    """The messages of one run as columns, in the order in which they arrived."""

    plan: PlannedRun
    states: Columns
    truth: Columns
    actuations: Columns
    telemetry: Columns
    events: Columns
    unknown_s: float | None = field(default=None, kw_only=True)
    """What a lap loses where the line is faster than what its first weights have learned, by the
    controller; None without weights."""

    @property
    def moments(self) -> Columns:
        """The truth, sample by sample."""
        return self.truth

    @property
    def lockstep(self) -> bool:
        """Whether the plant waited for the controller."""
        return bool(self.states["lockstep"][:1].any())

    @property
    def weights_version(self) -> str:
        """Of the weights that drove, by the actuations; several are joined in order."""
        versions = dict.fromkeys(self.actuations["weights_version"])
        return " → ".join(versions) if versions else self.plan.weights_version

    @property
    def gaps(self) -> int:
        """Number of messages missing in the numbering, of states missing at the beginning, and of
        states without their truth."""
        states = self.states
        missing = sum(_missing(one["seq"]) for one in (states, self.actuations, self.telemetry))
        missing += len(np.setdiff1d(states["seq"], self.truth["seq"]))
        if len(states) > 1 and states["time_s"][0] > 0:
            step_s = states["time_s"][1] - states["time_s"][0]
            missing += round(states["time_s"][0] / step_s) if step_s > 0 else 1
        return missing

    @property
    def remarks(self) -> list[str]:
        """What the controller has reported of its weights in mid-run, in order."""
        own = self.events[self.events["source"] == "controller"]
        return list(own["text"][np.isin(own["kind"], _REMARKS)])

    @property
    def ended(self) -> str:
        """Why the run ended: the text of the plant's event, or where the log ends without one."""
        ends = (self.events["source"] == "plant") & (self.events["kind"] == "run_ended")
        if ends.any():
            return str(self.events["text"][ends][-1])
        if self.plan.refused:
            return f"the controller has refused its weights: {self.plan.refused}"
        if not len(self.states):
            return "the run never started"
        return (
            f"the log ends {self.states['time_s'][-1]:.2f} s into the run, before the plant "
            "reported its end: the plant or the race was killed"
        )


def _missing(numbers: Columns) -> int:
    """Messages lost by the rule of the processes: forged numbers and restarts are no losses."""
    numbering = Numbering()
    for seq in numbers.tolist():
        numbering.note(seq)
    return numbering.lost


def runs_of(log: LogColumns) -> dict[int, RunRecord]:
    """What has been read of each run in a log, by its number."""
    events = log[EVENT]
    announced = (events["source"] == "race") & (events["kind"] == RUN_EVENT)
    plans = [plan for data in events["data"][announced] if (plan := PlannedRun.of_event(data))]
    found = {plan.run: plan for plan in plans}
    for run in np.unique(np.concatenate([log[topic]["run"] for topic in RUN_COLUMNS])).tolist():
        found.setdefault(run, PlannedRun(run, "", ""))
    lost_s = _lost_s(events)
    return {
        run: RunRecord(
            plan,
            *(_of_run(log[topic], run) for topic in RUN_COLUMNS),
            unknown_s=lost_s.get(run),
        )
        for run, plan in sorted(found.items())
    }


def _lost_s(events: Columns) -> dict[int, float]:
    """``unknown_s`` of the weights that were accepted right before a run, by its number."""
    found, accepted = dict[int, float](), dict[str, Any]()
    for kind, data in zip(events["kind"], events["data"], strict=True):
        if kind == "weights_accepted":
            accepted = data
        elif kind == RUN_EVENT and (plan := PlannedRun.of_event(data)) is not None:
            if "unknown_s" in accepted and accepted.get("version") == plan.weights_version:
                found[plan.run] = float(accepted["unknown_s"])
            accepted = {}
    return found


def _of_run(rows: Columns, run: int) -> Columns:
    """Its rows, but for samples that repeat the one before, as after a fault of the plant."""
    own: Columns = rows[rows["run"] == run]
    if "time_s" in (own.dtype.names or ()) and len(own):
        own = own[np.append(True, np.diff(own["time_s"]) != 0)]
    return own


@dataclass(frozen=True, eq=False)
class TrainingRecord:
    """The last training drive of a race, or the controller's practice, with the track and the line
    that it was driven on."""

    run: RunRecord
    track: Track
    line: RaceLine
    x: Floats
    """States (n, 7) of all drives in the log."""


class _Mpc(BaseModel):
    constraints: bool = True
    caution: float = 0.0


class RunSettings(BaseModel):
    """What is needed of a race's ``settings.json``, also of one that an earlier version wrote."""

    car: Annotated[Car, BeforeValidator(described_car)] = Field(default_factory=default_car)
    track: str = "race"
    train_track: str = "train"
    mode: str = ""
    seed: int = 0
    laps: int = 0
    practice_laps: int | None = None
    discretisation: Discretisation = PREDICTION
    mpc: _Mpc = _Mpc()
    fmu: str | None = None
    simulator: str = "equations"


@dataclass(eq=False, kw_only=True)
class Recording:
    """A run directory: settings, track, racing line, and each run's messages."""

    directory: Path
    settings: RunSettings
    track: Track
    line: RaceLine
    runs: list[RunRecord]
    truth: bool
    """The log holds the truth; without it, as of a real car, measurements take its place."""
    truncated: bool
    """A log ends without its end mark, or that of a training drive cannot be read."""
    training: "TrainingRecord | None"
    """The training drive; None where weights were given, or it cannot be read."""
    practices: "list[TrainingRecord]"
    """The controller's own laps after it, of the same track and of larger copies of it; those that
    can be read."""
    refused: int
    """Messages of the log that could not be decoded."""
    started_ns: int | None
    """Calendar time of the first message [ns since 1970]."""

    @property
    def built_in(self) -> bool:
        """Whether the log is that of the built-in equations: the truth, of no other simulator."""
        return self.truth and not self.settings.fmu and self.settings.simulator == "equations"

    def run_of(self, controller: str) -> RunRecord | None:
        """The last run of that controller, None if it did not drive."""
        return next((run for run in reversed(self.runs) if run.plan.controller == controller), None)


def read_recording(run_dir: Path, log: LogColumns | None = None) -> Recording:
    """Reads a run directory, also one whose race was cut short; InputError if it is none.

    ``log``: its ``run.mcap`` with :data:`RUN_COLUMNS`, of which only the rest is read then.
    """
    settings = _read_settings(run_dir / "settings.json")
    track, line = _driven_on(run_dir, Path(settings.track).stem, "race")
    log = (log or LogColumns(run_dir / "run.mcap", RUN_COLUMNS)).read()
    firsts = [log[topic]["wall_ns"][:1] for topic in RUN_COLUMNS]
    runs, truth = _planned(log)
    trained_on = Path(settings.train_track).stem
    training, whole = _read_training(run_dir / "collect.mcap", trained_on, "train")
    practised = [
        _read_training(path, trained_on + path.stem.removeprefix("practice"), path.stem)
        for path in sorted(run_dir.glob("practice*.mcap"), key=lambda path: path.stem)
    ]
    return Recording(
        directory=run_dir, settings=settings, track=track, line=line, runs=runs, truth=truth,
        training=training, practices=[one for one, _ in practised if one is not None],
        truncated=log.reader.truncated or not all([whole, *(one for _, one in practised)]),
        refused=log.reader.refused, started_ns=min(map(int, np.concatenate(firsts)), default=None),
    )  # fmt: skip


def _driven_on(run_dir: Path, name: str, label: str) -> tuple[Track, RaceLine]:
    """A track of the run directory, with its name, and its line."""
    track = replace(read_track(run_dir / f"{label}.csv", car_width_m=0.0), name=name)
    return track, read_raceline(run_dir / f"{label}_raceline.csv", name)


def _read_training(path: Path, name: str, label: str) -> tuple[TrainingRecord | None, bool]:
    """A training drive on the track of that ``name``, if there was one, and whether its log is
    whole; ``label``: of its track and line.

    The race does not need it: where it cannot be read, it is left out.
    """
    if not path.is_file():
        return None, True
    try:
        log = LogColumns(path, RUN_COLUMNS).read()
        track, line = _driven_on(path.parent, name, label)
    except InputError as error:
        _log.warning("a training drive is left out: %s", error)
        return None, False
    runs, _ = _planned(log)
    if not runs:
        return None, False
    x = np.vstack([run.x for run in runs])
    whole = not (log.reader.truncated or log.reader.refused)
    return TrainingRecord(runs[-1], track, line, x), whole


def _planned(log: LogColumns) -> tuple[list[RunRecord], bool]:
    """The runs that were announced, in order, and whether the log holds their truth.

    Measurements take the place of the truth where no run has one.
    """
    runs = [run for run in runs_of(log).values() if run.plan.controller]
    if any(len(run.truth) for run in runs):
        return runs, True
    columns = RUN_COLUMNS[TRUTH].split()
    known = [with_estimates(run.states, run.telemetry)[columns] for run in runs]
    return [replace(run, truth=one) for run, one in zip(runs, known, strict=True)], False


def _read_settings(path: Path) -> RunSettings:
    text = read_text(path, "the settings", "give the directory of a race")
    try:
        return RunSettings.model_validate_json(text)
    except ValidationError as error:
        raise InputError(f"{path} holds no settings of a race: {faults_in(error)}") from None
