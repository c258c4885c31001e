"""One case of a campaign: settings, who drives with them, and how each drives; as plain data where
it travels.

:func:`run_case` drives a case in this process: collect, train, drive, update, each as a race does
it. The runs are those of ``bayesrace race`` in lockstep to the bit; what is prepared comes from the
cache, or goes there.
"""

import json
import platform
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import Any, Final, Literal, get_args

import numpy as np
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from rich.console import Console

from bayesrace.cache import cache_folder, cpu_digest, digest, software
from bayesrace.controller.assembly import compiled_controller, make_path_table
from bayesrace.files import read_whole, write_whole
from bayesrace.learning.dataset import Dataset
from bayesrace.operation import preparation
from bayesrace.operation.analysis.laps import trajectory_digest
from bayesrace.operation.closed_loop import ClosedLoop, Driven, built_in_car
from bayesrace.operation.settings import PreparationSettings, RaceSettings
from bayesrace.operation.terminal.terminal import stages_on
from bayesrace.operation.training_drives import SOURCES
from bayesrace.sensors import EXACT
from bayesrace.vehicles import Car

__all__ = ["CONTROLLERS", "FAILED", "LEARNS_FROM", "PAPER", "Case", "Controller", "Files", "Row"]
__all__ += ["car_identity", "factors", "run_case", "software_identity"]

Controller = Literal[
    "worstcase", "bayesrace", "bayesrace-updated", "bayesrace-updated-twice", "bayesrace-limit",
    "bestcase",
]  # fmt: skip
CONTROLLERS: Final[tuple[Controller, ...]] = get_args(Controller)
PAPER: Final[tuple[Controller, ...]] = ("worstcase", "bayesrace", "bayesrace-updated", "bestcase")
LEARNS_FROM: Final[Mapping[Controller, tuple[Controller, ...]]] = {
    "bayesrace-updated": ("bayesrace",),
    "bayesrace-updated-twice": ("bayesrace", "bayesrace-updated"),
    "bayesrace-limit": ("bayesrace",),
}
"""Whose laps a controller's weights are learned from beside the training drives. Training begins
with the weights of the last one named."""

_FIXED: Final = {
    "mode", "every", "fmu", "fmu_map", "simulator", "threads", "limit", "line",
    "discretisation.step_s", "pursuit.step_s", "pursuit.seed",
}  # fmt: skip
"""Settings that a campaign does not vary: it drives the built-in car in lockstep, in the plant's
period, and ``seed`` is the one seed."""

_LEFT_OUT: Final = {"car", "threads", "fmu", "fmu_map", "simulator", "line"}
"""Settings that a row has in other columns, or that no campaign has."""

_SOURCES: Final = (
    *SOURCES, "codegen", "codegen/problems", "operation/analysis/laps.py",
    "operation/preparation.py", "operation/settings.py", "studies/campaign/case.py",
)  # fmt: skip
_PACKAGES: Final = ("casadi", "mcap", "numpy", "scipy")


@cache
def software_identity() -> str:
    """Digest of the code and the libraries that shape a result."""
    return digest(software(_SOURCES, _PACKAGES))


@cache
def factors() -> dict[str, FieldInfo]:
    """Every setting that a plan may vary, by its dotted name."""
    return {name: field for name, field in _fields(RaceSettings, "") if name not in _FIXED}


def _fields(form: type[BaseModel], before: str) -> Iterator[tuple[str, FieldInfo]]:
    for name, field in form.model_fields.items():
        inner = field.annotation
        if name != "car" and isinstance(inner, type) and issubclass(inner, BaseModel):
            yield from _fields(inner, f"{before}{name}.")
        else:
            yield before + name, field


def car_identity(car: Car) -> str:
    """Name and digest of all its values; those of :attr:`Car.identity` are fewer."""
    return f"{car.name}-{digest([car.model_dump_json()])}"


class Files(dict[str, bytes]):
    """Content of the files that a plan names, by ``DIGEST/NAME``."""

    def add(self, path: Path, what: str) -> str:
        """Reads a file; its name here. InputError, which calls it ``what``, if it cannot."""
        data = read_whole(path, what, 1 << 28)
        name = f"{digest([data])}/{path.name}"
        self[name] = data
        return name


