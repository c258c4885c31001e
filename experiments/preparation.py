"""What a controller needs before it can drive: line, weights, artefact; kept for the next time.

Racing lines, the training drive and the training take most of a minute, and their outcome depends
on settings, samples and code alone, so it is kept in the cache beside the built controllers.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from pydantic import BaseModel, ConfigDict, Field

from bayesrace.cache import cache_folder, digest, kept, software
from bayesrace.files import replacing
from bayesrace.gp.weights import GpWeights, read_weights, write_weights
from bayesrace.integrators import PREDICTION, Discretisation
from bayesrace.raceline import (
    RaceLine,
    RaceLineSettings,
    compute_raceline,
    read_raceline,
    write_raceline,
)
from bayesrace.tracks import (
    DEFAULT_RACE_TRACK,
    DEFAULT_TRAINING_TRACK,
    Track,
    load_track,
    write_track,
)
from bayesrace.vehicles import CarParameters, get_car
from codegen.build import build
from codegen.settings import BuildSettings
from controller.pure_pursuit import PurePursuitSettings
from experiments.collect import drive_samples
from experiments.progress import Stages
from learning.dataset import Dataset, filter_dataset
from learning.training import Progress, TrainingSettings, train

__all__ = [
    "PreparationSettings",
    "Prepared",
    "prepare",
    "racing_line",
    "trained_weights",
    "training_samples",
]

_LINE_SOURCES: Final = ("bayesrace/vehicles", "bayesrace/tracks", "bayesrace/raceline")
_WEIGHTS_SOURCES: Final = (
    "bayesrace/vehicles",
    "bayesrace/integrators.py",
    "bayesrace/gp",
    "learning",
)

_TRACK, _LINE = "race.csv", "race_raceline.csv"


class PreparationSettings(BaseModel):
    """What is to be driven, and from what the residual is learned."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    car: str = "orca"
    track: str = DEFAULT_RACE_TRACK
    train_track: str = DEFAULT_TRAINING_TRACK
    collect_s: float = Field(12.0, ge=1, le=600, description="length of the training drive")
    points: int = Field(400, ge=20, le=1024, description="training points per output")
    seed: int = Field(0, ge=0)


@dataclass(frozen=True)
class Prepared:
    """Files that a controller process is started with."""

    track: Path
    raceline: Path
    weights: Path
    artefact: Path


def racing_line(
    track: Track, car: CarParameters, settings: RaceLineSettings | None = None
) -> RaceLine:
    """:func:`compute_raceline`, or what it returned for the same track, car and settings before."""
    settings = settings or RaceLineSettings()
    return kept(
        _line_folder(track, car, settings) / _LINE,
        lambda path: write_raceline(path, compute_raceline(track, car, settings)),
        lambda path: read_raceline(path, track.name),
    )


def trained_weights(
    samples: Dataset,
    discretisation: Discretisation,
    settings: TrainingSettings,
    initial: GpWeights | None = None,
    progress: Progress | None = None,
) -> GpWeights:
    """:func:`train`, or what it returned for the same samples, settings and beginning before."""
    return read_weights(_weights_file(samples, discretisation, settings, initial, progress))


def training_samples(
    track: Track, car: CarParameters, duration_s: float, seed: int, start_speed_mps: float = 0.1
) -> Dataset:
    """The car's own samples of a pure-pursuit drive on ``track``, without a log."""
    line = racing_line(track, car)
    pursuit = PurePursuitSettings(seed=seed)
    x, u = drive_samples(track, line, car, duration_s, pursuit, start_speed_mps)
    return filter_dataset(Dataset(car, PREDICTION.step_s, x[:-1], u, x[1:]))


def prepare(
    settings: PreparationSettings,
    stages: Stages,
    raceline: Path | None = None,
    weights: Path | None = None,
    artefact: Path | None = None,
) -> Prepared:
    """All files, made or taken from the cache, but for those that are given.

    Raises InputError for a track or car that cannot be used, RaceLineError and CompileError.
    """
    car = get_car(settings.car)
    track = load_track(settings.track, car.width_m)
    folder = _line_folder(track, car, RaceLineSettings())
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(folder / _TRACK) as partial:
        write_track(partial, track)
    if raceline is None:
        with stages.stage("racing line"):
            racing_line(track, car)
        raceline = folder / _LINE
    if weights is None:
        with stages.stage("training drive (pure pursuit)"):
            training = load_track(settings.train_track, car.width_m)
            samples = training_samples(training, car, settings.collect_s, settings.seed)
        with stages.stage("train the residual") as stage:
            options = TrainingSettings(capacity=settings.points, seed=settings.seed)
            weights = _weights_file(samples, PREDICTION, options, None, stage.update)
    if artefact is None:
        with stages.stage("build the controller"):
            artefact, _ = build(BuildSettings(car=car.name))
    return Prepared(folder / _TRACK, raceline, weights, artefact)


def _line_folder(track: Track, car: CarParameters, settings: RaceLineSettings) -> Path:
    """Where the line is kept, named after the car, the track's shape, settings and code."""
    columns = (track.x_m, track.y_m, track.width_right_m, track.width_left_m)
    identity = digest(
        [
            car.model_dump_json(),
            settings.model_dump_json(),
            *(column.tobytes() for column in columns),
            *software(_LINE_SOURCES, ("casadi", "numpy")),
        ]
    )
    return cache_folder() / f"line-{identity}"


def _weights_file(
    samples: Dataset,
    discretisation: Discretisation,
    settings: TrainingSettings,
    initial: GpWeights | None,
    progress: Progress | None,
) -> Path:
    identity = digest(
        [
            samples.digest(),
            discretisation.model_dump_json(),
            settings.model_dump_json(),
            "" if initial is None else initial.version,  # of its content
            *software(_WEIGHTS_SOURCES, ("numpy", "scipy", "scikit-learn")),
        ]
    )
    path = cache_folder() / f"weights-{identity}.bin"

    def make(partial: Path) -> None:
        weights = train(samples, discretisation, settings, initial, progress)
        write_weights(partial, weights)

    kept(path, make, read_weights)
    return path
