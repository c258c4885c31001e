"""The whole chain: racing lines, training drives, GP, controllers, and the laps of the paper.

Plant and controller are processes of their own, started as a person would start them; this one
directs, records every message on the network, and hands over weights.
"""

import logging
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Final

from bayesrace.cache import code_folder, note_use
from bayesrace.codegen.compiler import find_compiler
from bayesrace.columns import LogColumns
from bayesrace.errors import InputError
from bayesrace.files import claimed, write_whole
from bayesrace.learning.dataset import Dataset
from bayesrace.learning.sources import dataset_from_columns
from bayesrace.limit import LimitSettings, known_limit, write_limit
from bayesrace.manifest import MANIFEST
from bayesrace.messages import Event
from bayesrace.operation.analysis.recording import (
    LIMIT_FILES,
    RUN_COLUMNS,
    Recording,
    read_recording,
    runs_of,
)
from bayesrace.operation.preparation import (
    PredictionModel,
    Prepared,
    prepare,
    progress_artefact,
    updated_weights,
)
from bayesrace.operation.run_plan import RunPlan
from bayesrace.operation.settings import PreparationSettings, RaceSettings
from bayesrace.operation.system import Child, System, child, started_system
from bayesrace.operation.terminal.terminal import Stages
from bayesrace.operation.training_drives import PreparedTrack
from bayesrace.plant.simulator import PLANT
from bayesrace.plant.vehicle import FmuFault, open_vehicle
from bayesrace.plant.world import write_world
from bayesrace.recorder import Recorder
from bayesrace.scene import Scene
from bayesrace.sensors import write_sensors
from bayesrace.tracks import load_track
from bayesrace.transport import RefusedError
from bayesrace.vehicles import write_car

__all__ = ["RaceError", "plant_options", "race"]

_MODELS: Final[tuple[PredictionModel, ...]] = ("e_kinematic", "dynamic")
"""Of BayesRace and of BestCase."""

_PATIENCE_S: Final = 60.0
"""For the limits, once all else is prepared."""

_LOWEST: Final = 19

_log = logging.getLogger("bayesrace.race")

_LOG: Final = "run.mcap"
_CAR: Final = "car.toml"
_SENSORS: Final = "sensors.toml"
_WORLD: Final = "world.toml"
_FMU_COPIES: Final = {"fmu": "car.fmu", "fmu_map": "car-map.toml"}


class RaceError(RuntimeError):
    """The race could not be driven to its end; the message says why. The log is readable."""


@contextmanager
def _faults_named(fault: type[Exception] = FmuFault) -> Iterator[None]:
    """Turns a fault, of the FMU or of a run, into the reason why there is no race."""
    try:
        yield
    except fault as error:
        raise RaceError(str(error)) from error


def race(settings: RaceSettings, out: Path, stages: Stages) -> Recording:
    """Drives WorstCase, BayesRace, BayesRace-updated, BayesRace-limit and, where the true model is
    known, BestCase.

    Leaves everything in ``out``, and returns what was recorded. Weights that the controller refuses
    are no error: their run is left out, and the log has the reason. Where the first ones are
    refused, the update learns from the run of WorstCase in place of BayesRace's.

    Raises InputError for unusable settings, RaceError when a process is lost (the log stays
    readable), KeyboardInterrupt on Ctrl-C; no process outlives the call.
    """
    if (out / _LOG).exists():
        raise InputError(f"{out} holds a run already; choose another folder or remove it")
    if settings.true_grip != 1:
        raise InputError(
            f"true_grip {settings.true_grip:g} is for campaigns: here the car is that of its file; "
            "give a car with other tyres"
        )
    code_folder()
    find_compiler()  # what is missing is reported now, before there is a run directory
    for name in (settings.train_track, settings.track):
        load_track(name, settings.driven_car.width_m)
    with claimed(out):
        return _compare(settings, out, stages)


