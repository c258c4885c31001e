"""A learned car at racing speed on a built-in track: what is driven when something fails."""

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from bayesrace.arrays import Floats
from bayesrace.controller.assembly import PredictiveController, compiled_controller
from bayesrace.gp.weights import Weights, read_weights
from bayesrace.operation.closed_loop import ClosedLoop, Driven
from bayesrace.operation.preparation import Prepared, prepare
from bayesrace.operation.settings import PreparationSettings
from bayesrace.operation.terminal.terminal import stages_on
from bayesrace.raceline import RaceLine
from bayesrace.tracks import Track
from bayesrace.vehicles import Car, get_car

__all__ = ["Racing", "prepared", "racing"]


@dataclass(frozen=True, eq=False)
class Racing:
    """The car, its track, what it has learned on another one, and a lap with that."""

    car: Car
    track: Track
    line: RaceLine
    artefact: Path
    weights: Weights
    driven: Driven

    def controller(self) -> PredictiveController:
        """As a race has it."""
        return compiled_controller(self.artefact, self.car, self.track, self.line, self.weights)

    def moments(self, count: int) -> list[Any]:
        """States (7,) of the flying lap, evenly spread over it."""
        before, after = self.driven.laps.after[:2]
        return [self.driven.x[before + (after - before) * i // count] for i in range(count)]

    def off_track_m(self, x: Floats) -> float:
        """How far outside of the track the path x (n, 7) gets; negative inside."""
        return float(self.track.project_path(x[:, :2]).off_track_m.max())


@functools.cache
def prepared(track: str = "harbour", train_track: str = "") -> Prepared:
    """Line, weights and controller, from the cache if they are there."""
    with stages_on(Console(quiet=True)) as stages:
        return prepare(PreparationSettings(train_track=train_track), (track,), stages)


@functools.cache
def racing(track: str = "harbour", train_track: str = "") -> Racing:
    """With a lap that has been driven."""
    files = prepared(track, train_track)
    car, one, weights = get_car("orca"), files.first, read_weights(files.weights)
    controller = compiled_controller(files.artefacts[0], car, one.track, one.line, weights)
    driven = ClosedLoop(car, one.track, one.line, controller).drive(2)
    return Racing(car, one.track, one.line, files.artefacts[0], weights, driven)
