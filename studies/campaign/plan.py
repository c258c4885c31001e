"""The plan of a campaign: a TOML file that says what varies, as docs/campaigns.md shows it.

Every setting of :class:`~bayesrace.operation.settings.RaceSettings` may stand in [grid], whose
values are combined, or in [random], whose values are drawn for each combination, but for a few that
a campaign fixes. A text that ends in ``A..B`` stands for the whole numbers from A to B.
"""

import itertools
import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import Field, ValidationError, model_validator

from bayesrace.cache import digest
from bayesrace.errors import InputError, faults_in
from bayesrace.files import parse_toml, read_text
from bayesrace.gp.weights import decode_weights
from bayesrace.operation.settings import RaceSettings
from bayesrace.plant.world import NONE, get_world
from bayesrace.sensors import get_sensors
from bayesrace.strict import StrictModel
from bayesrace.studies.campaign.case import (
    CONTROLLERS,
    LEARNS_FROM,
    PAPER,
    Case,
    Controller,
    Files,
    factors,
)
from bayesrace.studies.settings import spread
from bayesrace.tracks import builtin_tracks, is_random_track, load_track
from bayesrace.vehicles import Car, get_car

__all__ = ["Campaign", "read_plan"]

_MOST_CASES: Final = 1_000_000
_TRAINING: Final = (
    "train_track", "seed", "collect_s", "practice_laps", "practice_until", "points", "kernels",
    "widen", "pursuit",
)  # fmt: skip


_Drawn = Callable[[np.random.Generator], Any]  # a value by random numbers


class _Draw(StrictModel):
    """A value between two, drawn evenly, or evenly in its logarithm; whole between whole ones."""

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


class _Plan(StrictModel):
    """The file's first lines and its tables."""

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
    """What a plan comes to: its cases by their keys, and the text of its file."""

    cases: dict[str, Case]
    files: Files
    cars: tuple[Car, ...]
    text: str


def read_plan(path: Path) -> Campaign:
    """The cases of a plan's file, in which paths are relative to its folder.

    Raises InputError naming file, field, value and remedy.
    """
    text = read_text(path, "the plan", "give a TOML file as docs/campaigns.md shows")
    content = parse_toml(text, path, "docs/campaigns.md has an example")
    try:
        return _Reader(_Plan.model_validate(content), path.parent).campaign(text)
    except ValidationError as error:  # of the plan, or of the settings of a case
        raise InputError(f"{path}: {faults_in(error, 'the plan', _Plan)}") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