def _compare(settings: RaceSettings, out: Path, stages: Stages) -> Recording:
    copied = _with_copies(settings, out)
    write_car(out / _CAR, settings.driven_car)
    write_whole(out / "settings.json", settings.model_dump_json(indent=1) + "\n")
    prepared = _prepared(copied, out, stages)
    artefact, *perfect = prepared.artefacts
    progress = None
    if settings.progress_runs:
        with stages.stage("build the controller that maximises progress"):
            progress = progress_artefact(settings)
            shutil.copyfile(progress / MANIFEST, out / "manifest-progress.json")
    about = {"race": {"settings": settings.model_dump_json()}}
    name, lockstep = settings.driven_car.name, settings.mode == "lockstep"
    scene = Scene(settings.driven_car, prepared.first.track, prepared.first.line)
    with (
        started_system(name, out, plant_options(copied, out), lockstep=lockstep) as system,
        Recorder(system.recording, name, out / _LOG, about, scene=scene) as recorder,
        _faults_named(InputError),
    ):
        drives = Drives(settings, out, stages, prepared, system, recorder)
        with drives.controller(artefact, "bayesrace"):
            accepted = drives.learn()
        if progress is not None:
            with drives.controller(progress, "bayesrace-limit", accepted):
                drives.approach_limit(accepted or prepared.weights)
        for best in perfect:
            with drives.controller(best, "bestcase"), stages.stage("drive BestCase"):
                drives.drive("bestcase")
    return read_recording(out, drives.log)


def _with_copies(settings: RaceSettings, out: Path) -> RaceSettings:
    """The settings with copies of FMU and map, if there are any, which are tried: an FMU that
    cannot be the car is reported now, not in half a minute."""
    copies = {
        name: Path(shutil.copyfile(file, out / copy))
        for name, copy in _FMU_COPIES.items()
        if (file := getattr(settings, name)) is not None
    }
    copied = settings.model_copy(update=copies)
    simulated_by = copied.driven_car, copied.fmu, copied.fmu_map, 1 / PLANT.step_s
    with _faults_named(), open_vehicle(*simulated_by, simulator=copied.simulator):
        return copied


def _prepared(settings: RaceSettings, out: Path, stages: Stages) -> Prepared:
    """What the race needs, made or taken from the cache, with the limits beside it; copies in the
    run directory."""
    # Nothing predicts with what is inside another simulator, or with tyres that are not known.
    known = settings.simulator == "equations" and settings.car.identified
    models = _MODELS if known else _MODELS[:1]
    with _limits_beside(settings, out) as wait:
        with _faults_named():
            prepared = prepare(settings, (settings.track,), stages, models, settings.line)
        if settings.compares_limit:
            with stages.stage(f"limit, {prepared.first.track.name}"):
                wait()
    kept = _kept(prepared.first, out, "race")
    if prepared.training is not None:
        _kept(prepared.training.driven_on, out, "train")
        shutil.copyfile(prepared.training.log, out / "collect.mcap")
    for number, practice in enumerate(prepared.practices):
        size = practice.driven_on.track.name.rpartition("-")[2] if number else ""
        label = f"practice-{size}" if size else "practice"
        _kept(practice.driven_on, out, label)
        shutil.copyfile(practice.log, out / f"{label}.mcap")
    for model, folder in zip(models, prepared.artefacts, strict=True):
        shutil.copyfile(folder / MANIFEST, out / f"manifest-{model}.json")
    weights = Path(shutil.copyfile(prepared.weights, out / "weights-bayesrace.bin"))
    return replace(prepared, tracks=(kept,), weights=weights)


