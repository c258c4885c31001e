"""The friction circle: what a car can do by mass, geometry, drive and one friction number alone.

:class:`CarLimits` bounds the racing line's programme. :func:`speed_profile` gives the fastest
speeds along a given path: the programme's first guess, and the lap of a fixed line.

:class:`NodeLines` are the lines of Jain and Morari (2020): lateral offsets of a few nodes from the
centreline, which an optimiser without derivatives chooses, joined by a cubic spline. The fastest
speeds along the path follow from friction and drive (Lipp and Boyd 2014).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import casadi as ca
import numpy as np

from bayesrace.arrays import Floats
from bayesrace.raceline.gates import check_room
from bayesrace.raceline.line import RaceLine, RaceLineSettings
from bayesrace.tracks import Track
from bayesrace.tracks.spline import PlaneSpline, fit_arc_length
from bayesrace.vehicles.models import longitudinal_force, top_command
from bayesrace.vehicles.parameters import Car
from bayesrace.vehicles.parts import GRAVITY_MPS2

__all__ = [
    "CarLimits",
    "NodeLines",
    "car_limits",
    "roughness",
    "speed_profile",
    "timed_line",
]

_TABLE = 400

_BEND: Final = 2.0
"""Weight of second differences in :func:`roughness`."""

_FIRST: Final = 6
_GAP: Final = 0.4
"""Least distance of two nodes, over that of evenly spaced ones."""

_ROUNDS: Final = 8
_BEYOND: Final = 1.2
"""How far nodes are pulled back, over what the path between them passes the margin by."""


@dataclass(frozen=True)
class CarLimits:
    """What the car can do, from what one can measure; works on numbers and CasADi expressions."""

    car: Car
    grip_mps2: float
    """Radius of the friction circle."""
    straight: ca.Function
    """(v, d) to the acceleration without cornering [m/s^2]; d as the drive can."""

    def steering(self, kappa: Any) -> Any:
        """Steering angle that a path of this curvature needs [rad].

        Kinematic bicycle: sin(beta) = lr kappa and tan(beta) = lr / L tan(delta).
        """
        slope = self.car.wheelbase_m * kappa / ca.sqrt(1 - (self.car.lr_m * kappa) ** 2)
        return ca.atan(slope)

    @property
    def kappa_max_radpm(self) -> float:
        """Curvature at full lock."""
        slope = self.car.lr_m / self.car.wheelbase_m * np.tan(self.car.delta_max_rad)
        return float(np.sin(np.arctan(slope)) / self.car.lr_m)

    def straight_values(self, v: Floats, d: float) -> Floats:
        """``straight`` at many speeds."""
        return np.asarray(self.straight(v.reshape(1, -1), d)).ravel()

    def top_speed(self) -> float:
        """Speed at which full drive only balances the resistances [m/s]."""
        highest_mps = self.car.tuning.raceline.speed_bound_mps
        v = np.linspace(0.0, highest_mps, 3001)
        spent = self.straight_values(v, self.car.d_max) <= 0
        spent[0] = False  # a standing car has no resistance but may have no drive either
        return float(v[int(np.argmax(spent))]) if spent.any() else highest_mps

    def fastest(self, kappa: Floats, step: Floats, v_min: float, v_max: float) -> Floats:
        """:func:`speed_profile` of a closed path within these limits."""
        drive = partial(self.straight_values, d=self.car.d_max)
        brake = partial(self.straight_values, d=self.car.d_min)
        return speed_profile(kappa, step, self.grip_mps2, drive, brake, v_min, v_max)


def car_limits(car: Car, settings: RaceLineSettings) -> CarLimits:
    """The limits of a car, friction from the settings or else the car's."""
    v, d = ca.SX.sym("v"), ca.SX.sym("d")
    acting = ca.fmin(d, top_command(car, v, car.d_max))
    straight = longitudinal_force(car, v, acting) / car.mass_kg
    friction = car.friction if settings.friction is None else settings.friction
    return CarLimits(
        car=car,
        grip_mps2=friction * GRAVITY_MPS2,
        straight=ca.Function("straight", [v, d], [straight]),
    )


def speed_profile(
    kappa: Floats,
    step: Floats,
    grip_mps2: float,
    drive: Callable[[Floats], Floats],
    brake: Callable[[Floats], Floats],
    v_min: float,
    v_max: float,
    start_mps: float | None = None,
) -> Floats:
    """Speeds (n,) on a closed path of curvature ``kappa`` (n,), ``step`` (n,) to the next point.

    Forward-backward pass within the friction circle ``grip_mps2`` and the acceleration limits
    ``drive(v) >= a >= brake(v)``, starting at the slowest point so that the lap closes. With
    ``start_mps`` the path is open and begins at this speed; the last step is not used.
    """
    v = np.linspace(0.0, v_max, _TABLE)
    per_mps = (_TABLE - 1) / v_max
    highest, lowest = drive(v).tolist(), (-brake(v)).tolist()
    cap = np.clip(grip_mps2 / np.maximum(np.abs(kappa), 1e-6), v_min**2, v_max**2)
    start = int(np.argmin(cap)) if start_mps is None else 0
    energy: list[float] = np.roll(cap, -start).tolist()
    bend: list[float] = np.roll(np.abs(kappa), -start).tolist()
    length: list[float] = np.roll(step, -start).tolist()
    last = len(energy)
    if start_mps is not None:
        energy[0] = start_mps**2
        last -= 1

    def gained(k: int, limit: list[float]) -> float:
        """Most that the squared speed at k changes over a metre, by this table of speeds."""
        place = math.sqrt(energy[k]) * per_mps
        i = min(int(place), _TABLE - 2)
        along = grip_mps2**2 - (bend[k] * energy[k]) ** 2
        push = limit[i] + (place - i) * (limit[i + 1] - limit[i])
        return 2 * max(min(push, math.sqrt(max(along, 0.0))), 0.0)

    for k in range(last):
        following = (k + 1) % len(energy)
        energy[following] = min(energy[following], energy[k] + length[k] * gained(k, highest))
    for k in range(last - 1, -1, -1):
        following = (k + 1) % len(energy)
        energy[k] = min(energy[k], energy[following] + length[k] * gained(following, lowest))
    return np.asarray(np.sqrt(np.roll(energy, start)))


