"""The whole chain: racing lines, training drive, GP, controllers, and the laps of the paper.

Plant and controller are processes of their own, started as a person would start them; this one
directs, records everything that is said on the network, and hands over weights.
"""

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from bayesrace.errors import InputError
from bayesrace.files import write_whole
from bayesrace.gp.weights import read_weights
from bayesrace.manifest import MANIFEST
from bayesrace.messages import EVENT, Event
from bayesrace.recorder import Recorder
from bayesrace.tracks import load_track
from bayesrace.transport import Director, Endpoints, Publisher, free_endpoint, open_session
from bayesrace.vehicles import CarParameters, write_car
from codegen.compiler import find_compiler
from experiments.drive import RunPlan, execute, wait_for_both
from experiments.preparation import (
    Course,
    PredictionModel,
    Prepared,
    prepare,
    trained_weights,
    training_settings,
)
from experiments.processes import Child, child, endings
from experiments.progress import Stage, Stages
from experiments.settings import RaceSettings
from learning.dataset import Dataset, concatenate
from learning.logs import dataset_from_log
from plant.fmu.faults import FmuFault
from plant.simulator import PLANT
from plant.vehicle import open_vehicle

__all__ = ["FILES", "RaceError", "race"]

_START_S: Final = 20.0

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
    result: str = "result.json"
    weights: str = "weights-bayesrace.bin"
    weights_updated: str = "weights-updated.bin"
    mpc: str = "mpc.json"
    fmu: str = "car.fmu"
    fmu_map: str = "car-map.toml"


FILES: Final = _Files()


class _Race:
    def __init__(self, settings: RaceSettings, out: Path, stages: Stages) -> None:
        self.settings, self.out, self.stages = settings, out, stages
        self.car = settings.driven_car
        self._run = 0

    # Preparation -------------------------------------------------------------------------------

    def prepare(self) -> Prepared:
        """Everything made, or taken from the cache; copies in the run directory."""
        fmu, fmu_map = self.fmu_files
        settings = self.settings.model_copy(update={"fmu": fmu, "fmu_map": fmu_map})
        with _faults_named():
            prepared = prepare(settings, (settings.track,), self.stages, _MODELS)
        if prepared.training is not None:
            self._keep_course(prepared.training.course, "train")
            shutil.copyfile(prepared.training.log, self.out / FILES.collect_log)
        course = self._keep_course(prepared.course, "race")
        for model, folder in zip(_MODELS, prepared.artefacts, strict=True):
            shutil.copyfile(folder / MANIFEST, self.out / f"manifest-{model}.json")
        shutil.copyfile(prepared.weights, self.out / FILES.weights)
        return replace(prepared, courses=(course,), weights=self.out / FILES.weights)

    def _keep_course(self, course: Course, label: str) -> Course:
        files = self.out / f"{label}.csv", self.out / f"{label}_raceline.csv"
        shutil.copyfile(course.track_file, files[0])
        shutil.copyfile(course.line_file, files[1])
        return Course(course.track, course.line, *files)

    def keep_fmu(self) -> None:
        """Copies FMU and map, if there are any, into the run directory, and tries them."""
        settings = self.settings
        for source, target in zip((settings.fmu, settings.fmu_map), self.fmu_files, strict=True):
            if source is not None and target is not None:
                shutil.copyfile(source, target)
        # An FMU that cannot be the car is reported now, not in half a minute.
        with _faults_named(), open_vehicle(self.car, *self.fmu_files, 1 / PLANT.step_s):
            pass

    @property
    def car_file(self) -> str:
        """The car, as the processes read it."""
        return str(self.out / FILES.car)

    @property
    def fmu_files(self) -> tuple[Path | None, Path | None]:
        """FMU and map in the run directory; None for what there is not."""
        settings = self.settings
        return (
            None if settings.fmu is None else self.out / FILES.fmu,
            None if settings.fmu_map is None else self.out / FILES.fmu_map,
        )

    def update(self, prepared: Prepared, lap: Dataset, stage: Stage) -> Path:
        """Weights learned from training drive and lap, beginning with those of the lap."""
        settings = self.settings
        samples = [lap] if prepared.training is None else [prepared.training.samples, lap]
        weights = trained_weights(
            concatenate(samples),
            settings.discretisation,
            training_settings(settings),
            read_weights(prepared.weights),
            stage.update,
        )
        return Path(shutil.copyfile(weights, self.out / FILES.weights_updated))

    # Driving -----------------------------------------------------------------------------------

    def plan(self, controller: str, course: Course) -> RunPlan:
        """The next run."""
        self._run += 1
        settings = self.settings
        limit_s = settings.time_limit * course.line.lap_time_s * settings.laps + 2.0
        lockstep = settings.mode == "lockstep"
        return RunPlan(
            self._run, controller, settings.laps, limit_s, lockstep, settings.start_speed_mps
        )


@contextmanager
def _faults_named() -> Iterator[None]:
    """Turns a fault of the FMU into the reason why there is no race."""
    try:
        yield
    except FmuFault as fault:
        raise RaceError(str(fault)) from fault


