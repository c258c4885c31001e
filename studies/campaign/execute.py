"""Drives one case in this process: collect, train, drive, update, each as a race does it.

The runs are those of ``bayesrace race`` in lockstep to the bit; what is prepared comes from the
cache, or goes there.
"""

import platform
import threading
import time
from functools import cached_property, lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
from rich.console import Console

from bayesrace.cache import cpu_digest
from bayesrace.controller.assembly import compiled_controller, make_path_table
from bayesrace.gp.weights import GpWeights, read_weights
from bayesrace.learning.dataset import Dataset
from bayesrace.operation import preparation
from bayesrace.operation.analysis.laps import trajectory_digest
from bayesrace.operation.closed_loop import ClosedLoop, Driven, built_in_car
from bayesrace.operation.settings import PreparationSettings
from bayesrace.operation.terminal.terminal import stages_on
from bayesrace.studies.campaign.case import LEARNS_FROM, Case, Controller, software_identity

__all__ = ["FAILED", "Row", "run_case"]

Row = dict[str, Any]
"""What Parquet keeps of one lap, by column."""

FAILED: Final = "failed"
"""In place of the reason why a run ended, where there was no run."""

_Models = tuple[preparation.PredictionModel, ...]

_one_at_a_time = threading.Lock()
"""Expressions of CasADi are not safe between threads, which a worker may have several of."""


def run_case(task: str, files: dict[str, bytes]) -> list[Row]:
    """The rows of a case (:meth:`bayesrace.studies.campaign.case.Case.task`): one a lap.

    A run that fails has a row with its reason; the others are driven all the same. Raises
    RuntimeError where this is another version of the software than made the case.
    """
    begun = time.perf_counter()
    with _one_at_a_time:
        case = Case.of_task(task, files)
        runs, rows = _Runs(case), list[Row]()
        for controller in case.controllers:
            try:
                rows += runs.drive(controller)
            except Exception as error:  # whatever it is: it must not end the campaign
                text = " ".join(str(error).split()) or "no message"
                reason = f"{type(error).__name__}: {text}"[:1000]
                rows.append({"controller": controller, "ended": FAILED, "reason": reason})
    where = {"software": software_identity(), "cpu": cpu_digest(), "host": platform.node()}
    case_s = time.perf_counter() - begun
    return [where | {"case_s": case_s} | row for row in rows]


@lru_cache(maxsize=64)
def _prepared(
    settings: PreparationSettings, track: str, models: _Models, weights: str
) -> preparation.Prepared:
    """What many cases share is looked up in the cache once."""
    given = Path(weights) if weights else None
    with stages_on(Console(quiet=True)) as stages:
        return preparation.prepare(settings, (track,), stages, models, weights=given)


_progress_artefact = lru_cache(maxsize=64)(preparation.progress_artefact)
_table = lru_cache(maxsize=64)(make_path_table)
_vehicle = lru_cache(maxsize=8)(built_in_car)
"""To make the car's equations takes longer than to drive some laps by them."""


