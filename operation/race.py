"""The whole chain: racing lines, training drive, GP, controllers, and the laps of the paper.

Plant and controller are processes of their own, started as a person would start them; this one
directs, records every message on the network, and hands over weights.
"""

import shutil
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from bayesrace.codegen.compiler import find_compiler
from bayesrace.columns import LogColumns
from bayesrace.errors import InputError
from bayesrace.files import claimed, write_whole
from bayesrace.gp.weights import read_weights
from bayesrace.learning.dataset import Dataset
from bayesrace.learning.sources import dataset_from_columns
from bayesrace.manifest import MANIFEST
from bayesrace.operation.analysis.recording import RUN_COLUMNS, Recording, read_recording, runs_of
from bayesrace.operation.drive import RunPlan
from bayesrace.operation.limits import limits_beside
from bayesrace.operation.preparation import (
    PredictionModel,
    Prepared,
    PreparedTrack,
    prepare,
    progress_artefact,
    updated_weights,
)
from bayesrace.operation.settings import RaceSettings
from bayesrace.operation.system import System, started_system
from bayesrace.operation.terminal.terminal import Stage, Stages
from bayesrace.plant.simulator import PLANT
from bayesrace.plant.vehicle import FmuFault, open_vehicle
from bayesrace.recorder import Recorder
from bayesrace.tracks import load_track
from bayesrace.transport import RefusedError
from bayesrace.vehicles import write_car

__all__ = ["FILES", "RaceError", "race"]

_MODELS: Final[tuple[PredictionModel, ...]] = ("e_kinematic", "dynamic")
"""Of BayesRace and of BestCase."""


class RaceError(RuntimeError):
    """The race could not be driven to its end; the message says why. The log is readable."""


@dataclass(frozen=True)
class _Files:
    """Names in the run directory."""

    settings: str = "settings.json"
    car: str = "car.toml"
    log: str = "run.mcap"
    collect_log: str = "collect.mcap"
    weights: str = "weights-bayesrace.bin"
    weights_updated: str = "weights-updated.bin"
    weights_limit: str = "weights-limit.bin"
    mpc: str = "mpc.json"
    fmu: str = "car.fmu"
    fmu_map: str = "car-map.toml"


FILES: Final = _Files()


class _Race:
    def __init__(self, settings: RaceSettings, out: Path, stages: Stages) -> None:
        self.settings, self.out, self.stages = settings, out, stages
        self.car = settings.driven_car
        self.car_file = str(out / FILES.car)
        """The car, as the processes read it."""
        # Nothing predicts with what is inside another simulator.
        self.models = _MODELS if settings.simulator == "equations" else _MODELS[:1]
        self.lockstep = settings.mode == "lockstep"
        self._run = 0

    # Preparation -------------------------------------------------------------------------------

    def prepare(self) -> Prepared:
        """Everything made, or taken from the cache; copies in the run directory."""
        settings = self.settings
        with _faults_named():
            prepared = prepare(settings, (settings.track,), self.stages, self.models, settings.line)
        if prepared.training is not None:
            self._keep_files(prepared.training.driven_on, "train")
            shutil.copyfile(prepared.training.log, self.out / FILES.collect_log)
        kept = self._keep_files(prepared.first, "race")
        for model, folder in zip(self.models, prepared.artefacts, strict=True):
            shutil.copyfile(folder / MANIFEST, self.out / f"manifest-{model}.json")
        shutil.copyfile(prepared.weights, self.out / FILES.weights)
        return replace(prepared, tracks=(kept,), weights=self.out / FILES.weights)

    def _keep_files(self, track: PreparedTrack, label: str) -> PreparedTrack:
        files = self.out / f"{label}.csv", self.out / f"{label}_raceline.csv"
        shutil.copyfile(track.track_file, files[0])
        shutil.copyfile(track.line_file, files[1])
        return PreparedTrack(track.track, track.line, *files)

    def keep_fmu(self) -> None:
        """Copies FMU and map, if there are any, into the run directory, and tries them there."""
        settings, names = self.settings, {"fmu": FILES.fmu, "fmu_map": FILES.fmu_map}
        given = {name: file for name in names if (file := getattr(settings, name)) is not None}
        copies = {
            name: Path(shutil.copyfile(file, self.out / names[name]))
            for name, file in given.items()
        }
        self.settings = settings = settings.model_copy(update=copies)
        # An FMU that cannot be the car is reported now, not in half a minute.
        files, rate_hz = (settings.fmu, settings.fmu_map), 1 / PLANT.step_s
        with (
            _faults_named(),
            open_vehicle(self.car, *files, rate_hz, simulator=settings.simulator),
        ):
            pass

    @property
    def plant_options(self) -> list[str]:
        """Of ``bayesrace plant``."""
        settings = self.settings
        files = ("--fmu", settings.fmu), ("--map", settings.fmu_map)
        noise = [("--noise", f"{name}={value!r}") for name, value in settings.noise if value]
        pairs = [
            ("--car", self.car_file), ("--simulator", settings.simulator),
            *(pair for pair in files if pair[1]), *noise,
            ("--delay", 1e3 * settings.delay_s), ("--seed", settings.seed),
        ]  # fmt: skip
        return [str(one) for pair in pairs for one in pair]

    def update(self, samples: Sequence[Dataset], weights: Path, name: str, stage: Stage) -> Path:
        """Weights learned from all samples, beginning with ``weights``, as that file."""
        first = read_weights(weights)
        learned = updated_weights(samples, self.settings, first, stage.update)
        return Path(shutil.copyfile(learned, self.out / name))

    # Driving -----------------------------------------------------------------------------------

    def plan(self, controller: str, track: PreparedTrack) -> RunPlan:
        """The next run."""
        self._run += 1
        settings = self.settings
        limit_s = settings.limit_s(track.line.lap_time_s)
        return RunPlan(
            self._run, controller, settings.laps, limit_s, self.lockstep, settings.start_speed_mps
        )


