"""What is made before anything can be driven: racing lines, training drives, weights, controllers.

Each depends on settings, files and code alone, is kept in the cache under a digest of all of them,
and is made only if it is not there. ``race``, ``bench`` and ``latency`` prepare by :func:`prepare`.
"""

import logging
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

from bayesrace.cache import cache_folder, code_folder, cpu_identity, digest, kept, software
from bayesrace.codegen.build import build
from bayesrace.codegen.compiler import compiled, find_compiler
from bayesrace.codegen.settings import BuildSettings
from bayesrace.columns import LogColumns
from bayesrace.controller.assembly import compiled_controller
from bayesrace.errors import InputError
from bayesrace.files import read_whole, replacing
from bayesrace.gp.weights import encode_weights, read_weights, write_weights
from bayesrace.integrators import Discretisation
from bayesrace.learning.dataset import Dataset, concatenate
from bayesrace.learning.settings import Progress, TrainingSettings
from bayesrace.learning.sources import CYCLES, STATES, dataset_from_columns
from bayesrace.manifest import opened_library, read_manifest
from bayesrace.messages import STATE, TELEMETRY
from bayesrace.operation.closed_loop import Driven
from bayesrace.operation.collect import collect, drive_length_s, practise, training_margin_m
from bayesrace.operation.settings import PreparationSettings
from bayesrace.operation.terminal.terminal import Stages
from bayesrace.plant.simulator import PLANT
from bayesrace.plant.vehicle import Vehicle, open_vehicle
from bayesrace.raceline import (
    RaceLine,
    RaceLineError,
    RaceLineSettings,
    raceline_file,
    racing_line,
    read_raceline_for,
)
from bayesrace.tracks import Track, load_track, write_track
from bayesrace.vehicles import CarParameters

__all__ = [
    "SOURCES",
    "Prepared",
    "PreparedTrack",
    "Training",
    "drive_for_training",
    "prepare",
    "progress_artefact",
    "trained_weights",
    "training_settings",
    "updated_weights",
]

SOURCES: Final = (
    ".", "gp", "messages", "raceline", "tracks",
    "vehicles", "controller", "controller/native", "learning", "plant", "plant/fmu",
    "operation/closed_loop.py", "operation/collect.py", "operation/drive.py",
)  # fmt: skip
"""Our code that shapes a training drive and what is learned from it."""

_log = logging.getLogger(__name__)

_SHAPES_A_DRIVE: Final = {
    "pursuit", "seed", "delay_s", "start_speed_mps", "true_grip", "simulator",
}  # fmt: skip
"""Settings, beside the car, its line and how long it is driven."""

_TRACK: Final = "race.csv"

_LARGEST_FMU: Final = 1 << 30

_ROOM_SHARES: Final = (1.0, 0.7, 0.5)
"""Of the margin wanted for a training drive: in the tightest bends there may be less room."""

PredictionModel = Literal["e_kinematic", "dynamic"]


@dataclass(frozen=True, eq=False)
class PreparedTrack:
    """A track with its racing line, and the files that processes read them from."""

    track: Track
    line: RaceLine
    track_file: Path
    line_file: Path


@dataclass(frozen=True, eq=False)
class Training:
    """Drives, and what can be learned from them."""

    driven_on: PreparedTrack
    log: Path
    samples: Dataset


@dataclass(frozen=True, eq=False)
class Prepared:
    """What plant and controller are started with."""

    tracks: tuple[PreparedTrack, ...]
    """In the order of the tracks."""
    training: Training | None
    """By pure pursuit; None where weights were given."""
    practice: Training | None
    """The controller's own laps of the training track; None without."""
    weights: Path
    artefacts: tuple[Path, ...]
    """In the order of the models."""

    @property
    def first(self) -> PreparedTrack:
        """The first track."""
        return self.tracks[0]

    @property
    def samples(self) -> list[Dataset]:
        """What the weights were learned from; nothing where they were given."""
        return [one.samples for one in (self.training, self.practice) if one is not None]

    @property
    def arguments(self) -> list[str]:
        """What ``bayesrace controller`` is started with on the first track."""
        return [
            "--artefact", str(self.artefacts[0]), "--track", str(self.first.track_file),
            "--raceline", str(self.first.line_file), "--weights", str(self.weights),
        ]  # fmt: skip


