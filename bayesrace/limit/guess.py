"""The first guess of a lap: the racing line at its speeds, by place on the smoothed centreline."""

from typing import Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.limit.lap import LimitSettings
from bayesrace.limit.ocp import Lap, usual_interval
from bayesrace.raceline import RaceLine
from bayesrace.raceline.gates import Gates
from bayesrace.tracks.spline import CentrelineSearch, PlaneSpline
from bayesrace.vehicles.parameters import CarParameters
from bayesrace.vehicles.parts import GRAVITY_MPS2

__all__ = ["Guess"]

_EASE: Final = 20.0
"""Wheelbases after which a standing lap is on the racing line."""

_LAUNCH: Final = 0.5
"""Of the grip, with which a standing lap begins."""

_OVERSAMPLING: Final = 8

_SLOWEST: Final = 0.01
"""Over the top speed: a lap may begin at rest."""


class Guess:
    """A racing line as a function of the place on the smoothed centreline."""

    def __init__(
        self, line: RaceLine, curve: PlaneSpline, car: CarParameters, settings: LimitSettings
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