@contextmanager
def _limits_beside(settings: RaceSettings, out: Path) -> Iterator[Callable[[], None]]:
    """The limits that the laps are compared with, in the run directory ``out`` before the first
    drive begins: no control step is measured beside them.

    Each is computed by ``bayesrace limit`` in a process of its own, at the lowest priority, beside
    the block. Yields what waits for them, at most a minute. A limit that is not found is left out;
    the reason is in a log named after it. The cache keeps it for the next race of the car on the
    track.
    """
    track = load_track(settings.track, settings.driven_car.width_m)
    with ExitStack() as stack:
        children: list[Child] = []
        for kind, name in LIMIT_FILES.items() if settings.compares_limit else ():
            options = LimitSettings()
            if kind == "standing":
                options = LimitSettings(standing=True, start_speed_mps=settings.start_speed_mps)
            known = known_limit(track, settings.driven_car, options)
            if known is not None:
                write_limit(out / name, known)
                continue
            arguments = [
                "limit", settings.track, "--car", str(out / _CAR), "--out", str(out / name),
                "--parent-pid", str(os.getpid()),
            ]  # fmt: skip
            if options.standing:
                arguments += ["--standing", "--start-speed", repr(options.start_speed_mps)]
            children.append(stack.enter_context(child(arguments, (out / name).with_suffix(".log"))))
            with suppress(OSError):  # it has ended already
                os.setpriority(os.PRIO_PROCESS, children[-1].pid, _LOWEST)

        def wait() -> None:
            deadline = time.monotonic() + _PATIENCE_S
            for one in children:
                one.wait(max(deadline - time.monotonic(), 0.0))
            note_use(made=bool(children))

        yield wait


def _kept(track: PreparedTrack, out: Path, label: str) -> PreparedTrack:
    """With copies of its files in the run directory."""
    files = out / f"{label}.csv", out / f"{label}_raceline.csv"
    shutil.copyfile(track.track_file, files[0])
    shutil.copyfile(track.line_file, files[1])
    return PreparedTrack(track.track, track.line, *files)


def plant_options(settings: PreparationSettings, out: Path) -> list[str]:
    """Of ``bayesrace plant``, with the files in ``out`` that they name; the car's is there."""
    files = ("--fmu", settings.fmu), ("--map", settings.fmu_map)
    sensors, changes = out / _SENSORS, settings.changes
    if changes.root:
        write_world(out / _WORLD, changes)
    if settings.instruments.root:
        write_sensors(sensors, settings.instruments)
    pairs = [
        ("--car", out / _CAR), ("--simulator", settings.simulator),
        *(pair for pair in files if pair[1]),
        *([("--world", out / _WORLD)] if changes.root else []),
        ("--sensors", sensors if settings.instruments.root else "exact"),
        ("--delay", 1e3 * settings.delay_s), ("--seed", settings.seed),
    ]  # fmt: skip
    return [str(one) for pair in pairs for one in pair]