class _Runs:
    """The runs of a case, one after the other."""

    def __init__(self, case: Case) -> None:
        self._case, self._settings = case, case.settings
        self._runs: dict[Controller, Driven] = {}
        self._updates: dict[tuple[Controller, ...], GpWeights] = {}
        """Weights that are learned from laps, by whose."""

    def drive(self, controller: Controller) -> list[Row]:
        """The rows of the controller's laps; of ``bayesrace-limit``, those of its last run."""
        learned = controller == "bayesrace" or controller in LEARNS_FROM
        weights = self._weights(controller) if learned else None
        begun = time.perf_counter()
        driven = self._runs[controller] = self._driven(controller, weights)
        if controller == "bayesrace-limit" and weights is not None:
            samples = self._samples_of(LEARNS_FROM[controller])
            for _ in range(self._settings.progress_runs - 1):
                samples.append(driven.samples())
                weights = self._learned(samples, weights)
                driven = self._driven(controller, weights)
        run = {
            "controller": controller, "weights": "" if weights is None else weights.version,
            "trajectory_sha256": trajectory_digest(driven.x, driven.laps),
            "ended": driven.end.reason, "drive_s": time.perf_counter() - begun,
            "simulated_s": float(driven.time_s[-1]),
        }  # fmt: skip
        if len(driven.step_us):
            times = np.percentile(driven.step_us, [50, 99, 100]).tolist()
            run |= dict(zip(("step_p50_us", "step_p99_us", "step_max_us"), times, strict=True))
        return [run | lap for lap in _laps(driven, self._settings.laps)]

    @cached_property
    def _files(self) -> preparation.Prepared:
        wanted = self._settings.model_dump(include=set(PreparationSettings.model_fields))
        best = "bestcase" in self._case.controllers
        models: _Models = ("e_kinematic", "dynamic") if best else ("e_kinematic",)
        settings = PreparationSettings.model_validate(wanted)
        return _prepared(settings, self._settings.track, models, self._case.weights)

    def _weights(self, controller: Controller) -> GpWeights:
        """Those of the training drive, or learned from the laps of others, too."""
        if controller not in LEARNS_FROM:
            return read_weights(self._files.weights)
        sources = LEARNS_FROM[controller]
        if sources not in self._updates:
            samples, before = self._samples_of(sources), self._weights(sources[-1])
            self._updates[sources] = self._learned(samples, before)
        return self._updates[sources]

    def _samples_of(self, controllers: tuple[Controller, ...]) -> list[Dataset]:
        """Those of the training drive, and of the laps of these controllers."""
        missing = [one for one in controllers if one not in self._runs]
        if missing or (training := self._files.training) is None:
            who = ", ".join(missing) or "the training drive"
            raise RuntimeError(f"there are no laps of {who} to learn from")
        return [training.samples, *(self._runs[one].samples() for one in controllers)]

    def _learned(self, samples: list[Dataset], before: GpWeights) -> GpWeights:
        return read_weights(preparation.updated_weights(samples, self._settings, before))

    def _driven(self, controller: Controller, weights: GpWeights | None) -> Driven:
        settings, best = self._settings, controller == "bestcase"
        on = self._files.first.track, self._files.first.line
        artefact = self._files.artefacts[1 if best else 0]
        if controller == "bayesrace-limit":
            artefact = _progress_artefact(settings)
        car = settings.true_car if best else settings.driven_car
        table = _table(*on, car.tuning.path.spacing_m)
        loop = ClosedLoop(
            car, *on, compiled_controller(artefact, car, *on, weights, settings.mpc, table=table),
            _vehicle(settings.true_car), noise=settings.noise, seed=settings.seed,
            delay_s=settings.delay_s,
        )  # fmt: skip
        limit_s = settings.limit_s(on[1].lap_time_s)
        return loop.drive(settings.laps, limit_s, settings.start_speed_mps, name=controller)


def _laps(driven: Driven, wanted: int) -> list[Row]:
    """A row for each lap, and one for the first that was not finished."""
    laps = driven.laps
    ends, times_s = [0, *laps.after], list[float | None](laps.times_s)
    off_track_m, reason = driven.off_track_m, driven.end.text
    if len(times_s) < wanted:
        if times_s:  # the rest of a run counts in none of its laps
            off_track_m = driven.track.project_path(driven.x[:, :2]).off_track_m
        if laps.cut_at is not None:
            reason = "the car left out a piece of the track"
        ends.append(len(driven.x))
        times_s.append(None)
    rows = []
    for number, (first, last) in enumerate(pairwise(ends)):
        depth, time_s = off_track_m[first:last], times_s[number]
        rows.append({
            "lap": number + 1, "lap_time_s": time_s, "samples": last - first,
            "off_track_samples": int((depth > 0).sum()),
            "off_track_max_m": float(np.max(depth, initial=0.0)),
            "fallbacks": int((driven.levels[first:last] > 0).sum()),
            "reason": reason if time_s is None else "",
        })  # fmt: skip
    return rows
