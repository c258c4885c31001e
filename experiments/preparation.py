"""What a controller needs before it can drive: line, weights, artefact; kept for the next time.

The racing lines, the training drive and the training take most of a minute, and their outcome
depends on settings and code alone, so it is kept in the cache beside the built controllers.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from pydantic import BaseModel, ConfigDict, Field

from bayesrace.errors import InputError
from bayesrace.files import replacing
from bayesrace.gp.weights import read_weights, write_weights
from bayesrace.integrators import PREDICTION
from bayesrace.raceline import compute_raceline, read_raceline, write_raceline
from bayesrace.tracks import (
    DEFAULT_RACE_TRACK,
    DEFAULT_TRAINING_TRACK,
    Track,
    load_track,
    write_track,
)
from bayesrace.vehicles import CarParameters, get_car
from codegen.build import build, cache_folder
from codegen.settings import BuildSettings
from controller.pure_pursuit import PurePursuitSettings
from experiments.collect import drive_samples
from experiments.progress import Stages
from learning.dataset import Dataset, filter_dataset
from learning.training import TrainingSettings, train

__all__ = ["PreparationSettings", "Prepared", "prepare", "training_samples"]

_ROOT: Final = Path(__file__).resolve().parents[1]
_SHAPED_BY: Final = (
    "bayesrace/vehicles",
    "bayesrace/integrators.py",
    "bayesrace/tracks",
    "bayesrace/raceline",
    "bayesrace/gp",
    "learning",
    "plant/simulator.py",
    "controller/pure_pursuit.py",
    "experiments/collect.py",
    "experiments/preparation.py",
)
"""Sources on which lines and weights depend."""

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


def training_samples(
    track: Track, car: CarParameters, duration_s: float, seed: int, start_speed_mps: float = 0.1
) -> Dataset:
    """The car's own samples of a pure-pursuit drive on ``track``, without a log."""
    line = compute_raceline(track, car)
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
    folder = cache_folder() / f"line-{_digest(car, track)}"
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(folder / _TRACK) as partial:
        write_track(partial, track)
    if raceline is None:
        raceline = _line(folder, track, car, stages)
    if weights is None:
        weights = _weights(settings, car, stages)
    if artefact is None:
        with stages.stage("build the controller"):
            artefact, _ = build(BuildSettings(car=car.name))
    return Prepared(folder / _TRACK, raceline, weights, artefact)


def _line(folder: Path, track: Track, car: CarParameters, stages: Stages) -> Path:
    path = folder / _LINE
    try:
        read_raceline(path)
    except InputError:  # not there yet, or damaged
        with stages.stage("racing line"), replacing(path) as partial:
            write_raceline(partial, compute_raceline(track, car))
    return path


def _weights(settings: PreparationSettings, car: CarParameters, stages: Stages) -> Path:
    training = load_track(settings.train_track, car.width_m)
    numbers = (settings.collect_s, settings.points, settings.seed)
    path = cache_folder() / f"weights-{_digest(car, training, *numbers)}.bin"
    try:
        read_weights(path)
    except InputError:
        with stages.stage("training drive (pure pursuit)"):
            samples = training_samples(training, car, settings.collect_s, settings.seed)
        with stages.stage("train the residual") as stage:
            options = TrainingSettings(capacity=settings.points, seed=settings.seed)
            write_weights(path, train(samples, PREDICTION, options, progress=stage.update))
    return path


def _digest(car: CarParameters, track: Track, *numbers: float) -> str:
    """Identity of what is made: car, the track's shape, settings, and the code."""
    digest = hashlib.sha256(f"{car.model_dump_json()} {numbers}".encode())
    for column in (track.x_m, track.y_m, track.width_right_m, track.width_left_m):
        digest.update(column.tobytes())
    for name in _SHAPED_BY:
        path = _ROOT / name
        for source in sorted(path.rglob("*.py")) if path.is_dir() else [path]:
            digest.update(source.name.encode() + b"\0" + source.read_bytes())
    return digest.hexdigest()[:16]
