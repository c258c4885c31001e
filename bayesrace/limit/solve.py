"""The limit from the racing line on, on meshes with twice the intervals each, until the lap changes
by less than 0.1 %."""

import time
from typing import Any, Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.limit.lap import LimitLap, LimitSettings
from bayesrace.limit.ocp import Lap, Outline, optimise, usual_interval
from bayesrace.raceline import RaceLine, racing_line
from bayesrace.raceline.gates import Gates, flying_gates, smooth_centreline, standing_gates
from bayesrace.tracks import Track
from bayesrace.tracks.spline import CentrelineSearch, PlaneSpline
from bayesrace.vehicles.models import dynamic
from bayesrace.vehicles.parameters import Car
from bayesrace.vehicles.parts import GRAVITY_MPS2

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


_EASE: Final = 20.0
"""Wheelbases after which a standing lap is on the racing line."""

_LAUNCH: Final = 0.5
"""Of the grip, with which a standing lap begins."""

_OVERSAMPLING: Final = 8

_SLOWEST: Final = 0.01
"""Over the top speed: a lap may begin at rest."""


class _Guess:
    """A racing line as a function of the place on the smoothed centreline."""

    def __init__(
        self, line: RaceLine, curve: PlaneSpline, car: Car, settings: LimitSettings
    ) -> None:
        self._curve, self._car, self._settings = curve, car, settings
        spacing = line.length_m / len(line.s_m)
        reach = curve.period / 10
        self._place = CentrelineSearch(curve, spacing).follow(line.xy_m, None, reach)
        foot, slope = curve(self._place), curve(self._place, 1)
        away, along = line.xy_m - foot, np.arctan2(slope[:, 1], slope[:, 0])
        self._n = away[:, 1] * np.cos(along) - away[:, 0] * np.sin(along)
        self._xi = np.angle(np.exp(1j * (line.psi_rad - along)))
        self._v, self._kappa = line.vx_mps, line.kappa_radpm

    def _at(self, values: Floats, places: Floats) -> Floats:
        """Of the racing line's points, at places (N,)."""
        return np.asarray(np.interp(places, self._place, values, period=self._curve.period))

    def speed(self, places: Floats) -> Floats:
        """Speeds (N,) [m/s]."""
        v = self._at(self._v, places)
        if not self._settings.standing:
            return v
        launch = _LAUNCH * self._car.friction * GRAVITY_MPS2
        return np.minimum(v, np.sqrt(self._settings.start_speed_mps**2 + 2 * launch * places))

    def mesh(self, refined: int) -> Floats:
        """Ascending places (M + 1,) from 0 to the period.

        Neighbours are at most as far apart as is usual, in way and in time at the guess's speeds,
        over ``refined``.
        """
        interval_m, interval_s = usual_interval(self._car)
        count = max(24, round(self._curve.period / interval_m)) * _OVERSAMPLING
        s = np.arange(count + 1) * (self._curve.period / count)
        middle = (s[1:] + s[:-1]) / 2
        density = np.hypot(1 / interval_m, 1 / (interval_s * self.speed(middle)))
        passed = np.concatenate([[0.0], np.cumsum(density) * (self._curve.period / count)])
        intervals = max(24, round(passed[-1])) * refined
        even = np.arange(intervals + 1) * (passed[-1] / intervals)
        return np.asarray(np.interp(even, passed, s))

    def lap(self, gates: Gates, share: float) -> Lap:
        """Of a car that rolls without slip, at this share of the speeds."""
        car, places = self._car, gates.place_m
        n, xi = self._at(self._n, places), self._at(self._xi, places)
        if self._settings.standing:
            n, xi = (one * np.minimum(places / (_EASE * car.wheelbase_m), 1.0) for one in (n, xi))
        v, kappa = share * self.speed(places), self._at(self._kappa, places)
        beta = np.arcsin(np.clip(car.lr_m * kappa, -0.5, 0.5))
        delta = np.arctan(car.wheelbase_m / car.lr_m * np.tan(beta))
        n = np.clip(n, gates.n_min_m, gates.n_max_m)
        way = np.linalg.norm(np.diff(gates.points(n), axis=0), axis=1)
        rolling = np.zeros(len(v))  # drive and steering rate
        states = np.column_stack([
            n, gates.heading_rad + xi - beta, v * np.cos(beta), v * np.sin(beta), v * kappa,
            np.clip(delta, -car.delta_max_rad, car.delta_max_rad), rolling, rolling,
        ])  # fmt: skip
        return Lap(gates, states, 2 * way / np.maximum(v[1:] + v[:-1], _SLOWEST * float(v.max())))


class _NoLapError(InputError):
    """No lap was found from this guess."""


class _Limit:
    """The optimisation of one lap, on any mesh: the dynamic model on a track."""

    def __init__(self, track: Track, car: Car, settings: LimitSettings) -> None:
        self._track, self._car, self._settings = track, car, settings
        self._curve = smooth_centreline(track, car.tuning.raceline)
        self._guess = _Guess(racing_line(track, car), self._curve, car, settings)
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


def solve(track: Track, car: Car, settings: LimitSettings) -> LimitLap:
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
