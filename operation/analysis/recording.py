"""A run directory in memory: settings, track, racing line, and the messages of each run."""

import json
import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import ValidationError

from bayesrace.arrays import Floats
from bayesrace.errors import InputError, faults_in
from bayesrace.files import read_text
from bayesrace.integrators import PREDICTION, Discretisation
from bayesrace.log import LogReader
from bayesrace.messages import (
    ACTUATION,
    EVENT,
    STATE,
    TELEMETRY,
    TRUTH,
    Actuation,
    CarSample,
    Event,
    State,
    Telemetry,
    Truth,
)
from bayesrace.raceline import RaceLine, read_raceline
from bayesrace.tracks import Track, read_track
from bayesrace.transport import Numbering
from bayesrace.vehicles import DEFAULT_CAR, CarParameters, described_car
from operation.analysis.laps import Trajectory

__all__ = [
    "RUN_EVENT",
    "PlannedRun",
    "Recording",
    "RecordingReader",
    "RunRecord",
    "TrainingRecord",
    "read_recording",
]

_log = logging.getLogger("bayesrace.report")


RUN_EVENT: Final = "run"
"""Kind of the event that announces a run of a race before it starts."""


_RUNS: Final = STATE, TRUTH, ACTUATION, TELEMETRY, EVENT
"""What a run is made of: the messages of a :class:`RunRecord`."""

_REMARKS: Final = ("weights_rolled_back", "weights_slowed")


@dataclass(frozen=True)
class PlannedRun:
    """The controller of a run: the data of a ``kind="run"`` event from the race."""

    run: int
    controller: str
    weights_version: str
    refused: str = ""
    """Why the controller has refused its weights, so that it was not driven; else empty."""

    @classmethod
    def from_event(cls, event: Event) -> "PlannedRun | None":
        """None if it is another event."""
        if event.source != "race" or event.kind != RUN_EVENT:
            return None
        run, controller = event.data.get("run"), event.data.get("controller")
        if type(run) is not int or type(controller) is not str:
            return None
        words = (str(event.data.get(name, "")) for name in ("weights_version", "refused"))
        return cls(run, controller, *words)


@dataclass(eq=False)
class RunRecord(Trajectory):
    """All messages of one run, in the order in which they arrived."""

    plan: PlannedRun
    states: list[State] = field(default_factory=list)
    truth: list[Truth] = field(default_factory=list)
    actuations: list[Actuation] = field(default_factory=list)
    telemetry: list[Telemetry] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)

    def add(self, message: Any) -> None:
        """Appends a message, unless it repeats the last sample, as after a fault of the plant."""
        lists: dict[type, list[Any]] = {
            State: self.states, Truth: self.truth, Actuation: self.actuations,
            Telemetry: self.telemetry, Event: self.events,
        }  # fmt: skip
        found = lists[type(message)]
        if not (isinstance(message, CarSample) and found and found[-1].time_s == message.time_s):
            found.append(message)

    def copy(self) -> "RunRecord":
        """A record that stays as it is while messages are added to this one."""
        copies: dict[str, Any] = {
            one.name: list(getattr(self, one.name)) for one in fields(self)[1:]
        }
        return replace(self, **copies)

    @property
    def moments(self) -> Sequence[CarSample]:  # type: ignore[override]
        """The truth, sample by sample."""
        return self.truth

    @cached_property
    def solve_us(self) -> Floats:
        """Execution times of the controller's steps [us]."""
        return np.array([message.solve_us for message in self.telemetry], dtype=np.float64)

    @property
    def lockstep(self) -> bool:
        """Whether the plant waited for the controller."""
        return bool(self.states) and self.states[0].lockstep

    @property
    def weights_version(self) -> str:
        """Of the weights that drove, by the actuations; several are joined in order."""
        versions = dict.fromkeys(message.weights_version for message in self.actuations)
        return " → ".join(versions) if versions else self.plan.weights_version

    @property
    def gaps(self) -> int:
        """Number of messages missing in the numbering, of states missing at the beginning, and of
        states without their truth."""
        streams: tuple[Sequence[Any], ...] = (self.states, self.actuations, self.telemetry)
        missing = sum(_missing(message.seq for message in stream) for stream in streams)
        missing += len({one.seq for one in self.states} - {one.seq for one in self.truth})
        if len(self.states) > 1 and self.states[0].time_s > 0:
            step_s = self.states[1].time_s - self.states[0].time_s
            missing += round(self.states[0].time_s / step_s) if step_s > 0 else 1
        return missing

    @property
    def remarks(self) -> list[str]:
        """What the controller has reported of its weights in mid-run, in order."""
        own = (event for event in self.events if event.source == "controller")
        return [event.text for event in own if event.kind in _REMARKS]

    @property
    def ended(self) -> str:
        """Why the run ended: the text of the plant's event, or where the log ends without one."""
        for event in reversed(self.events):
            if event.source == "plant" and event.kind == "run_ended":
                return event.text
        if self.plan.refused:
            return f"the controller has refused its weights: {self.plan.refused}"
        if not self.states:
            return "the run never started"
        return (
            f"the log ends {self.states[-1].time_s:.2f} s into the run, before the plant reported "
            "its end: the plant or the race was killed"
        )


