"""The limit on meshes with twice the intervals each, until the lap changes by less than 0.1 %."""

import time
from typing import Any, Final

import numpy as np

from bayesrace.errors import InputError
from bayesrace.limit.guess import Guess
from bayesrace.limit.lap import LimitLap, LimitSettings
from bayesrace.limit.ocp import Lap, optimise
from bayesrace.limit.outline import Outline
from bayesrace.raceline import racing_line
from bayesrace.raceline.gates import Gates, flying_gates, smooth_centreline, standing_gates
from bayesrace.tracks import Track
from bayesrace.vehicles.models import dynamic
from bayesrace.vehicles.parameters import CarParameters

__all__ = ["solve"]

_FOLD: Final = 0.98
"""Largest offset of a gate over the centreline's radius; at 1 neighbouring gates meet."""

_SPEEDS: Final = (1.0, 0.7, 0.5)
"""Shares of the racing line's speeds to begin with: where the car turns about in a hairpin there
are several optima, up to 0.3 % apart."""

_SAME: Final = 1e-4
"""Share by which laps of the same optimum differ."""

_UNCHANGED: Final = 1e-3
"""Share by which the lap may change with the mesh."""

_FINER: Final = 2, 4, 8
"""Times as fine as the first."""

_ROUNDS: Final = 10
_TOUCHING: Final = 0.002
"""Over the car's width, by which its outline may pass the margin."""

_WARM: Final = {"mu_init": 1e-3, "bound_push": 1e-4, "bound_frac": 1e-4}
"""IPOPT's, for a guess that is nearly the solution."""


class _NoLapError(InputError):
    """No lap was found from this guess."""


class _Limit:
    """The optimisation of one lap, on any mesh: the dynamic model on a track."""

    def __init__(self, track: Track, car: CarParameters, settings: LimitSettings) -> None:
        self._track, self._car, self._settings = track, car, settings
        self._curve = smooth_centreline(track, car.tuning.raceline)
        self._guess = Guess(racing_line(track, car), self._curve, car, settings)
        self._outline = Outline(track, car, settings.margin_m) if settings.body else None

    def gates(self, refined: int) -> Gates:
        """The mesh with ``refined`` times as many intervals as the first."""
        tuning = self._car.tuning.raceline
        # The outline reaches at least half the car's width beyond the centre of gravity.
        margin_m = self._settings.margin_m + (self._car.width_m / 2 if self._settings.body else 0.0)
        places = self._guess.mesh(refined)
        gates = flying_gates(self._track, self._curve, places, tuning, margin_m, _FOLD)
        if self._settings.standing:
            return standing_gates(self._track, gates, tuning, margin_m)
        return gates

    def first(self) -> Lap:
        """The best of laps from the racing line at several speeds, until two are the same."""
        gates, laps, reason = self.gates(1), list[Lap](), ""
        for share in _SPEEDS:
            try:
                lap = self.fastest(self._guess.lap(gates, share), {})
            except _NoLapError as error:
                reason = str(error)
                continue
            laps.append(lap)
            if any(abs(one.time_s / lap.time_s - 1) < _SAME for one in laps[:-1]):
                break
        if not laps:
            raise InputError(reason)
        return min(laps, key=lambda lap: lap.time_s)

    def fastest(self, lap: Lap, options: dict[str, Any]) -> Lap:
        """The fastest lap; with an outline, repeated until this keeps the margin."""
        failed = f"no limit for track '{self._track.name}':"
        for _ in range(_ROUNDS):
            lap, solution = optimise(
                dynamic(self._car), lap, self._settings, self._outline, options
            )
            if not solution.converged:
                remedy = "try a smaller --margin, or without --body"
                raise _NoLapError(f"{failed} {solution.how}; {remedy}")
            if self._outline is None:
                return lap
            beyond_m = self._outline.beyond_m(lap.xy_m, lap.states[:, 1])
            if beyond_m <= _TOUCHING * self._car.width_m:
                return lap
            options = _WARM
        raise _NoLapError(
            f"{failed} the outline still passes the margin after {_ROUNDS} rounds; try another "
            "--margin"
        )


def solve(track: Track, car: CarParameters, settings: LimitSettings) -> LimitLap:
    """The limit of ``car`` on ``track``: the dynamic model, on meshes fine enough.

    Raises InputError if the margin leaves no room, or no lap is found.
    """
    begin = time.monotonic()
    limit = _Limit(track, car, settings)
    lap = limit.first()
    for refined in _FINER:
        before_s, lap = lap.time_s, limit.fastest(lap.through(limit.gates(refined)), _WARM)
        change = abs(lap.time_s / before_s - 1)
        if change < _UNCHANGED:
            break
    else:
        raise InputError(
            f"no limit for track '{track.name}': with half the intervals the lap changes by "
            f"{100 * change:.2g} %; choose a smaller step_m in the car's [tuning.raceline]"
        )
    return LimitLap(
        car=car.identity,
        track=track.identity,
        lap_s=lap.time_s,
        intervals=lap.gates.intervals,
        mesh_change=change,
        solve_s=time.monotonic() - begin,
        t_s=lap.times_s,
        x=np.column_stack([lap.xy_m, lap.states[:, 1:6]]),
        u=lap.states[:, 6:],
    )
