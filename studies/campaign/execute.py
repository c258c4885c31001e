"""Drives one case in this process: collect, train, drive, update, each as a race does it.

The runs are those of ``bayesrace race`` in lockstep to the bit; what is prepared comes from the
cache, or goes there.
"""

import platform
import threading
import time
from functools import cached_property, lru_cache
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import Console

from bayesrace.arrays import Floats
from bayesrace.cpu import cpu_digest
from bayesrace.gp.weights import GpWeights, read_weights
from bayesrace.vehicles import CarParameters
from controller.assembly import compiled_controller
from controller.path_table import PathTable, make_path_table
from learning.dataset import Dataset
from operation.analysis.laps import trajectory_digest
from operation.closed_loop import ClosedLoop, Driven, built_in_car
from operation.preparation import (
    PredictionModel,
    Prepared,
    PreparedTrack,
    prepare,
    progress_artefact,
    updated_weights,
)
from operation.settings import PreparationSettings, RaceSettings
from operation.terminal.progress import stages_on
from plant.simulator import Simulator
from studies.campaign.case import LEARNS_FROM, Case, Controller, Files, software_identity

__all__ = ["FAILED", "Row", "run_case"]

Row = dict[str, Any]
"""What Parquet keeps of one lap, by column."""

FAILED: Final = "failed"
"""In place of the reason why a run ended, where there was no run."""

_MODELS: Final[tuple[PredictionModel, ...]] = ("e_kinematic", "dynamic")

_LEARNED_FROM: Final = frozenset(chain.from_iterable(LEARNS_FROM.values()))
"""Whose laps others learn from."""

_one_at_a_time = threading.Lock()
"""Expressions of CasADi are not safe between threads, which a worker may have several of."""


def run_case(task: str, files: Files) -> list[Row]:
    """The rows of a case (:meth:`studies.campaign.case.Case.task`): one a lap.

    A run that fails has a row with its reason; the others are driven all the same. Raises
    RuntimeError where this is another version of the software than made the case.
    """
    begun = time.perf_counter()
    with _one_at_a_time:
        case = Case.of_task(task, files)
        runs = _Runs(case)
        rows: list[Row] = []
        for controller in case.controllers:
            try:
                rows += runs.drive(controller)
            except Exception as error:  # whatever it is: it must not end the campaign
                text = " ".join(str(error).split()) or "no message"
                rows.append(
                    {
                        "controller": controller,
                        "ended": FAILED,
                        "reason": f"{type(error).__name__}: {text}"[:1000],
                    }
                )
    shared = {
        "software": software_identity(),
        "cpu": cpu_digest(),
        "host": platform.node(),
        "case_s": time.perf_counter() - begun,
    }
    return [shared | row for row in rows]


@lru_cache(maxsize=64)
def _prepared(
    settings: str, track: str, models: tuple[PredictionModel, ...], weights: str
) -> Prepared:
    """What many cases share is looked up in the cache once."""
    with stages_on(Console(quiet=True)) as stages:
        return prepare(
            PreparationSettings.model_validate_json(settings),
            (track,),
            stages,
            models,
            weights=Path(weights) if weights else None,
        )


@lru_cache(maxsize=64)
def _progress_artefact(settings: str) -> Path:
    """The controller of ``bayesrace-limit``."""
    return progress_artefact(RaceSettings.model_validate_json(settings))


@lru_cache(maxsize=64)
def _table(track: PreparedTrack, spacing_m: float) -> PathTable:
    return make_path_table(track.track, track.line, spacing_m)


@lru_cache(maxsize=8)
def _vehicle(car: str) -> Simulator:
    """To make its equations takes longer than to drive some laps by them."""
    return built_in_car(CarParameters.model_validate_json(car))