def prepare(
    settings: PreparationSettings,
    tracks: Sequence[str],
    stages: Stages,
    models: Sequence[PredictionModel] = ("e_kinematic",),
    raceline: Path | None = None,
    weights: Path | None = None,
    artefact: Path | None = None,
) -> Prepared:
    """Everything that is needed to drive on ``tracks`` by controllers that predict with ``models``,
    made or taken from the cache, but for the files that are given.

    Raises InputError for a track, car or line that cannot be used, RaceLineError, CompileError, and
    FmuFault if the FMU fails in a training drive.
    """
    if artefact is None:  # what is missing is reported now, not after the training
        code_folder()
        find_compiler()
    else:
        with opened_library(artefact, read_manifest(artefact)):  # it is whole and may be loaded
            pass
    car = settings.driven_car
    driven_on = [load_track(name, car.width_m) for name in tracks]
    prepared_tracks = []
    for track in driven_on:
        with stages.stage(f"racing line, {track.name}"):
            prepared_tracks.append(_prepared_track(track, car, settings.raceline, raceline))
    training = practice = None
    if weights is None:
        train_track = load_track(settings.train_track, car.width_m)
        with stages.stage(f"training line, {train_track.name}"):
            training_track = _training_track(train_track, car, settings.raceline)
            if settings.practice_laps:
                practised_on = _prepared_track(train_track, car, settings.raceline)
    artefacts = [] if artefact is None else [artefact]
    if artefact is None:
        with stages.stage("build the controllers"):
            artefacts = [_artefact(settings, model) for model in models]
    if weights is None:
        with stages.stage("training drive (pure pursuit)"):
            training = _training_drive(training_track, car, settings, artefacts[0])
        with stages.stage("train the residual") as stage:
            learned = training.samples, settings.discretisation, training_settings(settings)
            weights = trained_weights(*learned, progress=stage.update)
        if settings.practice_laps:
            with stages.stage(f"practice, {train_track.name}"):
                practice = _practice(practised_on, car, settings, artefacts[0], weights)
        if practice is not None:
            with stages.stage("train the residual with practice") as stage:
                samples = [training.samples, practice.samples]
                weights, _ = updated_weights(samples, settings, weights, stage.update)
    return Prepared(tuple(prepared_tracks), training, practice, weights, tuple(artefacts))


def _prepared_track(
    track: Track, car: CarParameters, settings: RaceLineSettings, line_file: Path | None = None
) -> PreparedTrack:
    """The racing line computed, from the cache, or from the file that is given."""
    cached = raceline_file(track, car, settings)
    if line_file is None:
        line = racing_line(track, car, settings)
    else:
        line = read_raceline_for(line_file, track, car)
    track_file = cached.with_name(_TRACK)
    track_file.parent.mkdir(parents=True, exist_ok=True)
    with replacing(track_file) as partial:
        write_track(partial, track)
    return PreparedTrack(track, line, track_file, line_file or cached)


def _place(name: str, packages: Sequence[str], *inputs: str | bytes) -> Path:
    """Where the cache keeps what is made from these inputs, by our code and these packages."""
    by = software(SOURCES, ("casadi", "numpy", *packages))
    return cache_folder() / name.format(digest([*inputs, cpu_identity(), *by]))


def _training_track(track: Track, car: CarParameters, settings: RaceLineSettings) -> PreparedTrack:
    """With a racing line that leaves room for a training drive, or as much as the track allows."""
    margin_m = training_margin_m(track, car, settings.margin_m)
    for share in _ROOM_SHARES:
        roomy = settings.model_copy(update={"margin_m": share * margin_m})
        with suppress(InputError, RaceLineError):
            return _prepared_track(track, car, roomy)
    return _prepared_track(track, car, settings)


def _training_drive(
    on: PreparedTrack, car: CarParameters, settings: PreparationSettings, artefact: Path
) -> Training:
    """The pure-pursuit drive, from the cache if it is there; its log is like a race's."""

    def make(partial: Path) -> None:
        drive_for_training(settings, on.track, on.line, car, artefact, partial)

    duration_s = _drive_s(settings, car, on.line)
    return _kept_drive("drive", on, car, settings, make, f"{duration_s!r}")


def _practice(
    on: PreparedTrack,
    car: CarParameters,
    settings: PreparationSettings,
    artefact: Path,
    weights: Path,
) -> Training | None:
    """The controller's own laps, from the cache if they are there; None, with a warning, where
    they say nothing."""
    learned, laps = read_weights(weights), settings.practice_laps

    def make(partial: Path) -> None:
        controller = compiled_controller(artefact, car, on.track, on.line, learned)
        with _vehicle(settings) as vehicle:
            practise(
                on.track, on.line, car, controller, partial, laps, settings.seed,
                settings.start_speed_mps, vehicle, settings.instruments, settings.delay_s,
            )  # fmt: skip

    by = read_manifest(artefact).library_sha256, learned.version, f"{laps}"
    try:
        return _kept_drive("practice", on, car, settings, make, *by)
    except InputError as error:
        _log.warning("the practice on %s is left out: %s", on.track.name, error)
        return None


