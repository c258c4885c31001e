"""What a controller needs before it can drive: line, weights, artefact; kept for the next time.

Training takes seconds, and its outcome depends on samples, settings and code alone, so it is kept
in the cache, as racing lines and built controllers are. The training drive takes a tenth of a
second, given its line, and is driven again.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from pydantic import BaseModel, ConfigDict, Field

from bayesrace.cache import cache_folder, digest, kept, software
from bayesrace.cpu import cpu_identity
from bayesrace.files import replacing
from bayesrace.gp.weights import GpWeights, encode_weights, read_weights, write_weights
from bayesrace.integrators import PREDICTION, Discretisation
from bayesrace.raceline import RaceLineSettings
from bayesrace.raceline.cached import raceline_file, racing_line
from bayesrace.tracks import (
    DEFAULT_RACE_TRACK,
    DEFAULT_TRAINING_TRACK,
    Track,
    load_track,
    write_track,
)
from bayesrace.vehicles import CarParameters, CarSetting, default_car
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
    "trained_weights",
    "training_samples",
]

_WEIGHTS_SOURCES: Final = (
    "bayesrace/vehicles",
    "bayesrace/integrators.py",
    "bayesrace/gp",
    "learning",
)

_TRACK: Final = "race.csv"


class PreparationSettings(BaseModel):
    """What is to be driven, and from what the residual is learned."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    car: CarSetting = Field(default_factory=default_car)
    track: str = DEFAULT_RACE_TRACK
    train_track: str = DEFAULT_TRAINING_TRACK
    collect_s: float | None = Field(
        None, ge=1, le=3600, description="length of the training drive [s]; None: the car's tuning"
    )
    points: int = Field(400, ge=20, le=1024, description="training points per output")
    seed: int = Field(0, ge=0)


@dataclass(frozen=True)
class Prepared:
    """Files that a controller process is started with."""

    track: Path
    raceline: Path
    weights: Path
    artefact: Path


def trained_weights(
    samples: Dataset,
    discretisation: Discretisation,
    settings: TrainingSettings,
    initial: GpWeights | None = None,
    progress: Progress | None = None,
) -> GpWeights:
    """What :func:`train` returns; trained only if these arguments are new."""
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
    car = settings.car
    track = load_track(settings.track, car.width_m)
    line_file = raceline_file(track, car, RaceLineSettings())
    track_file = line_file.with_name(_TRACK)
    track_file.parent.mkdir(parents=True, exist_ok=True)
    with replacing(track_file) as partial:
        write_track(partial, track)
    if raceline is None:
        with stages.stage("racing line"):
            racing_line(track, car)
        raceline = line_file
    if weights is None:
        with stages.stage("training drive (pure pursuit)"):
            training = load_track(settings.train_track, car.width_m)
            duration_s = settings.collect_s or car.tuning.pursuit.drive_s
            samples = training_samples(training, car, duration_s, settings.seed)
        with stages.stage("train the residual") as stage:
            options = TrainingSettings(capacity=settings.points, seed=settings.seed)
            weights = _weights_file(samples, PREDICTION, options, None, stage.update)
    if artefact is None:
        with stages.stage("build the controller"):
            artefact, _ = build(BuildSettings(car=car))
    return Prepared(track_file, raceline, weights, artefact)


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
            b"" if initial is None else encode_weights(replace(initial, created_utc_ns=0)),
            cpu_identity(),
            *software(_WEIGHTS_SOURCES, ("numpy", "scipy", "scikit-learn")),
        ]
    )
    path = cache_folder() / f"weights-{identity}.bin"

    def make(partial: Path) -> None:
        weights = train(samples, discretisation, settings, initial, progress)
        write_weights(partial, weights)

    kept(path, make, read_weights)
    return path
