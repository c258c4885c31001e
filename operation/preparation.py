"""What is made before anything can be driven: racing lines, training drives, weights, controllers.

Each depends on settings, files and code alone, is kept in the cache under a digest of all of them,
and is made only if it is not there. ``race``, ``bench`` and ``latency`` prepare by :func:`prepare`.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Literal

from bayesrace.cache import code_folder, kept
from bayesrace.codegen.build import build
from bayesrace.codegen.compiler import find_compiler
from bayesrace.codegen.settings import BuildSettings
from bayesrace.controller.assembly import compiled_controller
from bayesrace.gp.weights import encode_weights, read_weights, write_weights
from bayesrace.integrators import Discretisation
from bayesrace.learning.coverage import coverage
from bayesrace.learning.dataset import Dataset, concatenate
from bayesrace.learning.settings import Progress, TrainingSettings
from bayesrace.manifest import opened_library, read_manifest
from bayesrace.operation.settings import PreparationSettings
from bayesrace.operation.terminal.terminal import Stages
from bayesrace.operation.training_drives import (
    PreparedTrack,
    Training,
    larger_course,
    place,
    practice,
    prepared_track,
    training_drive,
    training_track,
)
from bayesrace.tracks import load_track
from bayesrace.vehicles import Car

__all__ = [
    "Prepared",
    "model_artefact",
    "prepare",
    "progress_artefact",
    "trained_weights",
    "training_settings",
    "updated_weights",
]

_log = logging.getLogger(__name__)

_MOST_COPIES: Final = 3
"""Of the training track, larger ones, that practice goes on to."""

PredictionModel = Literal["e_kinematic", "dynamic"]


@dataclass(frozen=True, eq=False)
class Prepared:
    """What plant and controller are started with."""

    tracks: tuple[PreparedTrack, ...]
    """In the order of the tracks."""
    training: Training | None
    """By pure pursuit; None where weights were given."""
    practices: tuple[Training, ...]
    """The controller's own laps of the training track, and of larger copies of it."""
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
        first = [] if self.training is None else [self.training]
        return [one.samples for one in (*first, *self.practices)]

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
    if weights is None:
        load_track(settings.train_track, car.width_m)
    prepared_tracks = []
    for track in driven_on:
        with stages.stage(f"racing line, {track.name}"):
            prepared_tracks.append(prepared_track(track, car, settings.raceline, raceline))
    artefacts = [] if artefact is None else [artefact]
    if artefact is None:
        with stages.stage("build the controllers"):
            artefacts = [model_artefact(settings, model) for model in models]
    training, practices = None, list[Training]()
    if weights is None:
        training, practices, weights = _learned(settings, artefacts[0], prepared_tracks, stages)
    return Prepared(tuple(prepared_tracks), training, tuple(practices), weights, tuple(artefacts))


def _learned(
    settings: PreparationSettings, artefact: Path, races: Sequence[PreparedTrack], stages: Stages
) -> tuple[Training, list[Training], Path]:
    """The training drives and practice, and the weights learned from both, for these races."""
    car = settings.driven_car
    track = load_track(settings.train_track, car.width_m)
    with stages.stage(f"training line, {track.name}"):
        on = roomy = training_track(track, car, settings.raceline)
        if settings.practice_laps:
            on = prepared_track(track, car, settings.raceline)
    with stages.stage("training drive (pure pursuit)"):
        training = training_drive(roomy, car, settings, artefact)
    with stages.stage("train the residual") as stage:
        learned = training.samples, settings.discretisation, training_settings(settings)
        weights = trained_weights(*learned, progress=stage.update)
    every, practices, course, size = training.samples, list[Training](), on, 1.0
    while settings.practice_laps:
        with stages.stage(f"practice, {course.track.name}"):
            laps = practice(course, car, settings, artefact, weights)
        if laps is None:
            break
        practices.append(laps)
        number = f", {len(practices)}" if len(practices) > 1 else ""
        with stages.stage(f"train the residual with practice{number}") as stage:
            samples = [every, laps.samples]
            weights, every = updated_weights(samples, settings, weights, stage.update)
        lost = _lost(artefact, car, races, weights)
        if lost <= settings.practice_until:
            break
        known = coverage([one.line for one in races], every.x)
        more = len(practices) <= _MOST_COPIES
        found = larger_course(on, size, known, car, settings.raceline) if more else None
        if found is None:
            _log.warning("first laps lose %.1f %%: of %s, %s", 100 * lost, track.name, known)
            break
        size, course = found
    return training, practices, weights


def _lost(artefact: Path, car: Car, races: Sequence[PreparedTrack], weights: Path) -> float:
    """Of a lap, the largest share that a race loses where its line is faster than what the weights
    know."""
    learned, lost = read_weights(weights), 0.0
    for race in races:
        controller = compiled_controller(artefact, car, race.track, race.line, learned)
        lost = max(lost, controller.native.unknown_s / race.line.lap_time_s)
    return lost


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
    path = place(
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


def model_artefact(settings: PreparationSettings, model: PredictionModel) -> Path:
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
    return model_artefact(wanted, "e_kinematic")