class _Reader:
    """Reads one plan; collects the files that it names."""

    def __init__(self, plan: _Plan, folder: Path) -> None:
        self._plan, self._folder = plan, folder
        self._files = Files()
        self._cars: dict[str, Car] = {}

    def campaign(self, text: str) -> Campaign:
        plan = self._plan
        weights = "" if plan.weights is None else self._weights(plan.weights)
        grid = {n: self._values("grid", n, v) for n, v in _leaves("grid", plan.grid).items()}
        drawn = {n: self._drawn(n, v) for n, v in _leaves("random", plan.random).items()}
        count = math.prod(map(len, grid.values())) * plan.draws
        for fault in _faults(plan, list(grid), list(drawn), count):
            raise InputError(fault)
        # In the order in which they learn from each other.
        controllers, cases = tuple(one for one in CONTROLLERS if one in plan.controllers), {}
        for values in self._points(grid, drawn):
            settings = RaceSettings.model_validate(_nested(values))
            if "bayesrace-limit" in controllers and not settings.progress_runs:
                raise InputError(
                    "controllers: 'bayesrace-limit' has no runs: progress_drives is 0, as by "
                    "default on linear tyres; set it, or leave the controller out"
                )
            case = Case(settings, controllers, weights)
            cases[case.key] = case
        cars = {case.settings.car.name: case.settings.car for case in cases.values()}
        return Campaign(cases, self._files, tuple(cars.values()), text)

    def _points(self, grid: dict[str, list[Any]], drawn: dict[str, _Drawn]) -> Iterator[Any]:
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

    def _values(self, table: str, name: str, given: Any) -> list[Any]:
        """The values of a factor, each checked."""
        single = name == "kernels" and all(isinstance(one, str) for one in given)  # a list itself
        values = given if isinstance(given, list) and not single else [given]
        every = [self._checked(table, name, one) for value in values for one in spread(value)]
        if not every:
            raise InputError(f"{table}.{name} = [] has no values; give some or leave it out")
        return every

    def _drawn(self, name: str, given: Any) -> _Drawn:
        if not isinstance(given, dict):
            values = self._values("random", name, given)
            return lambda rng: values[int(rng.integers(len(values)))]
        try:
            draw = _Draw.model_validate(given)
        except ValidationError as error:
            fault = faults_in(error, "the values", _Draw)
            form = "{ low = NUMBER, high = NUMBER }, with log = true for even logarithms"
            raise InputError(f"random.{name}: {fault}; write {form}") from None
        for bound in (draw.low, draw.high):
            self._checked("random", name, bound)
        return draw.value

    def _checked(self, table: str, name: str, value: Any) -> Any:
        """The value, with a file's content read; InputError naming it if it cannot be used."""
        try:
            if name == "car" and isinstance(value, str):
                return self._car(value)
            if name == "sensors" and isinstance(value, str):
                return get_sensors(self._folder / value if value.endswith(".toml") else value)
            if name == "world" and isinstance(value, str):
                return get_world(value if value == NONE else self._folder / value)
            if name in ("track", "train_track") and isinstance(value, str):
                value = self._track(value)
            RaceSettings.model_validate(_nested({name: value}))
        except ValidationError as error:
            raise InputError(f"{table}.{faults_in(error, name, RaceSettings)}") from None
        except InputError as error:
            raise InputError(f"{table}.{name}: {error}") from None
        return value

    def _car(self, name: str) -> Car:
        car = get_car(str(self._folder / name) if name.endswith(".toml") else name)
        if self._cars.setdefault(car.name, car) != car:
            raise InputError(f"two cars have the name '{car.name}'; give one of them another name")
        return car

    def _track(self, name: str) -> str:
        if name in builtin_tracks() or is_random_track(name):
            return name
        path = self._folder / name
        load_track(path if path.is_file() else name, 0.0)
        return self._files.add(path, "the track")

    def _weights(self, path: Path) -> str:
        name = self._files.add(self._folder / path, "the weights")
        try:
            decode_weights(self._files[name])
        except InputError as error:
            raise InputError(f"weights = '{path}': {error}") from None
        return name


def _faults(plan: _Plan, grid: list[str], drawn: list[str], count: int) -> Iterator[str]:
    """What is wrong with the plan as a whole: names of its settings, and its number of cases."""
    for one in (one for one in plan.controllers if one in LEARNS_FROM):
        missing = [other for other in LEARNS_FROM[one] if other not in plan.controllers]
        if plan.weights is not None:
            yield f"controllers: '{one}' trains anew; leave it or the weights out"
        elif missing:
            yield f"controllers: '{one}' learns from the laps of '{missing[0]}'; add that"
    for name in {*grid} & {*drawn}:
        yield f"{name} is in [grid] and in [random]; leave it in one"
    if not drawn and plan.draws > 1:
        yield f"draws = {plan.draws}: there is nothing to draw; add [random]"
    for name in (*grid, *drawn):
        if plan.weights is not None and name.split(".")[0] in _TRAINING:
            yield f"{name} shapes what is learned; leave it or the weights out"
    if not grid and not drawn:
        yield "the plan names no races; give tracks in [grid] (docs/campaigns.md)"
    if count > _MOST_CASES:
        yield f"{count} cases, at most {_MOST_CASES} are possible; draw some in [random]"


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
            fault = f"{table}.{name} = {value!r:.40} is no setting that can vary"
            raise InputError(f"{fault}; these can: {', '.join(known)}")
    return leaves


def _nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values by dotted names as the nested data that settings are made of."""
    result: dict[str, Any] = {}
    for name, value in values.items():
        *path, last = name.split(".")
        place = result
        for part in path:
            place = place.setdefault(part, {})
        place[last] = value
    return result