def _kept_drive(
    name: str,
    on: PreparedTrack,
    car: CarParameters,
    settings: PreparationSettings,
    make: Callable[[Path], None],
    *inputs: str,
) -> Training:
    """A drive that is logged; driven by ``make`` only if these arguments are new."""
    files = [path for path in (settings.fmu, settings.fmu_map) if path is not None]
    others = [] if settings.simulator == "equations" else [settings.simulator]
    line = on.line
    path = _place(
        name + "-{}.mcap", ("mcap", *others),
        on.track.identity,
        *(column.tobytes() for column in (line.s_m, line.x_m, line.y_m, line.vx_mps)),
        car.model_dump_json(),
        settings.model_dump_json(include=_SHAPES_A_DRIVE),
        settings.instruments.model_dump_json(),
        f"{len(files)}",
        *inputs,
        *(read_whole(path, "the FMU or its map", _LARGEST_FMU) for path in files),
    )  # fmt: skip

    def read(log: Path) -> Dataset:
        columns = LogColumns(log, {STATE: STATES, TELEMETRY: CYCLES}).read()
        if columns.reader.truncated or columns.reader.refused:
            raise InputError(f"{log} is damaged")
        step_s = settings.discretisation.step_s
        return dataset_from_columns(columns[STATE], columns[TELEMETRY], car, step_s)

    return Training(on, path, kept(path, make, read))


def _drive_s(settings: PreparationSettings, car: CarParameters, line: RaceLine) -> float:
    """Length of the training drives."""
    return settings.collect_s or drive_length_s(car, line, settings.instruments)


def drive_for_training(
    settings: PreparationSettings,
    track: Track,
    line: RaceLine,
    car: CarParameters,
    artefact: Path,
    log: Path,
) -> list[Driven]:
    """The pure-pursuit drives of the car that the settings simulate, logged.

    ``artefact``: a controller built for the car, whose control cycle drives.
    Raises InputError for an FMU or map that cannot be used, FmuFault if the FMU fails.
    """
    pursuit = settings.pursuit.model_copy(update={"seed": settings.seed})
    duration_s = _drive_s(settings, car, line)
    with _vehicle(settings) as vehicle:
        return collect(
            track, line, car, artefact, log, duration_s, pursuit,
            settings.start_speed_mps, vehicle, settings.instruments, settings.delay_s,
        )  # fmt: skip


def _vehicle(settings: PreparationSettings) -> AbstractContextManager[Vehicle]:
    """What simulates the car of the settings."""
    simulated_by = settings.true_car, settings.fmu, settings.fmu_map, 1 / PLANT.step_s, compiled
    return open_vehicle(*simulated_by, simulator=settings.simulator)


def training_settings(settings: PreparationSettings) -> TrainingSettings:
    """How weights are learned."""
    return TrainingSettings(
        kernels=settings.kernels,
        capacity=settings.points,
        seed=settings.seed,
        widen=settings.widen,
        threads=settings.threads,
    )


def trained_weights(
    samples: Dataset,
    discretisation: Discretisation,
    settings: TrainingSettings,
    initial: Path | None = None,
    progress: Progress | None = None,
) -> Path:
    """File of what :func:`train` returns; trained only if these arguments are new."""
    first = None if initial is None else read_weights(initial)
    path = _place(
        "weights-{}.bin", ("scipy",),
        samples.digest(),
        str(samples.car.mirrored_samples),
        discretisation.model_dump_json(),
        settings.model_dump_json(exclude={"threads"}),
        b"" if first is None else encode_weights(replace(first, created_utc_ns=0)),
    )  # fmt: skip

    def make(partial: Path) -> None:
        # Imported here: it takes a second, and most commands find their weights in the cache.
        from bayesrace.learning.training import train

        weights = train(samples, discretisation, settings, first, progress)
        write_weights(partial, weights)

    kept(path, make, read_weights)
    return path


def updated_weights(
    samples: Sequence[Dataset],
    settings: PreparationSettings,
    first: Path,
    progress: Progress | None = None,
) -> tuple[Path, Dataset]:
    """File of the weights learned from all samples, beginning with ``first``; and the samples, as
    the car would do them now if it has changed since ``first`` was learned.

    ``samples``: in the order in which they were driven.
    """
    from bayesrace.learning.change import brought_up_to_date, said  # a second, as train's

    every, model = concatenate(samples), settings.discretisation
    every, moved = brought_up_to_date(every, read_weights(first), model)
    if moved:
        _log.warning("%s", said(moved, len(every)))
    return trained_weights(every, model, training_settings(settings), first, progress), every


def _artefact(settings: PreparationSettings, model: PredictionModel) -> Path:
    """Folder of the controller that predicts with this model."""
    if model == "dynamic":
        best = BuildSettings.best_case(settings.true_car, settings.horizon, settings.problem)
        return build(best)[0]
    wanted = BuildSettings(
        car=settings.driven_car,
        problem=settings.problem,
        discretisation=settings.discretisation,
        horizon=settings.horizon,
    )
    return build(wanted)[0]


def progress_artefact(settings: PreparationSettings) -> Path:
    """Folder of the controller that maximises progress, as ``bayesrace-limit`` does."""
    wanted = settings.model_copy(update={"problem": "progress", "horizon": None})
    return _artefact(wanted, "e_kinematic")
