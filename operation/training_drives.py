"""Training drives and practice, each kept in the cache with all that shapes it.

A car is first driven by pure pursuit on its training track, then by the controller itself, with
what it has learned there. Bends of a small track are slow: for faster ones the controller practises
on larger copies of the track.
"""

import logging
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from bayesrace.cache import cache_folder, cpu_identity, digest, kept, software
from bayesrace.codegen.compiler import compiled
from bayesrace.columns import LogColumns
from bayesrace.controller.assembly import compiled_controller
from bayesrace.errors import InputError
from bayesrace.files import read_whole, replacing
from bayesrace.gp.weights import read_weights
from bayesrace.learning.coverage import Coverage, asked
from bayesrace.learning.dataset import Dataset
from bayesrace.learning.sources import CYCLES, STATES, dataset_from_columns
from bayesrace.manifest import read_manifest
from bayesrace.messages import STATE, TELEMETRY
from bayesrace.operation.closed_loop import Driven
from bayesrace.operation.collect import collect, drive_length_s, practise, training_margin_m
from bayesrace.operation.settings import PreparationSettings
from bayesrace.plant.simulator import PLANT
from bayesrace.plant.vehicle import Vehicle, open_vehicle
from bayesrace.raceline import (
    RaceLine,
    RaceLineError,
    RaceLineSettings,
    raceline_file,
    racing_line,
    read_raceline_for,
    write_raceline,
)
from bayesrace.raceline.friction import timed_line
from bayesrace.tracks import Track, write_track
from bayesrace.tracks.spline import fit_arc_length
from bayesrace.vehicles import Car

__all__ = [
    "LARGER",
    "SOURCES",
    "PreparedTrack",
    "Training",
    "drive_for_training",
    "larger_course",
    "place",
    "practice",
    "prepared_track",
    "training_drive",
    "training_track",
]

SOURCES: Final = (
    ".", "gp", "messages", "raceline", "tracks",
    "vehicles", "controller", "controller/native", "learning", "plant", "plant/fmu",
    "operation/closed_loop.py", "operation/collect.py", "operation/run_plan.py",
    "operation/training_drives.py",
)  # fmt: skip
"""Our code that shapes a training drive and what is learned from it."""

LARGER: Final = (1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0)
"""Sizes of the copies of a training track, over its own."""
_REMAINING: Final = 0.1
"""Of what is missing, the most that a lap of the copy that is chosen leaves ..."""
_NEGLIGIBLE: Final = 0.02
"""... or of the whole lap."""

_log = logging.getLogger(__name__)

_SHAPES_A_DRIVE: Final = {
    "pursuit", "seed", "delay_s", "start_speed_mps", "true_grip", "simulator",
}  # fmt: skip
"""Settings, beside the car, its line and how long it is driven."""

_TRACK: Final = "race.csv"
_LINE: Final = "practice_raceline.csv"

_LARGEST_FMU: Final = 1 << 30

_ROOM_SHARES: Final = (1.0, 0.7, 0.5)
"""Of the margin wanted for a training drive: in the tightest bends there may be less room."""


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


def place(name: str, packages: Sequence[str], *inputs: str | bytes) -> Path:
    """Where the cache keeps what is made from these inputs, by our code and these packages."""
    by = software(SOURCES, ("casadi", "numpy", *packages))
    return cache_folder() / name.format(digest([*inputs, cpu_identity(), *by]))


def prepared_track(
    track: Track, car: Car, settings: RaceLineSettings, line_file: Path | None = None
) -> PreparedTrack:
    """The racing line computed, from the cache, or from the file that is given."""
    cached = raceline_file(track, car, settings)
    if line_file is None:
        line = racing_line(track, car, settings)
    else:
        line = read_raceline_for(line_file, track, car)
    return PreparedTrack(track, line, _track_beside(cached, track), line_file or cached)


def larger_course(
    on: PreparedTrack,
    size: float,
    known: Coverage,
    car: Car,
    settings: RaceLineSettings,
) -> tuple[float, PreparedTrack] | None:
    """The smallest copy of the training track, of those that are larger than ``size`` times, on
    which the car is driven at nearly all that was not ``known`` before; and how much larger it
    is. None: there is none.

    The line is the same, larger, at the speeds that friction and drive allow.
    """
    for larger in (one for one in LARGER if one > size):
        name = f"{on.track.name}-x{larger:g}"
        line = timed_line(name, fit_arc_length(larger * on.line.xy_m), car, settings)
        left = 1 - known.with_samples(asked([line])).share
        if left > max(_REMAINING * (1 - known.share), _NEGLIGIBLE):
            continue
        track = _enlarged(on.track, larger, name)
        file = raceline_file(track, car, settings).with_name(_LINE)
        on_file = _track_beside(file, track)
        with replacing(file) as partial:
            write_raceline(partial, line)
        return larger, PreparedTrack(track, line, on_file, file)
    return None


def _enlarged(track: Track, size: float, name: str) -> Track:
    """A copy that is so many times as large."""
    centre, right, left = (
        size * one
        for one in (
            np.column_stack([track.x_m, track.y_m]), track.width_right_m, track.width_left_m
        )
    )  # fmt: skip
    return Track.from_points(name, centre, right, left)


def _track_beside(line_file: Path, track: Track) -> Path:
    """The track's file in the folder of its line."""
    file = line_file.with_name(_TRACK)
    file.parent.mkdir(parents=True, exist_ok=True)
    with replacing(file) as partial:
        write_track(partial, track)
    return file


def training_track(track: Track, car: Car, settings: RaceLineSettings) -> PreparedTrack:
    """With a racing line that leaves room for a training drive, or as much as the track allows."""
    margin_m = training_margin_m(track, car, settings.margin_m)
    for share in _ROOM_SHARES:
        roomy = settings.model_copy(update={"margin_m": share * margin_m})
        with suppress(InputError, RaceLineError):
            return prepared_track(track, car, roomy)
    return prepared_track(track, car, settings)


def training_drive(
    on: PreparedTrack, car: Car, settings: PreparationSettings, artefact: Path
) -> Training:
    """The pure-pursuit drive, from the cache if it is there; its log is like a race's."""

    def make(partial: Path) -> None:
        drive_for_training(settings, on.track, on.line, car, artefact, partial)

    duration_s = _drive_s(settings, car, on.line)
    return _kept_drive("drive", on, car, settings, make, f"{duration_s!r}")


def practice(
    on: PreparedTrack,
    car: Car,
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
    car: Car,
    settings: PreparationSettings,
    make: Callable[[Path], None],
    *inputs: str,
) -> Training:
    """A drive that is logged; driven by ``make`` only if these arguments are new."""
    files = [path for path in (settings.fmu, settings.fmu_map) if path is not None]
    others = [] if settings.simulator == "equations" else [settings.simulator]
    line = on.line
    path = place(
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


def _drive_s(settings: PreparationSettings, car: Car, line: RaceLine) -> float:
    """Length of the training drives."""
    return settings.collect_s or drive_length_s(car, line, settings.instruments)


def drive_for_training(
    settings: PreparationSettings,
    track: Track,
    line: RaceLine,
    car: Car,
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