class NodeLines:
    """All lines of a car through nodes on a track's centreline, closer together in its bends.

    A line is given by the place of each node in the room between the margins: shares (n,) from 0,
    on the right, to 1, on the left. The first node is on the start line.
    """

    def __init__(self, track: Track, car: Car, settings: RaceLineSettings, count: int) -> None:
        """Raises InputError if the margin leaves no room at a node."""
        self._track, self._car = track, car
        self._settings = settings
        self._margin_m = car.width_m / 2 if settings.margin_m is None else settings.margin_m
        s = _places(track, count)
        right, left = track.widths(s)
        self._low, self._high = self._margin_m - right, left - self._margin_m
        self._xy, self._normal = track.position(s), track.normal(s)
        room = self._high - self._low
        check_room(track, s, room, self._margin_m, car.tuning.raceline.room_m)

    def line(self, shares: Floats) -> RaceLine | None:
        """The closed line through the nodes with the fastest speeds of a flying lap.

        Where the path between two nodes passes the margin, these are pulled back; None if that
        does not help, as too few nodes cannot follow the track.
        """
        offset = self._low + shares * (self._high - self._low)
        for _ in range(_ROUNDS):
            path = fit_arc_length(self._xy + offset[:, None] * self._normal)
            at = _sampled(path, self._car)
            where = self._track.project_points(path(at))
            excess = where.off_track_m + self._margin_m
            if float(excess.max()) <= self._car.tuning.raceline.tolerance_m:
                return timed_line(self._track.name, path, self._car, self._settings)
            piece = np.searchsorted(path.knots, at, side="right") - 1
            for side, step in ((where.n_m > 0, -_BEYOND), (where.n_m < 0, _BEYOND)):
                pull = np.zeros(len(offset))
                beyond = np.where(side, np.maximum(excess, 0.0), 0.0)
                for end in (piece, (piece + 1) % len(offset)):
                    np.maximum.at(pull, end, beyond)
                offset = np.clip(offset + step * pull, self._low, self._high)
        return None


def timed_line(name: str, path: PlaneSpline, car: Car, settings: RaceLineSettings) -> RaceLine:
    """A closed path, evenly sampled, with the fastest speeds of a flying lap along it."""
    at, limits = _sampled(path, car), car_limits(car, settings)
    xy, first, second = path.derivatives(at)
    speed = np.linalg.norm(first, axis=1)
    kappa = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / speed**3
    psi = np.unwrap(np.arctan2(first[:, 1], first[:, 0]))
    chord = np.linalg.norm(np.roll(xy, -1, axis=0) - xy, axis=1)
    step = chord * (1 + (kappa * chord) ** 2 / 24)
    v = limits.fastest(kappa, step, car.tuning.raceline.speed_min_mps, limits.top_speed())
    a = (np.roll(v, -1) ** 2 - v**2) / (2 * step)
    s = np.concatenate([[0.0], np.cumsum(step[:-1])])
    return RaceLine(name, s, xy[:, 0], xy[:, 1], psi, kappa, v, a, float(step.sum()))


def _sampled(path: PlaneSpline, car: Car) -> Floats:
    count = max(24, round(path.period / car.tuning.raceline.spacing_m))
    return np.arange(count, dtype=np.float64) * (path.period / count)


def _places(track: Track, count: int) -> Floats:
    """Arc lengths (n,) of the nodes, ascending from 0, by which a spline follows the centreline.

    From a few even ones; each further node is where the spline so far is farthest away.
    """
    length = track.length_m
    s: Floats = np.arange(30 * count, dtype=np.float64) * (length / (30 * count))
    centre = track.position(s)
    places: Floats = np.arange(_FIRST, dtype=np.float64) * (length / _FIRST)
    while len(places) < count:
        spline = PlaneSpline(places, track.position(places), length)
        away = np.linalg.norm(spline(s) - centre, axis=1)
        gap = np.abs((s[:, None] - places + length / 2) % length - length / 2).min(axis=1)
        away[gap < _GAP * length / count] = 0.0
        places = np.sort(np.append(places, s[int(np.argmax(away))]))
    return places


def roughness(count: int) -> Floats:
    """Matrix F (n, n) by which lines differ as far as their places and their bends do.

    |x F|^2 = |x|^2 + w |second differences of x|^2: a lap time depends on curvature.
    """
    bends = np.roll(np.eye(count), 1, axis=0) + np.roll(np.eye(count), -1, axis=0)
    bends -= 2 * np.eye(count)
    return np.asarray(np.linalg.cholesky(np.eye(count) + _BEND * bends.T @ bends))
