"""The plan of a campaign: a TOML file that says what varies.

    controllers = ["bayesrace", "bayesrace-updated", "bestcase"]

    [grid]                                  # every combination
    track = ["harbour", "random:1..100"]
    seed = "0..4"

    [random]                                # drawn for each combination, ``draws`` times
    true_grip = { low = 0.8, high = 1.2 }

Every setting of :class:`~operation.settings.RaceSettings` may stand in either table, but for a few
that a campaign fixes. A text that ends in ``A..B`` stands for the whole numbers from A to B.
"""

import itertools
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from bayesrace.cache import digest
from bayesrace.errors import InputError, fault_in_words, faults_in
from bayesrace.files import parse_toml, read_text, read_whole
from bayesrace.gp.weights import decode_weights
from bayesrace.tracks import builtin_tracks, is_random_track, load_track
from bayesrace.vehicles import CarParameters, get_car
from operation.settings import RaceSettings
from studies.campaign.case import (
    CONTROLLERS,
    LEARNS_FROM,
    PAPER,
    Case,
    Controller,
    Files,
    factors,
    named_file,
    nested,
)

__all__ = ["Campaign", "read_plan", "spread"]

_MOST_CASES: Final = 1_000_000
_SPAN: Final = re.compile(r"(.*?)(\d{1,9})\.\.(\d{1,9})")
_TRAINING: Final = ("train_track", "seed", "collect_s", "points", "kernels", "widen")


class _Draw(BaseModel):
    """A value between two, drawn evenly, or evenly in its logarithm; whole between whole ones."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    low: int | float
    high: int | float
    log: bool = False

    @model_validator(mode="after")
    def _ordered(self) -> "_Draw":
        if not self.low < self.high or (self.log and self.low <= 0):
            raise ValueError("low must be below high, and above 0 with log")
        return self

    def value(self, rng: np.random.Generator) -> int | float:
        if isinstance(self.low, int) and isinstance(self.high, int) and not self.log:
            return int(rng.integers(self.low, self.high, endpoint=True))
        scale, back = (math.log, math.exp) if self.log else (float, float)
        drawn = back(scale(self.low) + rng.random() * (scale(self.high) - scale(self.low)))
        return float(f"{drawn:.6g}")  # as it is printed


class _Plan(BaseModel):
    """The file's first lines and its tables."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    controllers: tuple[Controller, ...] = Field(
        PAPER, min_length=1, description=f"who drives: some of {', '.join(CONTROLLERS)}"
    )
    weights: Path | None = Field(
        None, description="weights to drive with, in place of those that each case learns"
    )
    draws: int = Field(1, ge=1, le=_MOST_CASES, description="values of [random] for each of [grid]")
    random_seed: int = Field(0, ge=0, description="of the values of [random]")
    grid: dict[str, Any] = Field({}, description="settings with lists of values")
    random: dict[str, Any] = Field({}, description="settings with lists or { low, high, log }")


@dataclass(frozen=True)
class Campaign:
    """What a plan comes to."""

    cases: dict[str, Case]
    """By their keys."""
    files: Files
    cars: tuple[CarParameters, ...]
    text: str
    """Of the plan's file."""


def read_plan(path: Path) -> Campaign:
    """The cases of a plan's file, in which paths are relative to its folder.

    Raises InputError naming file, field, value and remedy.
    """
    text = read_text(path, "the plan", "give a TOML file as docs/campaigns.md shows")
    content = parse_toml(text, path, "docs/campaigns.md has an example")
    try:
        plan = _Plan.model_validate(content)
    except ValidationError as error:
        raise InputError(f"{path}: {faults_in(error, 'the plan', _Plan)}") from None
    try:
        return _Reader(plan, path.parent).campaign(text)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:39]}…"