@contextmanager
def _faults_named(fault: type[Exception] = FmuFault) -> Iterator[None]:
    """Turns a fault, of the FMU or of a run, into the reason why there is no race."""
    try:
        yield
    except fault as error:
        raise RaceError(str(error)) from error


class _Drives:
    """The runs of a race, driven and recorded one after the other."""

    def __init__(
        self, race: _Race, track: PreparedTrack, system: System, recorder: Recorder
    ) -> None:
        self._race, self._track = race, track
        self._system, self._recorder = system, recorder
        self.log = LogColumns(race.out / FILES.log, RUN_COLUMNS)

    def controller(
        self, artefact: Path, name: str, weights: Path | None = None
    ) -> AbstractContextManager[None]:
        """A controller process for the block; ready for its first run, with these weights."""
        race, track = self._race, self._track
        settings_file = race.out / FILES.mpc
        write_whole(settings_file, race.settings.mpc.model_dump_json(indent=1) + "\n")
        options = [
            "--car", race.car_file, "--artefact", str(artefact), "--track", str(track.track_file),
            "--raceline", str(track.line_file), "--settings", str(settings_file),
            "--sensor-tolerance", str(race.settings.sensor_tolerance),
        ]  # fmt: skip
        if weights is not None:
            options += ["--weights", str(weights)]
        return self._system.controller(options, f"controller-{name}.log")

    def drive(self, controller: str) -> RunPlan:
        """One run; InputError if it broke off."""
        plan = self._race.plan(controller, self._track)
        self._system.drive(self._track.track, plan, self._recorder)
        return plan

    def drive_with(self, weights: Path, controller: str) -> RunPlan | None:
        """One run with new weights; None, and the reason in the log, if they are refused."""
        try:
            self._system.director.send_weights(weights.read_bytes())
        except RefusedError as refusal:
            plan = self._race.plan(controller, self._track)
            self._system.refused(plan, refusal.reply.text)
            return None
        return self.drive(controller)

    def samples(self, plan: RunPlan) -> Dataset:
        """What can be learned from a run, from the log; InputError names both."""
        self._recorder.drain(at_most_s=20.0)
        named = f"{self._race.out / FILES.log}, run {plan.run} ({plan.controller})"
        record = runs_of(self.log.read()).get(plan.run)
        if record is None:
            raise InputError(f"{named}: the log does not hold it")
        step_s = self._race.settings.discretisation.step_s
        try:
            return dataset_from_columns(record.states, record.telemetry, self._race.car, step_s)
        except InputError as error:
            raise InputError(f"{named}: {error}") from error