@contextmanager
def _explained(children: list[Child]) -> Iterator[None]:
    """Turns the end of a child into the reason of what went wrong because of it."""
    try:
        yield
    except InputError as error:
        time.sleep(0.2)  # the system tells of a death a moment after the network does
        raise RaceError("; ".join([str(error), *endings(children)])) from error


class _Paddock:
    """The processes of a race and the session that directs and records them."""

    def __init__(self, race: _Race, course: Course, stack: ExitStack) -> None:
        self._race, self._course, self._stack = race, course, stack
        self._plant_endpoint = free_endpoint()
        self._controller_endpoint = free_endpoint()
        # Per link, and links that carry weights cannot have it: large messages need fragments.
        self._low_latency = race.settings.mode == "lockstep"
        self.children: list[Child] = []
        self.children.append(stack.enter_context(self._plant()))
        endpoints = Endpoints(connect=(self._plant_endpoint, self._controller_endpoint))
        session = stack.enter_context(open_session(endpoints))
        stack.callback(self._stop_children)
        self.recorder = stack.enter_context(
            Recorder(session, race.car.name, race.out / FILES.log, self._metadata())
        )
        self.director = Director(session, race.car.name)
        self._events: Publisher[Event] = Publisher(session, EVENT, race.car.name, "race")

    def _metadata(self) -> dict[str, dict[str, str]]:
        return {"race": {"settings": self._race.settings.model_dump_json()}}

    def _flags(self) -> list[str]:
        return ["--parent-pid", str(os.getpid()), *(["--low-latency"] if self._low_latency else [])]

    def _plant(self) -> Any:
        arguments = ["plant", "--car", self._race.car_file, "--endpoint", self._plant_endpoint]
        for option, file in zip(("--fmu", "--map"), self._race.fmu_files, strict=True):
            arguments += [option, str(file)] if file is not None else []
        return child([*arguments, *self._flags()], self._race.out / "plant.log")

    def _stop_children(self) -> None:
        for process in self.children:
            process.stop()

    @contextmanager
    def controller(self, artefact: Path, name: str) -> Iterator[None]:
        """A controller process for the block; ready for its first run."""
        race, course = self._race, self._course
        settings_file = race.out / FILES.mpc
        write_whole(settings_file, race.settings.mpc.model_dump_json(indent=1) + "\n")
        arguments = [
            "controller", "--car", race.car_file, "--artefact", str(artefact),
            "--track", str(course.track_file), "--raceline", str(course.line_file),
            "--settings", str(settings_file), "--endpoint", self._plant_endpoint,
            "--listen", self._controller_endpoint, *self._flags(),
        ]  # fmt: skip
        with child(arguments, race.out / f"controller-{name}.log") as process:
            self.children.append(process)
            with _explained(self.children):
                wait_for_both(self.director, self.children, _START_S)
                yield
            self.children.remove(process)
        self.director.wait_until_gone("controller", _START_S)

    def drive(self, controller: str) -> RunPlan:
        """One run; InputError if it broke off."""
        plan = self._race.plan(controller, self._course)
        execute(self.director, self._events, self._course.track, plan, self.recorder)
        return plan

    def flushed(self, plan: RunPlan, car: CarParameters, step_s: float) -> Dataset:
        """Samples of a run, from the log."""
        self.recorder.settle(at_most_s=20.0)  # the next stage reads the log
        return dataset_from_log(self._race.out / FILES.log, car, step_s, runs=(plan.run,))


def race(settings: RaceSettings, out: Path, stages: Stages) -> None:
    """Drives WorstCase, BayesRace, BayesRace-updated and BestCase; leaves everything in ``out``.

    Raises InputError for unusable settings, RaceError when a process is lost (the log stays
    readable), KeyboardInterrupt on Ctrl-C; no process outlives the call.
    """
    if (out / FILES.log).exists():
        raise InputError(f"{out} holds a run already; choose another folder or remove it")
    find_compiler()  # what is missing is reported now, before there is a run directory
    this = _Race(settings, out, stages)
    for name in (settings.train_track, settings.track):
        load_track(name, this.car.width_m)
    out.mkdir(parents=True, exist_ok=True)
    this.keep_fmu()
    write_car(this.car_file, this.car)
    write_whole(out / FILES.settings, settings.model_dump_json(indent=1) + "\n")
    prepared = this.prepare()
    artefact, perfect = prepared.artefacts
    with ExitStack() as stack:
        paddock = _Paddock(this, prepared.course, stack)
        with paddock.controller(artefact, "bayesrace"):
            with stages.stage("drive WorstCase"):
                paddock.drive("worstcase")
            with stages.stage("drive BayesRace"):
                paddock.director.send_weights(prepared.weights.read_bytes())
                driven = paddock.drive("bayesrace")
            with stages.stage("update the residual") as stage:
                lap = paddock.flushed(driven, this.car, settings.discretisation.step_s)
                updated = this.update(prepared, lap, stage)
            with stages.stage("drive BayesRace-updated"):
                paddock.director.send_weights(updated.read_bytes())
                paddock.drive("bayesrace-updated")
        with paddock.controller(perfect, "bestcase"), stages.stage("drive BestCase"):
            paddock.drive("bestcase")
