"""A run directory as arrays: what the log says about each run, and what was driven on."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

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
    Event,
    State,
    Telemetry,
    Truth,
)
from bayesrace.raceline import RaceLine, read_raceline
from bayesrace.tracks import Track, read_track
from bayesrace.vehicles import DEFAULT_CAR, CarParameters, described_car
from experiments.laps import Trajectory

__all__ = ["RUN_EVENT", "PlannedRun", "Recording", "RunRecord", "read_recording"]

Floats = NDArray[np.float64]

RUN_EVENT: Final = "run"
"""Kind of the event with which the race announces a run, before it starts."""


@dataclass(frozen=True)
class PlannedRun:
    """Who drives which run: the data of a ``kind="run"`` event from the race."""

    run: int
    controller: str
    weights_version: str

    @classmethod
    def from_event(cls, event: Event) -> "PlannedRun | None":
        """None if it is another event."""
        if event.source != "race" or event.kind != RUN_EVENT:
            return None
        run, controller = event.data.get("run"), event.data.get("controller")
        if type(run) is not int or type(controller) is not str:
            return None
        return cls(run, controller, str(event.data.get("weights_version", "")))


@dataclass(eq=False)
class RunRecord(Trajectory):
    """All messages of one run, in the order in which they arrived."""

    plan: PlannedRun
    states: list[State] = field(default_factory=list)
    truth: list[Truth] = field(default_factory=list)
    actuations: list[Actuation] = field(default_factory=list)
    telemetry: list[Telemetry] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)

    @cached_property
    def solve_us(self) -> Floats:
        """Execution times of the controller's steps."""
        return np.array([message.solve_us for message in self.telemetry], dtype=np.float64)

    @property
    def fallbacks(self) -> int:
        """Cycles that the fallback drove."""
        return sum(message.fallback > 0 for message in self.telemetry)

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
        """Messages missing by their numbers, states missing at the beginning, and states whose
        truth is missing."""
        streams: tuple[Sequence[Any], ...] = (self.states, self.actuations, self.telemetry)
        missing = sum(_missing(message.seq for message in stream) for stream in streams)
        missing += len({one.seq for one in self.states} - {one.seq for one in self.truth})
        if len(self.states) > 1 and self.states[0].time_s > 0:
            step_s = self.states[1].time_s - self.states[0].time_s
            missing += round(self.states[0].time_s / step_s) if step_s > 0 else 1
        return missing

    @property
    def ended(self) -> str:
        """Why the run ended, in the plant's words, or what the log tells without them."""
        for event in reversed(self.events):
            if event.source == "plant" and event.kind == "run_ended":
                return event.text
        if not self.states:
            return "the run never started"
        return (
            f"the log ends {self.states[-1].time_s:.2f} s into the run without a word from the "
            "plant: it was killed, or the race was"
        )


def _missing(numbers: Iterable[int]) -> int:
    gaps, last = 0, None
    for number in numbers:
        # A number that falls is a process that began again, not a loss.
        if last is not None and number > last:
            gaps += number - last - 1
        last = number
    return gaps


@dataclass(eq=False)
class Recording:
    """A run directory: settings, track, racing line, and each run's messages."""

    directory: Path
    settings: dict[str, Any]
    track: Track
    line: RaceLine
    runs: list[RunRecord]
    truth: bool
    """The log tells what was true; without, as of a real car, what was measured is taken for it."""
    truncated: bool
    """The log ends without its end mark."""
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
    def discretisation(self) -> Discretisation:
        """With which the controller predicted and the residual was made."""
        given = self.settings.get("discretisation")
        try:
            return PREDICTION if given is None else Discretisation.model_validate(given)
        except ValidationError as error:
            raise InputError(f"settings.json, discretisation: {faults_in(error)}") from None

    def run_of(self, controller: str) -> RunRecord | None:
        """The last run of that controller, None if it did not drive."""
        return next((run for run in reversed(self.runs) if run.plan.controller == controller), None)


def read_recording(run_dir: Path) -> Recording:
    """Reads a run directory, also one whose race was cut short; InputError if it is none."""
    run_dir = Path(run_dir)
    settings = _read_settings(run_dir / "settings.json")
    name = Path(str(settings.get("track", "race"))).stem
    track = replace(read_track(run_dir / "race.csv", car_width_m=0.0), name=name)
    line = read_raceline(run_dir / "race_raceline.csv", name)
    reader = LogReader(run_dir / "run.mcap")
    runs: dict[int, RunRecord] = {}
    started_ns: int | None = None
    for entry in reader.messages((STATE, TRUTH, ACTUATION, TELEMETRY, EVENT)):
        started_ns = entry.log_time_ns if started_ns is None else started_ns
        _sort_in(runs, entry.message)
    planned = [record for _, record in sorted(runs.items()) if record.plan.controller]
    truth = any(record.truth for record in planned)
    if not truth:
        for record in planned:
            record.truth = [_taken_for_true(state) for state in record.states]
    return Recording(
        run_dir, settings, track, line, planned, truth, reader.truncated, reader.refused, started_ns
    )


def _taken_for_true(state: State) -> Truth:
    return Truth(*(getattr(state, one.name) for one in fields(Truth)))


def _sort_in(runs: dict[int, RunRecord], message: Any) -> None:
    plan = PlannedRun.from_event(message) if isinstance(message, Event) else None
    if plan is not None:
        # A state can overtake the announcement, which comes from another process.
        runs.setdefault(plan.run, RunRecord(plan)).plan = plan
        return
    record = runs.setdefault(message.run, RunRecord(PlannedRun(message.run, "", "")))
    if isinstance(message, State | Truth):
        samples: list[Any] = record.states if isinstance(message, State) else record.truth
        # A fault of the plant repeats the last sample: no time has passed.
        if not (samples and message.time_s == samples[-1].time_s):
            samples.append(message)
    elif isinstance(message, Actuation):
        record.actuations.append(message)
    elif isinstance(message, Telemetry):
        record.telemetry.append(message)
    else:
        record.events.append(message)


def _read_settings(path: Path) -> dict[str, Any]:
    text = read_text(path, "the settings", "give the directory of a race")
    try:
        settings = json.loads(text)
    except ValueError as error:
        raise InputError(f"{path} is no JSON: {error}") from None
    if not isinstance(settings, dict):
        raise InputError(f"{path} holds no settings; give the directory of a race")
    return settings