def race(settings: RaceSettings, out: Path, stages: Stages) -> Recording:
    """Drives WorstCase, BayesRace, BayesRace-updated, BayesRace-limit and, where the true model is
    known, BestCase.

    Leaves everything in ``out``, and returns what was recorded. Weights that the controller refuses
    are no error: their run is left out, and the log has the reason. Where the first ones are
    refused, the update learns from the run of WorstCase in place of BayesRace's.

    Raises InputError for unusable settings, RaceError when a process is lost (the log stays
    readable), KeyboardInterrupt on Ctrl-C; no process outlives the call.
    """
    if (out / FILES.log).exists():
        raise InputError(f"{out} holds a run already; choose another folder or remove it")
    if settings.true_grip != 1:
        raise InputError(
            f"true_grip {settings.true_grip:g} is for campaigns: here the car is that of its file; "
            "give a car with other tyres"
        )
    find_compiler()  # what is missing is reported now, before there is a run directory
    this = _Race(settings, out, stages)
    for name in (settings.train_track, settings.track):
        load_track(name, this.car.width_m)
    with claimed(out):
        return _compare(this)


def _compare(this: _Race) -> Recording:
    settings, out, stages = this.settings, this.out, this.stages  # as given, with no file copied
    this.keep_fmu()
    write_car(this.car_file, this.car)
    write_whole(out / FILES.settings, settings.model_dump_json(indent=1) + "\n")
    prepared = _prepared(this)
    artefact, *perfect = prepared.artefacts
    progress = None
    if settings.progress_runs:
        with stages.stage("build the controller that maximises progress"):
            progress = progress_artefact(settings)
            shutil.copyfile(progress / MANIFEST, out / "manifest-progress.json")
    about = {"race": {"settings": settings.model_dump_json()}}
    with (
        started_system(this.car.name, out, this.plant_options, lockstep=this.lockstep) as system,
        Recorder(system.recording, this.car.name, out / FILES.log, about) as recorder,
        _faults_named(InputError),
    ):
        drives = _Drives(this, prepared.first, system, recorder)
        samples = [] if prepared.training is None else [prepared.training.samples]
        with drives.controller(artefact, "bayesrace"):
            accepted = _learn(this, drives, samples, prepared.weights)
        if progress is not None:
            with drives.controller(progress, "bayesrace-limit", accepted):
                _approach_limit(this, drives, samples, accepted or prepared.weights)
        for best in perfect:
            with drives.controller(best, "bestcase"), stages.stage("drive BestCase"):
                drives.drive("bestcase")
    return read_recording(out, drives.log)


def _prepared(this: _Race) -> Prepared:
    """What the race needs, with the limits beside it."""
    settings = this.settings
    if not settings.compares_limit:
        return this.prepare()
    with limits_beside(settings, this.car_file, this.out) as wait:
        prepared = this.prepare()
        with this.stages.stage(f"limit, {prepared.first.track.name}"):
            wait()
    return prepared


def _learn(this: _Race, drives: _Drives, samples: list[Dataset], weights: Path) -> Path | None:
    """WorstCase, BayesRace and BayesRace-updated; returns the last weights that the controller has
    accepted, None without any."""
    stages = this.stages
    with stages.stage("drive WorstCase"):
        driven = drives.drive("worstcase")
    with stages.stage("drive BayesRace"):
        first = drives.drive_with(weights, "bayesrace")
    samples.append(drives.samples(first or driven))
    with stages.stage("update the residual") as stage:
        updated = this.update(samples, weights, FILES.weights_updated, stage)
    with stages.stage("drive BayesRace-updated"):
        if drives.drive_with(updated, "bayesrace-updated") is not None:
            return updated
    return weights if first is not None else None


def _approach_limit(this: _Race, drives: _Drives, samples: list[Dataset], weights: Path) -> None:
    """The runs that maximise progress, the first with the weights that the controller has, with an
    update before each other; ends where the controller refuses an update."""
    driven: RunPlan | None = None
    for number in range(1, this.settings.progress_runs + 1):
        if driven is not None:
            samples.append(drives.samples(driven))
            with this.stages.stage(f"update the residual, {number}") as stage:
                weights = this.update(samples, weights, FILES.weights_limit, stage)
        with this.stages.stage(f"drive BayesRace-limit, {number}"):
            name = "bayesrace-limit"
            driven = drives.drive(name) if driven is None else drives.drive_with(weights, name)
        if driven is None:
            return