def _missing(numbers: Iterable[int]) -> int:
    """Messages lost by the rule of the processes: forged numbers and restarts are no losses."""
    numbering = Numbering()
    for seq in numbers:
        numbering.note(seq)
    return numbering.lost


@dataclass(frozen=True, eq=False)
class TrainingRecord:
    """The training drive of a race, with the track and the line that it was driven on."""

    run: RunRecord
    track: Track
    line: RaceLine


@dataclass(eq=False, kw_only=True)
class Recording:
    """A run directory: settings, track, racing line, and each run's messages."""

    directory: Path
    settings: dict[str, Any]
    track: Track
    line: RaceLine
    runs: list[RunRecord]
    truth: bool
    """The log holds the truth; without it, as of a real car, measurements take its place."""
    truncated: bool
    """A log ends without its end mark, or that of the training drive cannot be read."""
    training: "TrainingRecord | None"
    """The training drive; None where weights were given, or it cannot be read."""
    refused: int
    """Messages of the log that could not be decoded."""
    started_ns: int | None
    """Calendar time of the first message [ns since 1970]."""

    @property
    def car(self) -> CarParameters:
        """The car that was driven, as the settings describe it."""
        try:
            return described_car(self.settings.get("car", DEFAULT_CAR))
        except InputError as error:
            raise InputError(f"settings.json, car: {error}") from None

    @property
    def built_in(self) -> bool:
        """Whether the log is that of the built-in equations: the truth, of no other simulator."""
        other = self.settings.get("fmu") or self.settings.get("simulator", "equations")
        return self.truth and other == "equations"

    @property
    def discretisation(self) -> Discretisation:
        """The discretisation of the controller's prediction and of the residual."""
        given = self.settings.get("discretisation")
        try:
            return PREDICTION if given is None else Discretisation.model_validate(given)
        except ValidationError as error:
            raise InputError(f"settings.json, discretisation: {faults_in(error)}") from None

    @property
    def caution(self) -> float:
        """The probability that the controllers are cautious at; 0: they are not."""
        mpc = self.settings.get("mpc")
        value = mpc.get("caution") if isinstance(mpc, dict) else None
        return float(value) if isinstance(value, int | float) else 0.0

    def run_of(self, controller: str) -> RunRecord | None:
        """The last run of that controller, None if it did not drive."""
        return next((run for run in reversed(self.runs) if run.plan.controller == controller), None)


