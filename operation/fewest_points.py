"""The fewest training points of which a controller loses no time against many.

Fewer points predict worse, and know less where little was driven, which slows the car down. What
both cost is seen in laps, not in errors of one step. The car that drives these laps is learned,
too: the nominal model, corrected by the weights of the most points. No true model takes part, so
the drives may be a real car's.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.codegen.build import build, checking_artefact
from bayesrace.codegen.settings import BuildSettings
from bayesrace.controller.assembly import compiled_controller
from bayesrace.defaults import POINTS
from bayesrace.errors import InputError
from bayesrace.gp.expression import corrected_function
from bayesrace.gp.weights import Weights
from bayesrace.integrators import Discretisation
from bayesrace.learning.sources import Samples, log_facts
from bayesrace.learning.training import Training
from bayesrace.learning.validation import NOMINAL
from bayesrace.operation.closed_loop import ClosedLoop
from bayesrace.operation.terminal.terminal import Stages
from bayesrace.plant.vehicle import Command, FmuFault, Vehicle
from bayesrace.raceline import racing_line
from bayesrace.tracks import Track, load_track
from bayesrace.vehicles import Car

__all__ = ["Attempt", "LearnedCar", "driven_tracks", "fewest_points"]

_MOST_LOST: Final = 0.001
"""Of a lap, what fewer points than the most may cost."""
_LAPS: Final = 6
"""Of a run; all count but the first one, from standstill."""


class LearnedCar(Vehicle):
    """The car as weights describe it: the corrected model, one step a sampling period."""

    def __init__(self, car: Car, discretisation: Discretisation, weights: Weights) -> None:
        super().__init__(car, discretisation.step_s, 1)
        self._corrected = corrected_function(NOMINAL(car), discretisation, weights)

    def _place(self, start: Floats) -> None:
        self.x[:] = start

    def _hold(self, u: Command, count: int) -> tuple[float, float]:
        applied = self.guard.apply(u, self.x, self.step_s)
        x = np.asarray(self._corrected(self.x, applied), dtype=np.float64).ravel()
        if not np.isfinite(x).all():
            raise FmuFault(f"the learned car has no finite state after {self.time_s:.2f} s")
        x[6] = self.guard.angle_after(float(self.x[6]), applied[1], self.step_s)
        self.x[:] = x
        return applied


class Attempt(NamedTuple):
    """A training, and what was driven with its weights."""

    training: Training
    laps_s: Floats
    """Flying laps, (tracks, laps); NaN: not finished."""
    off_track: int
    """Samples off the track."""

    def lost(self, most: "Attempt") -> tuple[float, float]:
        """Share of a lap that it loses against ``most``, and two standard errors of that share, on
        the track where their sum is largest; NaN where laps were not finished."""
        most_s, variance = most.laps_s.mean(1), self.laps_s.var(1, ddof=1)
        variance += most.laps_s.var(1, ddof=1)
        lost = self.laps_s.mean(1) / most_s - 1
        error = 2 * np.sqrt(variance / self.laps_s.shape[1]) / most_s
        worst = int(np.argmax(lost + error))  # a NaN is the largest
        return float(lost[worst]), float(error[worst])

    def enough(self, most: "Attempt") -> bool:
        """Whether it is shown to lose less than a thousandth, and is off track no more often."""
        return sum(self.lost(most)) <= _MOST_LOST and self.off_track <= most.off_track


def driven_tracks(samples: Samples, logs: Sequence[Path], named: Sequence[str]) -> list[Track]:
    """The tracks ``named``, or those that the logs were driven on.

    InputError if a log names none that is known here, or one beside which the car was.
    """
    width_m, xy = samples.dataset.car.width_m, samples.dataset.x[:, :2]
    if named:
        return [load_track(name, width_m) for name in dict.fromkeys(named)]
    with suppress(InputError):
        names = dict.fromkeys(log_facts(path).track for path in logs)
        tracks = [load_track(name, width_m) for name in names]
        off_track_m = [track.project_points(xy).off_track_m for track in tracks]
        if np.mean(np.min(off_track_m, axis=0) <= 0) > 0.5:
            return tracks
    raise InputError(
        "--points auto: the drives do not say on which track that is known here they were driven; "
        "name the track that the weights are for with --track"
    )


def fewest_points(
    samples: Samples,
    tracks: Sequence[Track],
    artefact: Path | None,
    train: Callable[[int], Training],
    stages: Stages,
) -> tuple[list[Attempt], Attempt]:
    """Attempts with fewer and fewer points, until one is not enough; and the last that is.

    ``artefact``: a controller that the weights of ``train`` fit; the default one without.
    InputError if the car does not finish its laps with the most points.
    """
    car, model, attempts = samples.dataset.car, samples.discretisation, list[Attempt]()
    if artefact is None:
        with stages.stage("build the controller"):
            artefact, _ = build(BuildSettings(car=car, discretisation=model))
    artefact = checking_artefact(artefact, car)
    for points in POINTS:
        training, laps_s, off = train(points), np.full((len(tracks), _LAPS - 1), np.nan), 0
        if not attempts:
            vehicle = LearnedCar(car, model, training.weights)
        for track, times_s in zip(tracks, laps_s, strict=True):
            line = racing_line(track, car)
            controller = compiled_controller(artefact, car, track, line, training.weights)
            with stages.stage(f"drive {track.name}, {points} points"):
                driven = ClosedLoop(car, track, line, controller, vehicle).drive(_LAPS)
            times_s[: len(driven.laps_s[1:])] = driven.laps_s[1:]
            off += int((driven.off_track_m > 0).sum())
            if not attempts and np.isnan(times_s).any():
                raise InputError(
                    f"--points auto: what is learned does not drive {_LAPS} laps of {track.name} "
                    f"({driven.end.text}): drive more there, or name another track with --track"
                )
        attempts.append(Attempt(training, laps_s, off))
        if points < POINTS[0] and not attempts[-1].enough(attempts[0]):
            return attempts, attempts[-2]
    return attempts, attempts[-1]
