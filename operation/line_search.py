"""Racing lines by Bayesian optimisation: for the ideal lap, or for the lap that is driven."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.files import write_whole
from bayesrace.gp.weights import read_weights
from bayesrace.raceline import RaceLine, RaceLineSettings, racing_line
from bayesrace.raceline.line import line_identity
from bayesrace.raceline.nodes import NodeLines, roughness
from bayesrace.tracks import Track, load_track
from bayesrace.vehicles import CarParameters
from controller.assembly import compiled_controller
from learning.search import Search, search
from operation.closed_loop import ClosedLoop, built_in_car
from operation.preparation import prepare
from operation.settings import BayesianSettings, PreparationSettings
from operation.terminal.progress import Stages

__all__ = [
    "Comparison",
    "Lap",
    "compare_lines",
    "driven_lap",
    "ideal_lap",
    "write_curve",
]

_LIMIT: Final = 1.5
"""A drive ends at this multiple of the line's time ..."""
_START_S: Final = 2.0
"""... and so much more for the start."""

Lap = Callable[[RaceLine], float]
"""Lap time along a line [s]; infinite where there is none."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """The searches of some seeds, and as many random ones."""

    line: RaceLine
    """The best line of all."""
    lap_s: float
    """Its objective."""
    bayesian: tuple[Search, ...]
    random: tuple[Search, ...]
    """Empty unless asked for."""
    direct_s: float
    """The same lap along the minimum-time line."""


def ideal_lap(line: RaceLine) -> float:
    """Flying lap at the line's own speeds, the fastest that friction and drive allow on it."""
    return line.lap_time_s


def driven_lap(artefact: Path, weights: Path | None, track: Track, car: CarParameters) -> Lap:
    """The flying lap that the controller drives in simulation along a line, after one lap from
    standstill; infinite where it does not finish in good time or leaves the track.

    Without ``weights`` by the uncorrected model. Raises InputError if artefact, weights and car do
    not fit together.
    """
    learned = None if weights is None else read_weights(weights)
    vehicle = built_in_car(car)

    def drive(line: RaceLine) -> float:
        controller = compiled_controller(artefact, car, track, line, learned)
        limit_s = _LIMIT * 2 * line.lap_time_s + _START_S
        driven = ClosedLoop(car, track, line, controller, vehicle).drive(2, limit_s)
        finished = len(driven.laps_s) == 2 and float(driven.off_track_m.max()) <= 0
        return driven.laps_s[1] if finished else math.inf

    return drive


def compare_lines(
    name: str,
    car: CarParameters,
    settings: BayesianSettings,
    stages: Stages,
    weights: Path | None = None,
    compare: bool = False,
) -> Comparison:
    """The best line of the track of this name or file, by searches from one seed after the other.

    ``weights``: for the driven lap; trained without. ``compare``: random search from the same
    seeds as well. Raises InputError if the margin leaves no room, or no random line keeps it.
    """
    lap: Lap = ideal_lap
    track = load_track(name, car.width_m)
    direct = RaceLineSettings(friction=settings.friction, margin_m=settings.margin_m)
    if settings.objective == "driven":
        preparation = PreparationSettings(car=car, raceline=direct)
        car = preparation.driven_car
        made = prepare(preparation, (name,), stages, weights=weights)
        lap = driven_lap(made.artefacts[0], made.weights, track, car)
    direct_s = lap(racing_line(track, car, direct))
    lines = NodeLines(track, car, settings, settings.nodes)
    features = roughness(settings.nodes)

    def cost(shares: Floats) -> float:
        line = lines.line(shares)
        return math.inf if line is None else lap(line)

    found: dict[str, list[Search]] = {"bayesian": [], "random": []}
    at_random = {"initial": settings.search.evaluations, "patience": None}
    first = settings.search.seed
    for seed in range(first, first + settings.trials):
        for method, how in (("bayesian", {}), ("random", at_random))[: 1 + compare]:
            own = settings.search.model_copy(update={**how, "seed": seed})
            with stages.stage(f"{method} search, seed {seed}") as stage:
                found[method].append(
                    search(cost, settings.nodes, own, features, progress=stage.update)
                )
    best = min(found["bayesian"], key=lambda one: float(one.y.min()))
    line = lines.line(best.point)
    if line is None or not math.isfinite(best.y.min()):
        raise InputError(
            f"no line through {settings.nodes} nodes on track '{track.name}' was driven or keeps "
            "the margin: choose more --nodes, another --seed or a smaller --margin"
        )
    best_line = replace(line, made_for=line_identity(track, car, settings))
    searches = tuple(found["bayesian"]), tuple(found["random"])
    return Comparison(best_line, float(best.y.min()), *searches, direct_s)


def write_curve(path: Path, comparison: Comparison) -> None:
    """Best lap against evaluations as a CSV, a column for each search."""
    curves = {f"bayesian_{k}": one.best for k, one in enumerate(comparison.bayesian)}
    curves |= {f"random_{k}": one.best for k, one in enumerate(comparison.random)}
    longest = max(map(len, curves.values()))  # a search that stopped early keeps its best value
    table = np.stack([np.pad(one, (0, longest - len(one)), "edge") for one in curves.values()])
    rows = [",".join(["evaluation", *curves])]
    rows += [",".join([str(k + 1), *map(repr, row)]) for k, row in enumerate(table.T.tolist())]
    write_whole(path, "\n".join(rows) + "\n")