class Drives:
    """The runs of a race, driven and recorded one after the other."""

    def __init__(
        self,
        settings: RaceSettings,
        out: Path,
        stages: Stages,
        prepared: Prepared,
        system: System,
        recorder: Recorder,
    ) -> None:
        self._settings, self._out, self._stages = settings, out, stages
        self._prepared, self._system, self._recorder = prepared, system, recorder
        self._learned_from = prepared.samples
        self._run = 0
        self.log = LogColumns(out / _LOG, RUN_COLUMNS)

    def controller(
        self, artefact: Path, name: str, weights: Path | None = None
    ) -> AbstractContextManager[None]:
        """A controller process for the block; ready for its first run, with these weights."""
        settings_file, track = self._out / "mpc.json", self._prepared.first
        write_whole(settings_file, self._settings.mpc.model_dump_json(indent=1) + "\n")
        options = [
            "--car", str(self._out / _CAR), "--artefact", str(artefact),
            "--track", str(track.track_file), "--raceline", str(track.line_file),
            "--settings", str(settings_file),
        ]  # fmt: skip
        if weights is not None:
            options += ["--weights", str(weights)]
        return self._system.controller(options, f"controller-{name}.log")

    def drive(self, controller: str) -> RunPlan:
        """One run; InputError if it broke off."""
        plan = self._plan(controller)
        self._system.drive(self._prepared.first.track, plan, self._recorder)
        return plan

    def _drive_learning(self, weights: Path, controller: str) -> tuple[RunPlan, Path]:
        """One run that takes over an update each time the settings say so; with the last weights
        that the controller has accepted, after ``weights``."""
        accepted = weights

        def update(_: Event) -> None:
            nonlocal accepted
            try:
                # From the weights before the run on: what they miss shows a car that has changed.
                so_far = [*self._learned_from, self.samples(plan)]
                learned, _samples = updated_weights(so_far, self._settings, weights)
            except (InputError, ArithmeticError, ValueError) as error:
                _log.warning("nothing learned within the lap: %s", error)
                return
            try:
                self._system.director.send_weights(learned.read_bytes())
                accepted = learned
            except RefusedError as refusal:  # in the log, as the controller's event
                _log.warning("%s", refusal)

        plan = replace(self._plan(controller), pause_s=self._settings.every or 0.0)
        self._system.drive(self._prepared.first.track, plan, self._recorder, update)
        return plan, accepted

    def learn(self) -> Path | None:
        """WorstCase, BayesRace and BayesRace-updated; returns the last weights that the controller
        has accepted, None without any."""
        weights = self._prepared.weights
        with self._stages.stage("drive WorstCase"):
            driven = self.drive("worstcase")
        with self._stages.stage("drive BayesRace"):
            first = None
            if self._accepts(weights, "bayesrace"):
                first, accepted = self._drive_learning(weights, "bayesrace")
        updated = self._updated(first or driven, weights, "weights-updated.bin")
        with self._stages.stage("drive BayesRace-updated"):
            if self._drive_with(updated, "bayesrace-updated") is not None:
                return updated
        return accepted if first is not None else None

    def approach_limit(self, weights: Path) -> None:
        """The runs that maximise progress, the first with the weights that the controller has, with
        an update before each other; ends where the controller refuses an update."""
        driven: RunPlan | None = None
        for number in range(1, self._settings.progress_runs + 1):
            if driven is not None:
                file = f"weights-limit-{number}.bin"
                weights = self._updated(driven, weights, file, f", {number}")
            with self._stages.stage(f"drive BayesRace-limit, {number}"):
                name = "bayesrace-limit"
                driven = self.drive(name) if driven is None else self._drive_with(weights, name)
            if driven is None:
                return

    def samples(self, plan: RunPlan) -> Dataset:
        """What can be learned from a run, from the log; InputError names both."""
        self._recorder.drain(at_most_s=20.0)
        named = f"{self._out / _LOG}, run {plan.run} ({plan.controller})"
        record = runs_of(self.log.read()).get(plan.run)
        if record is None:
            raise InputError(f"{named}: the log does not hold it")
        car, step_s = self._settings.driven_car, self._settings.discretisation.step_s
        try:
            return dataset_from_columns(record.states, record.telemetry, car, step_s)
        except InputError as error:
            raise InputError(f"{named}: {error}") from error

    def _plan(self, controller: str) -> RunPlan:
        self._run += 1
        settings, lockstep = self._settings, self._settings.mode == "lockstep"
        limit_s = settings.limit_s(self._prepared.first.line.lap_time_s)
        start_mps = settings.start_speed_mps
        exact = controller == "bestcase"
        return RunPlan(
            self._run, controller, settings.laps, limit_s, lockstep, start_mps, exact=exact
        )

    def _accepts(self, weights: Path, controller: str) -> bool:
        """Whether the controller takes over new weights; if not, the log has the reason."""
        try:
            self._system.director.send_weights(weights.read_bytes())
        except RefusedError as refusal:
            self._system.refused(self._plan(controller), refusal.reply.text)
            return False
        return True

    def _drive_with(self, weights: Path, controller: str) -> RunPlan | None:
        """One run with new weights; None if they are refused."""
        return self.drive(controller) if self._accepts(weights, controller) else None

    def _updated(self, driven: RunPlan, weights: Path, name: str, number: str = "") -> Path:
        """Weights learned from a run and all samples before it, beginning with ``weights``."""
        self._learned_from.append(self.samples(driven))
        with self._stages.stage(f"update the residual{number}") as stage:
            learned, samples = updated_weights(
                self._learned_from, self._settings, weights, stage.update
            )
            self._learned_from = [samples]
            return Path(shutil.copyfile(learned, self._out / name))