class _Runs:
    """The runs of a case, one after the other."""

    def __init__(self, case: Case) -> None:
        self._case, self._settings = case, case.settings
        self._runs: dict[Controller, Driven] = {}
        self._updates: dict[tuple[Controller, ...], GpWeights] = {}
        """Weights that are learned from laps, by whose."""

    def drive(self, controller: Controller) -> list[Row]:
        """The rows of the controller's laps; of ``bayesrace-limit``, those of its last run."""
        weights = self._weights(controller)
        begun = time.perf_counter()
        driven = self._driven(controller, weights)
        if controller in _LEARNED_FROM:
            self._runs[controller] = driven
        if controller == "bayesrace-limit" and weights is not None:
            samples = self._samples_of(LEARNS_FROM[controller])
            for _ in range(self._settings.progress_runs - 1):
                samples.append(driven.samples())
                weights = self._learned(samples, weights)
                driven = self._driven(controller, weights)
        run = {
            "controller": controller,
            "weights": "" if weights is None else weights.version,
            "trajectory_sha256": trajectory_digest(driven.x, driven.laps),
            "ended": driven.end.reason,
            "drive_s": time.perf_counter() - begun,
            "simulated_s": float(driven.time_s[-1]),
            **_step_times(driven.step_us),
        }
        return [run | lap for lap in _laps(driven, self._settings.laps)]

    @cached_property
    def _files(self) -> Prepared:
        settings = self._settings.model_dump(include=set(PreparationSettings.model_fields))
        models = _MODELS if "bestcase" in self._case.controllers else _MODELS[:1]
        needed = PreparationSettings.model_validate(settings).model_dump_json()
        return _prepared(needed, self._settings.track, models, self._case.weights)

    def _weights(self, controller: Controller) -> GpWeights | None:
        if controller == "bayesrace" or controller in LEARNS_FROM:
            return self._trained(controller)
        return None

    def _trained(self, controller: Controller) -> GpWeights:
        """The weights of a controller that has some."""
        if controller not in LEARNS_FROM:
            return read_weights(self._files.weights)
        sources = LEARNS_FROM[controller]
        if sources not in self._updates:
            samples = self._samples_of(sources)
            self._updates[sources] = self._learned(samples, self._trained(sources[-1]))
        return self._updates[sources]

    def _samples_of(self, controllers: tuple[Controller, ...]) -> list[Dataset]:
        """Those of the training drive, and of the laps of these controllers."""
        if (training := self._files.training) is None:
            raise RuntimeError("there is no training drive to learn from")
        for one in controllers:
            if one not in self._runs:
                raise RuntimeError(f"there are no laps of '{one}' to learn from")
        return [training.samples, *(self._runs[one].samples() for one in controllers)]

    def _learned(self, samples: list[Dataset], before: GpWeights) -> GpWeights:
        return read_weights(updated_weights(samples, self._settings, before))

    def _artefact(self, controller: Controller) -> Path:
        if controller == "bayesrace-limit":
            return _progress_artefact(self._settings.model_dump_json())
        return self._files.artefacts[1 if controller == "bestcase" else 0]

    def _driven(self, controller: Controller, weights: GpWeights | None) -> Driven:
        settings, files = self._settings, self._files
        track, best = files.first, controller == "bestcase"
        car = settings.true_car if best else settings.driven_car
        loop = ClosedLoop(
            car,
            track.track,
            track.line,
            compiled_controller(
                self._artefact(controller), car, track.track, track.line, weights,
                settings.mpc, table=_table(track, car.tuning.path.spacing_m),
            ),
            _vehicle(settings.true_car.model_dump_json()),
            noise=settings.noise, seed=settings.seed, delay_s=settings.delay_s,
        )  # fmt: skip
        limit_s = settings.limit_s(track.line.lap_time_s)
        return loop.drive(settings.laps, limit_s, settings.start_speed_mps, name=controller)


def _step_times(step_us: Floats) -> Row:
    if not len(step_us):
        return {}
    p50, p99, largest = np.percentile(step_us, [50, 99, 100]).tolist()
    return {"step_p50_us": p50, "step_p99_us": p99, "step_max_us": largest}


def _laps(driven: Driven, wanted: int) -> list[Row]:
    """A row for each lap, and one for the first that was not finished."""
    laps = driven.laps
    finished = len(laps.times_s)
    ends = [0, *laps.after]
    off_track_m = driven.off_track_m
    if finished < wanted:
        ends.append(len(driven.x))
        if finished:  # the rest of a run counts in none of its laps
            off_track_m = driven.track.project_path(driven.x[:, :2]).off_track_m
    rows = []
    for number, (first, last) in enumerate(pairwise(ends)):
        depth = off_track_m[first:last]
        rows.append(
            {
                "lap": number + 1,
                "lap_time_s": laps.times_s[number] if number < finished else None,
                "samples": last - first,
                "off_track_samples": int((depth > 0).sum()),
                "off_track_max_m": max(0.0, float(np.max(depth, initial=0.0))),
                "fallbacks": int((driven.levels[first:last] > 0).sum()),
                "reason": "" if number < finished else _unfinished(driven),
            }
        )
    return rows


def _unfinished(driven: Driven) -> str:
    if driven.laps.cut_at is None:
        return driven.end.text
    return "the car left out a piece of the track"