@dataclass(frozen=True)
class Case:
    """Settings and controllers; files by their names in :data:`Files`."""

    settings: RaceSettings
    controllers: tuple[Controller, ...] = PAPER
    weights: str = ""
    """Weights that are driven with in place of learned ones; empty without."""

    @property
    def key(self) -> str:
        """Changes with everything that shapes the result, but for the CPU that computes it."""
        settings = self.settings.model_dump_json(exclude={"threads"})
        return digest([settings, *self.controllers, self.weights, software_identity()])

    @property
    def columns(self) -> dict[str, Any]:
        """What all rows of the case share: its key, every factor, and the whole settings."""
        settings = self.settings
        values = {name: attrgetter(name)(settings) for name in factors()}
        return {
            "key": self.key,
            **values | {"car": settings.car.name, "kernels": "+".join(settings.kernels)},
            "sensors": settings.instruments.label,
            "world": settings.changes.label,
            "car_identity": car_identity(settings.car),
            "settings": settings.model_dump_json(exclude=_LEFT_OUT),
        }

    def task(self) -> str:
        """The case as JSON, with the identity of the software that is to compute it."""
        settings = self.settings.model_dump(mode="json")
        return json.dumps(vars(self) | {"settings": settings, "software": software_identity()})

    @classmethod
    def of_task(cls, task: str, files: dict[str, bytes]) -> "Case":
        """The case, with its files written where this machine's cache is.

        Raises RuntimeError if it was made by another version of the software.
        """
        data = json.loads(task)
        if data["software"] != software_identity():
            raise RuntimeError("this worker runs another version of bayesrace or its libraries")
        placed = {name: _placed(data["settings"][name], files) for name in ("track", "train_track")}
        # Workers share the processors: each trains in one thread.
        settings = RaceSettings.model_validate(data["settings"] | placed | {"threads": 1})
        return cls(settings, tuple(data["controllers"]), _placed(data["weights"], files))


def _placed(name: str, files: dict[str, bytes]) -> str:
    """Where this machine has the file of that name; what names no file stays as it is."""
    if name not in files:
        return name
    path = cache_folder() / "campaign" / name
    if not path.exists() or read_whole(path, "a file of the campaign") != files[name]:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, files[name])
    return str(path)


# Driving a case ----------------------------------------------------------------------------------

Row = dict[str, Any]
"""What Parquet keeps of one lap, by column."""

FAILED: Final = "failed"
"""In place of the reason why a run ended, where there was no run."""

_Models = tuple[preparation.PredictionModel, ...]

_one_at_a_time = threading.Lock()
"""Expressions of CasADi are not safe between threads, which a worker may have several of."""


def run_case(task: str, files: dict[str, bytes]) -> list[Row]:
    """The rows of a case (:meth:`Case.task`): one a lap.

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
        self._updates: dict[tuple[Controller, ...], tuple[Path, list[Dataset]]] = {}
        """Weights that are learned from laps, and the samples, by whose."""

    def drive(self, controller: Controller) -> list[Row]:
        """The rows of the controller's laps; of ``bayesrace-limit``, those of its last run."""
        learned = controller == "bayesrace" or controller in LEARNS_FROM
        weights, samples = self._learned(controller) if learned else (None, [])
        begun = time.perf_counter()
        driven = self._runs[controller] = self._driven(controller, weights)
        if controller == "bayesrace-limit" and weights is not None:
            for _ in range(self._settings.progress_runs - 1):
                samples = [*samples, driven.samples()]
                weights, every = preparation.updated_weights(samples, self._settings, weights)
                samples = [every]
                driven = self._driven(controller, weights)
        run = {
            "controller": controller, "weights": driven.weights_version,
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

    def _learned(self, controller: Controller) -> tuple[Path, list[Dataset]]:
        """Weights of the training drives, or learned from laps of others, too; their samples."""
        if controller not in LEARNS_FROM:
            return self._files.weights, self._files.samples
        sources = LEARNS_FROM[controller]
        if sources not in self._updates:
            last = sources[-1]
            if last not in self._runs or not self._files.samples:
                who = last if self._files.samples else "the training drive"
                raise RuntimeError(f"there are no laps of {who} to learn from")
            before, samples = self._learned(last)
            samples = [*samples, self._runs[last].samples()]
            weights, every = preparation.updated_weights(samples, self._settings, before)
            self._updates[sources] = weights, [every]
        return self._updates[sources]

    def _driven(self, controller: Controller, weights: Path | None) -> Driven:
        settings, best = self._settings, controller == "bestcase"
        on = self._files.first.track, self._files.first.line
        artefact = self._files.artefacts[1 if best else 0]
        if controller == "bayesrace-limit":
            artefact = _progress_artefact(settings)
        car = settings.true_car if best else settings.driven_car
        table = _table(*on, car.tuning.path.spacing_m)
        loop = ClosedLoop(
            car, *on, compiled_controller(artefact, car, *on, weights, settings.mpc, table=table),
            _vehicle(settings.true_car, settings.changes),
            sensors=EXACT if best else settings.instruments,
            seed=settings.seed, delay_s=settings.delay_s,
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