class _Reader:
    """Reads one plan; collects the files that it names."""

    def __init__(self, plan: _Plan, folder: Path) -> None:
        self._plan, self._folder = plan, folder
        self._files: Files = {}
        self._cars: dict[str, CarParameters] = {}

    def campaign(self, text: str) -> Campaign:
        plan = self._plan
        _check_controllers(plan)
        weights = "" if plan.weights is None else self._weights(plan.weights)
        grid = {
            name: self._values("grid", name, given)
            for name, given in _leaves("grid", plan.grid).items()
        }
        drawn = {
            name: self._drawn(name, given) for name, given in _leaves("random", plan.random).items()
        }
        if twice := sorted(grid.keys() & drawn.keys()):
            raise InputError(f"{twice[0]} is in [grid] and in [random]; leave it in one of them")
        if not drawn and plan.draws > 1:
            raise InputError(f"draws = {plan.draws}: there is nothing to draw; add [random]")
        _check_effect(plan, {**grid, **drawn})
        if not grid and not drawn:
            raise InputError(
                "the plan names no races: give tracks or other settings, such as track = 'harbour' "
                "in [grid] (docs/campaigns.md)"
            )
        count = math.prod(map(len, grid.values())) * plan.draws
        if count > _MOST_CASES:
            raise InputError(
                f"the plan has {count} cases, at most {_MOST_CASES} are possible: "
                "draw some values in [random] in place of all combinations in [grid]"
            )
        # In the order in which they learn from each other.
        controllers = tuple(one for one in CONTROLLERS if one in plan.controllers)
        cases = {}
        for values in self._points(grid, drawn):
            case = Case(_settings(values), controllers, weights)
            _check_runs(case)
            cases[case.key] = case
        cars = {case.settings.car.name: case.settings.car for case in cases.values()}
        return Campaign(cases, self._files, tuple(cars.values()), text)

    def _points(
        self,
        grid: Mapping[str, list[Any]],
        drawn: Mapping[str, Callable[[np.random.Generator], Any]],
    ) -> Iterator[dict[str, Any]]:
        """A draw depends on its point and its factor alone: what is added to a plan leaves it."""
        for values in itertools.product(*grid.values()):
            point = dict(zip(grid, values, strict=True))
            text = json.dumps(point, default=lambda car: car.model_dump_json(), sort_keys=True)
            for number in range(self._plan.draws):
                seeds = {name: int(digest([text, name]), 16) for name in drawn}
                yield point | {
                    name: draw(np.random.default_rng([self._plan.random_seed, number, seeds[name]]))
                    for name, draw in drawn.items()
                }

    # Values ------------------------------------------------------------------------------------

    def _values(self, table: str, name: str, given: Any) -> list[Any]:
        """The values of a factor, each checked."""
        values = given if isinstance(given, list) and not _is_one(name, given) else [given]
        every = [one for value in values for one in spread(value)]
        if not every:
            raise InputError(f"{table}.{name} = [] has no values; give some or leave it out")
        return [self._checked(table, name, value) for value in every]

    def _drawn(self, name: str, given: Any) -> Callable[[np.random.Generator], Any]:
        if isinstance(given, dict):
            try:
                draw = _Draw.model_validate(given)
            except ValidationError as error:
                raise InputError(
                    f"random.{name} = {_short(given)}: {faults_in(error, 'the values', _Draw)}; "
                    "write { low = NUMBER, high = NUMBER }, with log = true for even logarithms"
                ) from None
            for bound in (draw.low, draw.high):
                self._checked("random", name, bound)
            return draw.value
        values = self._values("random", name, given)
        return lambda rng: values[int(rng.integers(len(values)))]

    def _checked(self, table: str, name: str, value: Any) -> Any:
        """The value, with a file's content read; InputError naming it if it cannot be used."""
        place = f"{table}.{name}"
        try:
            if name == "car":
                return self._car(value)
            if name in ("track", "train_track"):
                value = self._track(value)
            RaceSettings.model_validate(nested({name: value}))
        except ValidationError as error:
            about = factors()[name].description
            fault = "; ".join(map(fault_in_words, error.errors()))
            raise InputError(f"{place} = {_short(value)}: {fault} ({about})") from None
        except InputError as error:
            raise InputError(f"{place}: {error}") from None
        return value

    def _car(self, name: Any) -> CarParameters:
        if not isinstance(name, str):
            raise InputError(f"{_short(name)} is no car; give a built-in name or a TOML file")
        car = get_car(str(self._folder / name) if name.endswith(".toml") else name)
        if self._cars.setdefault(car.name, car) != car:
            raise InputError(f"two cars have the name '{car.name}'; give one of them another name")
        return car

    def _track(self, name: Any) -> str:
        if not isinstance(name, str):
            raise InputError(
                f"{_short(name)} is no track; give a name, random:SEED, random10:SEED or a CSV file"
            )
        if name in builtin_tracks() or is_random_track(name):
            return name
        path = self._folder / name
        load_track(path if path.is_file() else name, 0.0)
        return self._file(path, "the track")

    def _weights(self, path: Path) -> str:
        name = self._file(self._folder / path, "the weights")
        try:
            decode_weights(self._files[name])
        except InputError as error:
            raise InputError(f"weights = '{path}': {error}") from None
        return name

    def _file(self, path: Path, what: str) -> str:
        data = read_whole(path, what)
        name = named_file(path, data)
        self._files[name] = data
        return name


