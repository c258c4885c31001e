"""Racing lines by Bayesian optimisation: for the ideal lap, or for the lap that is driven."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

from bayesrace.arrays import Floats
from bayesrace.controller.assembly import compiled_controller
from bayesrace.errors import InputError
from bayesrace.learning.search import search
from bayesrace.operation.closed_loop import ClosedLoop, built_in_car
from bayesrace.operation.preparation import prepare
from bayesrace.operation.settings import BayesianSettings, PreparationSettings
from bayesrace.operation.terminal.terminal import Stages
from bayesrace.raceline import RaceLine, RaceLineSettings, racing_line
from bayesrace.raceline.friction import NodeLines, roughness
from bayesrace.raceline.line import line_identity
from bayesrace.tracks import Track, load_track
from bayesrace.vehicles import Car

__all__ = ["Lap", "SearchedLine", "driven_lap", "searched_line"]

_LIMIT: Final = 1.5
"""A drive ends at this multiple of the line's time ..."""
_START_S: Final = 2.0
"""... and so much more for the start."""

Lap = Callable[[RaceLine], float]
"""Lap time along a line [s]; infinite where there is none."""


class SearchedLine(NamedTuple):
    """The best line of a search."""

    line: RaceLine
    lap_s: float
    """Its objective."""
    direct_s: float
    """The same lap along the minimum-time line."""


def _ideal_lap(line: RaceLine) -> float:
    """Flying lap at the line's own speeds, the fastest that friction and drive allow on it."""
    return line.lap_time_s


def driven_lap(artefact: Path, weights: Path | None, track: Track, car: Car) -> Lap:
    """The flying lap that the controller drives in simulation along a line, after one lap from
    standstill; infinite where it does not finish in good time or leaves the track.

    Without ``weights`` by the uncorrected model. Raises InputError if artefact, weights and car do
    not fit together.
    """
    vehicle = built_in_car(car)

    def drive(line: RaceLine) -> float:
        controller = compiled_controller(artefact, car, track, line, weights)
        limit_s = _LIMIT * 2 * line.lap_time_s + _START_S
        driven = ClosedLoop(car, track, line, controller, vehicle).drive(2, limit_s)
        finished = len(driven.laps_s) == 2 and float(driven.off_track_m.max()) <= 0
        return driven.laps_s[1] if finished else math.inf

    return drive


def searched_line(
    name: str,
    car: Car,
    settings: BayesianSettings,
    stages: Stages,
    weights: Path | None = None,
) -> SearchedLine:
    """The best line of the track of this name or file.

    ``weights``: for the driven lap; trained without. Raises InputError if the margin leaves no
    room, or no random line keeps it.
    """
    track = load_track(name, car.width_m)
    direct = RaceLineSettings(friction=settings.friction, margin_m=settings.margin_m)
    lap: Lap = _ideal_lap
    if settings.objective == "driven":
        preparation = PreparationSettings(car=car, raceline=direct)
        car = preparation.driven_car
        made = prepare(preparation, (name,), stages, weights=weights)
        lap = driven_lap(made.artefacts[0], made.weights, track, car)
    direct_s = lap(racing_line(track, car, direct))
    lines, features = NodeLines(track, car, settings, settings.nodes), roughness(settings.nodes)

    def cost(shares: Floats) -> float:
        line = lines.line(shares)
        return math.inf if line is None else lap(line)

    with stages.stage(f"bayesian search, seed {settings.seed}") as stage:
        found = search(cost, features, settings.evaluations, settings.seed, stage.update)
    line, lap_s = lines.line(found.point), float(found.y.min())
    if line is None or not math.isfinite(lap_s):
        raise InputError(
            f"no line through {settings.nodes} nodes on track '{track.name}' was driven or keeps "
            "the margin: choose more --nodes, another --seed or a smaller --margin"
        )
    made_for = line_identity(track, car, settings)
    return SearchedLine(replace(line, made_for=made_for), lap_s, direct_s)
