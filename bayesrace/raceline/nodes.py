"""Racing lines through a few nodes: lateral offsets from the centreline, joined by a cubic spline.

The line of Jain and Morari (2020): what an optimiser without derivatives chooses are the offsets;
the fastest speeds along the path follow from friction and drive (Lipp and Boyd 2014).
"""

from typing import Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.raceline.friction import car_limits
from bayesrace.raceline.gates import check_room
from bayesrace.raceline.line import RaceLine, RaceLineSettings
from bayesrace.tracks import Track
from bayesrace.tracks.spline import PlaneSpline, fit_arc_length
from bayesrace.vehicles.parameters import CarParameters

__all__ = ["NodeLines", "roughness", "timed_line"]

_BEND: Final = 2.0
"""Weight of second differences in :func:`roughness`."""

_FIRST: Final = 6
_GAP: Final = 0.4
"""Least distance of two nodes, over that of evenly spaced ones."""

_ROUNDS: Final = 8
_BEYOND: Final = 1.2
"""How far nodes are pulled back, over what the path between them passes the margin by."""


class NodeLines:
    """All lines of a car through nodes on a track's centreline, closer together in its bends.

    A line is given by the place of each node in the room between the margins: shares (n,) from 0,
    on the right, to 1, on the left. The first node is on the start line.
    """

    def __init__(
        self, track: Track, car: CarParameters, settings: RaceLineSettings, count: int
    ) -> None:
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


def timed_line(
    name: str, path: PlaneSpline, car: CarParameters, settings: RaceLineSettings
) -> RaceLine:
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


def _sampled(path: PlaneSpline, car: CarParameters) -> Floats:
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