def _check_controllers(plan: _Plan) -> None:
    learning = next((one for one in plan.controllers if one in LEARNS_FROM), None)
    if learning and plan.weights is not None:
        raise InputError(
            f"controllers: '{learning}' learns from a training drive, which there is none of "
            "with given weights; leave it or the weights out"
        )
    for one in plan.controllers:
        for other in LEARNS_FROM.get(one, ()):
            if other not in plan.controllers:
                raise InputError(
                    f"controllers: '{one}' learns from the laps of '{other}'; add that"
                )


def _check_runs(case: Case) -> None:
    if "bayesrace-limit" in case.controllers and not case.settings.progress_runs:
        raise InputError(
            "controllers: 'bayesrace-limit' has no runs: progress_drives is 0, as by default on "
            "linear tyres; set it, or leave the controller out"
        )


def _check_effect(plan: _Plan, names: Iterable[str]) -> None:
    """InputError for settings of the training where nothing is trained: they would do nothing."""
    if plan.weights is None:
        return
    idle = [name for name in names if name in _TRAINING or name.startswith("pursuit.")]
    if idle:
        raise InputError(
            f"{idle[0]} shapes what is learned, and with given weights nothing is: leave it or the "
            "weights out"
        )


def _leaves(table: str, given: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """What is given for each factor by its dotted name; InputError for names that are none."""
    known, leaves = factors(), {}
    for key, value in given.items():
        name = before + key
        if name in known:
            leaves[name] = value
        elif isinstance(value, dict) and any(one.startswith(f"{name}.") for one in known):
            leaves |= _leaves(table, value, f"{name}.")
        else:
            raise InputError(
                f"{table}.{name} = {_short(value)} is no setting that can vary; these can: "
                f"{', '.join(known)}"
            )
    return leaves


def _is_one(name: str, given: list[Any]) -> bool:
    """Whether the list is one value: kernels are a list themselves."""
    return name == "kernels" and all(isinstance(one, str) for one in given)


def spread(value: Any) -> list[Any]:
    """``TEXT A..B`` as TEXT with each number, or as numbers alone; all else as it is."""
    match = _SPAN.fullmatch(value) if isinstance(value, str) else None
    if match is None:
        return [value]
    text, first, last = match[1], int(match[2]), int(match[3])
    numbers = range(first, min(last, first + _MOST_CASES) + 1)
    return [f"{text}{number}" if text else number for number in numbers]


def _settings(values: Mapping[str, Any]) -> RaceSettings:
    try:
        return RaceSettings.model_validate(nested(values))
    except ValidationError as error:
        raise InputError(f"a case cannot be driven: {faults_in(error, 'its settings')}") from None
