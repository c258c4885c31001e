"""The limit on meshes with twice the intervals each, until the lap changes by less than 0.1 %."""

import time
from typing import Any, Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.limit.gates import Gates, flying_gates, standing_gates
from bayesrace.limit.guess import Guess
from bayesrace.limit.lap import LimitLap
from bayesrace.limit.ocp import Lap, optimise
from bayesrace.limit.outline import Outline
from bayesrace.limit.settings import LimitSettings
from bayesrace.raceline import RaceLine
from bayesrace.raceline.cached import racing_line
from bayesrace.raceline.frame import smooth_centreline
from bayesrace.tracks import Track
from bayesrace.vehicles.models import Model, dynamic
from bayesrace.vehicles.parameters import CarParameters
from bayesrace.vehicles.parts import GRAVITY_MPS2

__all__ = ["solve"]

_INTERVAL: Final = 2.0
"""Length of an interval of the first mesh, over one of the racing line's."""

_SPEEDS: Final = (1.0, 0.7, 0.5)
"""Shares of the racing line's speeds to begin with: where the car turns about in a hairpin there
are several optima, up to 0.3 % apart."""

_SAME: Final = 1e-4
"""Share by which laps of the same optimum differ."""

_UNCHANGED: Final = 1e-3
"""Share by which the lap may change with the mesh."""

_FINEST: Final = 8
"""Times as fine as the first."""

_ROUNDS: Final = 10
_TOUCHING: Final = 0.002
"""Over the car's width, by which its outline may pass the margin."""

_WARM: Final = {"mu_init": 1e-3, "bound_push": 1e-4, "bound_frac": 1e-4}
"""IPOPT's, for a guess that is nearly the solution."""


class _NoLapError(InputError):
    """No lap was found from this guess."""


class _Limit:
    """The optimisation of one lap, on any mesh."""

    def __init__(self, track: Track, model: Model, settings: LimitSettings, line: RaceLine) -> None:
        car = model.car
        self._track, self._model, self._settings = track, model, settings
        self._tuning = car.tuning.raceline
        self._start_mps = settings.start_speed_mps if settings.standing else None
        self._curve = smooth_centreline(track, self._tuning)
        self._guess = Guess(line, self._curve, car, self._start_mps)
        # The outline reaches at least half the car's width beyond the centre of gravity.
        self._margin_m = settings.margin_m + (car.width_m / 2 if settings.body else 0.0)
        self._outline = Outline(track, car, settings.margin_m) if settings.body else None
        self._interval_m = _INTERVAL * self._tuning.step_m
        usable = car.friction * GRAVITY_MPS2
        self._interval_s = self._interval_m / (2 * float(np.sqrt(usable * car.wheelbase_m)))

    def gates(self, refined: int) -> Gates:
        """The mesh with ``refined`` times as many intervals as the first."""
        places = self._guess.mesh(self._interval_m, self._interval_s, refined)
        make = standing_gates if self._settings.standing else flying_gates
        return make(self._track, self._curve, places, self._tuning, self._margin_m)

    def first(self, gates: Gates) -> Lap:
        """The best of laps from the racing line at several speeds, until two are the same."""
        laps: list[Lap] = []
        for share in _SPEEDS:
            try:
                lap = self._fastest(gates, self._guess.lap(gates, share), {})
            except _NoLapError as error:
                if share == _SPEEDS[-1] and not laps:
                    raise InputError(str(error)) from None
                continue
            laps.append(lap)
            if any(abs(one.time_s / lap.time_s - 1) < _SAME for one in laps[:-1]):
                break
        return min(laps, key=lambda lap: lap.time_s)

    def refined(self, coarse: Gates, lap: Lap, gates: Gates) -> Lap:
        """The fastest lap from that on another mesh."""
        passed = np.concatenate([[0.0], np.cumsum(lap.durations_s)])
        aside = lap.states.copy()
        aside[:, 1] -= coarse.heading_rad
        states = _between(gates.place_m, coarse.place_m, aside)
        states[:, 1] += gates.heading_rad
        durations = np.diff(np.interp(gates.place_m, coarse.place_m, passed))
        return self._fastest(gates, Lap(states, durations), _WARM)

    def _fastest(self, gates: Gates, guess: Lap, options: dict[str, Any]) -> Lap:
        """The fastest lap; with an outline, repeated until this keeps the margin."""
        lap, most_m = guess, _TOUCHING * self._model.car.width_m
        for _ in range(_ROUNDS):
            lap = self._optimised(gates, lap, options)
            at = gates.points(lap.states[:, 0]), lap.states[:, 1]
            if self._outline is None or self._outline.beyond_m(*at) <= most_m:
                return lap
            options = _WARM
        raise _NoLapError(
            f"no limit for track '{self._track.name}': the outline still passes the margin after "
            f"{_ROUNDS} rounds; try another --margin"
        )

    def _optimised(self, gates: Gates, guess: Lap, options: dict[str, Any]) -> Lap:
        lap, solution = optimise(
            self._model,
            gates,
            guess,
            interval_s=self._interval_s,
            start_mps=self._start_mps,
            lateral_mps=self._settings.lateral_speed_mps,
            outline=self._outline,
            options={"max_iter": self._settings.max_iterations, **options},
        )
        if not solution.converged:
            raise _NoLapError(
                f"no limit for track '{self._track.name}': IPOPT ended with {solution.status} "
                f"after {solution.iterations} iterations; try a smaller --margin, or without --body"
            )
        return lap


def _between(place: Floats, places: Floats, values: Floats) -> Floats:
    """Columns of values (n, m) at ``places`` (n,), interpolated linearly: (len(place), m)."""
    return np.column_stack([np.interp(place, places, column) for column in values.T])


def solve(track: Track, car: CarParameters, settings: LimitSettings) -> LimitLap:
    """The limit of ``car`` on ``track``: the dynamic model, on meshes fine enough.

    Raises InputError if the margin leaves no room, or no lap is found.
    """
    begin = time.monotonic()
    limit = _Limit(track, dynamic(car), settings, racing_line(track, car))
    refined = 1
    gates = limit.gates(refined)
    lap = limit.first(gates)
    while refined < _FINEST:
        refined *= 2
        finer = limit.gates(refined)
        before_s, lap = lap.time_s, limit.refined(gates, lap, finer)
        gates = finer
        change = abs(lap.time_s / before_s - 1)
        if change < _UNCHANGED:
            break
    else:
        raise InputError(
            f"no limit for track '{track.name}': with half the intervals the lap changes by "
            f"{100 * change:.2g} %; choose a smaller step_m in the car's [tuning.raceline]"
        )
    positions = gates.points(lap.states[:, 0])
    return LimitLap(
        car=car.identity,
        track=track.identity,
        lap_s=lap.time_s,
        intervals=gates.intervals,
        mesh_change=change,
        solve_s=time.monotonic() - begin,
        t_s=np.concatenate([[0.0], np.cumsum(lap.durations_s)]),
        x=np.column_stack([positions, lap.states[:, 1:6]]),
        u=lap.states[:, 6:],
    )