class RecordingReader:
    """Reads the log of a race, each message once, also while the race is driven."""

    def __init__(self, run_dir: Path) -> None:
        self._directory = Path(run_dir)

    @cached_property
    def _log(self) -> "_RunsOfLog":
        return _RunsOfLog(self._directory / "run.mcap")

    def runs(self) -> dict[int, RunRecord]:
        """What has been recorded up to now of each run, by its number, without what later calls
        find; InputError if there is no log."""
        self._log.read()
        return self._log.runs()

    def recording(self) -> Recording:
        """The run directory as it is now; InputError if it is none of a race."""
        settings = _read_settings(self._directory / "settings.json")
        track, line = _driven_on(self._directory, settings, "track", "race")
        self._log.read()
        planned, reader = self._log.planned(), self._log.reader
        training, whole = _read_training(self._directory, settings)
        return Recording(
            directory=self._directory, settings=settings, track=track, line=line,
            runs=_with_truth(planned), truth=_has_truth(planned), training=training,
            truncated=reader.truncated or not whole, refused=reader.refused,
            started_ns=self._log.started_ns,
        )  # fmt: skip


def read_recording(run_dir: Path) -> Recording:
    """Reads a run directory, also one whose race was cut short; InputError if it is none."""
    return RecordingReader(run_dir).recording()


def _driven_on(
    run_dir: Path, settings: dict[str, Any], setting: str, label: str
) -> tuple[Track, RaceLine]:
    """A track of the run directory, named as in the settings, and its line."""
    name = Path(str(settings.get(setting, label))).stem
    track = replace(read_track(run_dir / f"{label}.csv", car_width_m=0.0), name=name)
    return track, read_raceline(run_dir / f"{label}_raceline.csv", name)


def _read_training(run_dir: Path, settings: dict[str, Any]) -> tuple[TrainingRecord | None, bool]:
    """The training drive, if there was one, and whether its log is whole.

    The race does not need it: where it cannot be read, it is left out.
    """
    log = run_dir / "collect.mcap"
    if not log.is_file():
        return None, True
    try:
        runs = _RunsOfLog(log)
        runs.read()
        track, line = _driven_on(run_dir, settings, "train_track", "train")
    except InputError as error:
        _log.warning("the training drive is left out: %s", error)
        return None, False
    planned = _with_truth(runs.planned())
    if not planned:
        return None, False
    whole = not (runs.reader.truncated or runs.reader.refused)
    return TrainingRecord(planned[-1], track, line), whole


class _RunsOfLog:
    """The runs of a log that may still be written."""

    def __init__(self, path: Path) -> None:
        self.reader = LogReader(path)
        self.started_ns: int | None = None
        """Calendar time of the first message [ns since 1970]."""
        self._runs: dict[int, RunRecord] = {}

    def runs(self) -> dict[int, RunRecord]:
        """Copies of all runs, by their number."""
        return {run: record.copy() for run, record in self._runs.items()}

    def planned(self) -> list[RunRecord]:
        """Copies of the runs that were announced, in order."""
        return [record for _, record in sorted(self.runs().items()) if record.plan.controller]

    def read(self) -> None:
        """Takes in what has been added to the log."""
        for entry in self.reader.newer(_RUNS):
            if self.started_ns is None:
                self.started_ns = entry.wall_ns
            message = entry.message
            plan = PlannedRun.from_event(message) if isinstance(message, Event) else None
            run = message.run if plan is None else plan.run
            record = self._runs.setdefault(run, RunRecord(PlannedRun(run, "", "")))
            if plan is None:
                record.add(message)
            else:  # a state can overtake it, since it comes from another process
                record.plan = plan


def _has_truth(runs: Sequence[RunRecord]) -> bool:
    return any(record.truth for record in runs)


def _with_truth(runs: Sequence[RunRecord]) -> list[RunRecord]:
    """The runs; measurements take the place of the truth where none has one."""
    if _has_truth(runs):
        return list(runs)
    names = Truth.__struct_fields__
    return [
        replace(run, truth=[Truth(**{n: getattr(one, n) for n in names}) for one in run.states])
        for run in runs
    ]


def _read_settings(path: Path) -> dict[str, Any]:
    text = read_text(path, "the settings", "give the directory of a race")
    try:
        settings = json.loads(text)
    except ValueError as error:
        raise InputError(f"{path} is no JSON: {error}") from None
    if not isinstance(settings, dict):
        raise InputError(f"{path} holds no settings; give the directory of a race")
    return settings
