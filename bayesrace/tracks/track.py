"""A closed track: centreline and width on both sides, over arc length; its start line, which counts
and times laps without any spline.

Signs: the lateral offset n and the normal point to the LEFT of the driving direction; curvature is
positive in a left-hand bend. Any real s is accepted and wraps at the start line.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from bayesrace.arrays import Floats
from bayesrace.cache import digest
from bayesrace.errors import InputError
from bayesrace.tracks.checks import find_fault
from bayesrace.tracks.spline import CentrelineSearch, PlaneSpline, fit_arc_length

if TYPE_CHECKING:
    from bayesrace.vehicles.parameters import Car

__all__ = ["Crossing", "CrossingLine", "PathProjection", "StartLine", "Track", "drop_repeated"]

_ON_LINE_M: Final = 1e-9
"""A car placed on the line is past it, whatever rounding makes of its coordinates."""


@dataclass(frozen=True, eq=False)
class PathProjection:
    """Where points are on a track; arrays of shape (m,)."""

    s_m: Floats
    """Arc length of the foot points, in [0, length)."""
    n_m: Floats
    """Lateral offsets, positive to the left."""
    off_track_m: Floats
    """Distances outside the track; <= 0 inside."""
    progress_m: Floats
    """Arc length without wrapping, first value in [-length/2, length/2): + length each lap."""


@dataclass(frozen=True, eq=False, repr=False)
class Track:
    """Closed track given by nodes of its centreline; node 0 is the start line.

    Arrays have shape (n,); the last node is not a repetition of the first. Make one with
    :meth:`from_points`, :func:`bayesrace.tracks.load_track` or the random generator.
    """

    name: str
    s_m: Floats
    x_m: Floats
    y_m: Floats
    width_right_m: Floats
    width_left_m: Floats
    length_m: float

    @classmethod
    def load(
        cls, source: "str | Path | npt.ArrayLike", car: "Car | None" = None, name: str = "track"
    ) -> "Track":
        """A built-in track, ``random:SEED`` or ``random10:SEED``, that in a CSV file or a ROS map
        (``.yaml``), or points.

        Points are rows x, y, width to the right, width to the left, shape (n, 4), in metres and in
        driving order; ``name`` is theirs. ``car``: which must fit on it, by width and scale.
        InputError names the place and the remedy.
        """
        from bayesrace.tracks.library import load_any

        width_m = None if car is None else car.width_m
        if isinstance(source, str | Path):
            return load_any(str(source), width_m)[0]
        points = np.asarray(source, dtype=float)
        if points.ndim != 2 or points.shape[1:] != (4,):
            raise InputError(
                f"track '{name}': an array of shape {points.shape}, expected (n, 4): x, y, width "
                "to the right, width to the left [m]"
            )
        return cls.from_points(name, points[:, :2], points[:, 2], points[:, 3], width_m or 0.0)

    @classmethod
    def from_points(
        cls,
        name: str,
        xy: npt.ArrayLike,
        width_right: npt.ArrayLike,
        width_left: npt.ArrayLike,
        min_width_m: float = 0.0,
    ) -> "Track":
        """Track through points (n, 2) [m], widths scalar or (n,) [m].

        A repetition of the first point at the end is dropped. Raises InputError naming the point
        (counted from 0) when the points don't make a track at least ``min_width_m`` wide.
        """
        points = np.array(xy, dtype=float)
        if points.ndim != 2 or points.shape[1:] != (2,):
            raise InputError(
                f"track '{name}': expected points of shape (n, 2), got {points.shape}; "
                "give one row with x and y per point"
            )
        right = np.broadcast_to(np.asarray(width_right, dtype=float), len(points))
        left = np.broadcast_to(np.asarray(width_left, dtype=float), len(points))
        rows: Sequence[int] = range(len(points))
        points, right, left = drop_repeated(points, right, left)
        fault = find_fault(points, right, left, min_width_m)
        if fault is not None:
            raise InputError(fault.text(f"track '{name}'", "point", rows))
        return cls._from_checked(name, points, right, left)

    @classmethod
    def _from_checked(cls, name: str, points: Floats, right: Floats, left: Floats) -> "Track":
        spline = fit_arc_length(points)
        arrays = (spline.knots, points[:, 0].copy(), points[:, 1].copy(), right + 0.0, left + 0.0)
        for array in arrays:
            array.setflags(write=False)
        return cls(name, *arrays, spline.period)

    def __repr__(self) -> str:
        return f"<Track '{self.name}': {self.length_m:.3f} m, {len(self.s_m)} nodes>"

    @cached_property
    def identity(self) -> str:
        """Name without spaces and a digest of the shape, which does not change with the name."""
        columns = (self.x_m, self.y_m, self.width_right_m, self.width_left_m)
        shape = digest(column.astype("<f8", order="C").tobytes() for column in columns)
        return f"{'_'.join(self.name.split())}-{shape}"

    @cached_property
    def centreline(self) -> PlaneSpline:
        """The centreline as a spline over arc length."""
        return PlaneSpline(self.s_m, np.column_stack([self.x_m, self.y_m]), self.length_m)

    @cached_property
    def _search(self) -> CentrelineSearch:
        total = float(np.min(self.width_right_m + self.width_left_m))
        return CentrelineSearch(self.centreline, spacing_m=total / 16.0)

    @property
    def one_foot_m(self) -> float:
        """A place that is nearer to the centreline than this has one nearest point on it."""
        return self._search.one_foot_m

    @cached_property
    def _width_table(self) -> tuple[Floats, Floats, Floats]:
        right, left = self.width_right_m, self.width_left_m
        return (
            np.append(self.s_m, self.length_m),
            np.append(right, right[0]),
            np.append(left, left[0]),
        )

    def position(self, s: npt.ArrayLike) -> Floats:
        """Centreline point(s), shape (..., 2) [m]."""
        return self.centreline(s)

    def heading(self, s: npt.ArrayLike) -> Floats:
        """Direction of the centreline's tangent, in (-pi, pi] [rad]."""
        tangent = self.centreline(s, 1)
        return np.asarray(np.arctan2(tangent[..., 1], tangent[..., 0]))

    def normal(self, s: npt.ArrayLike) -> Floats:
        """Unit normal(s) to the left of the driving direction, shape (..., 2)."""
        tangent = self.centreline(s, 1)
        tangent = tangent / np.linalg.norm(tangent, axis=-1, keepdims=True)
        return np.stack([-tangent[..., 1], tangent[..., 0]], axis=-1)

    def curvature(self, s: npt.ArrayLike) -> Floats:
        """Curvature of the centreline, positive in a left-hand bend [rad/m]."""
        _, first, second = self.centreline.derivatives(np.asarray(s, dtype=float))
        cross = first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
        return np.asarray(cross / np.linalg.norm(first, axis=-1) ** 3)

    def widths(self, s: npt.ArrayLike) -> tuple[Floats, Floats]:
        """Distance from the centreline to the right and to the left edge, linear in s [m]."""
        nodes, right, left = self._width_table
        wrapped = np.mod(np.asarray(s, dtype=float), self.length_m)
        return np.interp(wrapped, nodes, right), np.interp(wrapped, nodes, left)

    def boundaries(self, spacing_m: float = 0.02) -> tuple[Floats, Floats]:
        """Right and left edge as points (m, 2), about ``spacing_m`` apart along the centreline."""
        count = max(8, round(self.length_m / spacing_m))
        s = np.arange(count) * (self.length_m / count)
        centre, normal = self.position(s), self.normal(s)
        right, left = self.widths(s)
        return centre - right[:, None] * normal, centre + left[:, None] * normal

    def start_pose(self) -> tuple[float, float, float]:
        """x [m], y [m] of node 0 and the heading there [rad]."""
        return float(self.x_m[0]), float(self.y_m[0]), float(self.heading(0.0))

    def project_points(self, xy: npt.ArrayLike) -> PathProjection:
        """Nearest foot points of points (m, 2) that need not be a trajectory."""
        points = np.asarray(xy, dtype=float).reshape(-1, 2)
        return self._projected(points, self._search.nearest(points))

    def project_path(self, xy: npt.ArrayLike, s_guess_m: float | None = None) -> PathProjection:
        """Foot points of a trajectory (m, 2), each sought from its predecessor's, the first from
        the guess or else everywhere.

        A neighbouring piece of the track can't capture the trajectory, unless it is the next one,
        within 2.5 track widths along the centreline: a car inside a bend that is tighter than the
        track is wide is beside the piece after the bend all of a sudden. After a leap longer than
        the track is wide, or farther than that from the piece, the search is global again.
        """
        points = np.asarray(xy, dtype=float).reshape(-1, 2)
        reach = float(np.max(self.width_right_m + self.width_left_m))
        return self._projected(points, self._search.follow(points, s_guess_m, reach))

    def mirrored(self) -> "Track":
        """The track mirrored at the x axis: left-hand bends become right-hand bends."""
        points = np.column_stack([self.x_m, -self.y_m])
        name = f"{self.name}-mirrored"
        return Track._from_checked(name, points, self.width_left_m, self.width_right_m)

    def driven_from(
        self, start_m: tuple[float, float] | None = None, reverse: bool = False
    ) -> "Track":
        """The same track, its start line at the node nearest to a point [m], or driven backwards.

        ``start_m`` None: the start line stays.
        """
        points = np.column_stack([self.x_m, self.y_m])
        first = 0
        if start_m is not None:
            first = int(np.argmin(np.linalg.norm(points - start_m, axis=1)))
        order = (first + np.arange(len(points)) * (-1 if reverse else 1)) % len(points)
        right, left = self.width_right_m[order], self.width_left_m[order]
        if reverse:
            right, left = left, right
        return Track._from_checked(self.name, points[order], right, left)

    def _projected(self, points: Floats, s: Floats) -> PathProjection:
        n = self._offsets(points, s)
        progress = np.unwrap(s, period=self.length_m)
        if len(s) and s[0] >= self.length_m / 2:
            progress = progress - self.length_m
        return PathProjection(s, n, self._off_track(s, n), progress)

    def _offsets(self, points: Floats, s: Floats) -> Floats:
        return np.asarray(np.sum((points - self.position(s)) * self.normal(s), axis=-1))

    def _off_track(self, s: Floats, n: Floats) -> Floats:
        right, left = self.widths(s)
        return np.maximum(n - left, -n - right)


def drop_repeated(points: Floats, right: Floats, left: Floats) -> tuple[Floats, Floats, Floats]:
    """The same without a last point that repeats the first (to a thousandth of the spacing)."""
    if len(points) > 2:
        spacing = float(np.median(np.linalg.norm(np.diff(points, axis=0), axis=1)))
        if np.linalg.norm(points[-1] - points[0]) <= 1e-3 * spacing:
            return points[:-1], right[:-1], left[:-1]
    return points, right, left


class Crossing(NamedTuple):
    """Whether a step crossed the line: +1 in driving direction, -1 against it, 0 not at all."""

    direction: int
    fraction: float
    """Part of the step at which it crossed, in [0, 1]; 0 without a crossing."""


class CrossingLine:
    """A line across the way: from a point, the direction of driving and the reach to each side.

    Plant and analysis count laps with this one piece of code, or a run could end with a lap that
    does not count.
    """

    def __init__(
        self, x_m: float, y_m: float, heading_rad: float, left_m: float, right_m: float
    ) -> None:
        self._x, self._y = x_m, y_m
        self._cos, self._sin = math.cos(heading_rad), math.sin(heading_rad)
        self.left_m, self.right_m = left_m, right_m

    def signed_distance(self, x: Any, y: Any) -> Any:
        """Distance past the line along the driving direction [m], negative before it."""
        return (x - self._x) * self._cos + (y - self._y) * self._sin

    def is_past(self, x: Any, y: Any) -> Any:
        """Whether points (numbers or arrays) are past it; a step between two that agree does not
        cross it."""
        return self.signed_distance(x, y) >= -_ON_LINE_M

    def crossing(self, prev_xy: Sequence[float], cur_xy: Sequence[float]) -> Crossing:
        """Whether the straight step from ``prev_xy`` to ``cur_xy`` [m] crosses the line.

        A point on the line counts as past it, so that of two successive steps exactly one crosses.
        """
        before = self.signed_distance(prev_xy[0], prev_xy[1])
        after = self.signed_distance(cur_xy[0], cur_xy[1])
        was_past, is_past = before >= -_ON_LINE_M, after >= -_ON_LINE_M
        if was_past == is_past:
            return Crossing(0, 0.0)
        fraction = min(max(before / (before - after), 0.0), 1.0)
        x = prev_xy[0] + fraction * (cur_xy[0] - prev_xy[0]) - self._x
        y = prev_xy[1] + fraction * (cur_xy[1] - prev_xy[1]) - self._y
        lateral = y * self._cos - x * self._sin
        if not -self.right_m <= lateral <= self.left_m:
            return Crossing(0, 0.0)
        return Crossing(1 if is_past else -1, fraction)


class StartLine(CrossingLine):
    """The line across the track at s = 0, as long as the track is wide and a little beyond.

    It ends half-way to the next piece of the track, so that a car there isn't counted.
    """

    def __init__(self, track: Track) -> None:
        x, y, psi = track.start_pose()
        super().__init__(x, y, psi, 0.0, 0.0)
        self.right_m = self._reach(track, float(track.width_right_m[0]), -1.0)
        self.left_m = self._reach(track, float(track.width_left_m[0]), 1.0)

    def _reach(self, track: Track, width: float, side: float) -> float:
        """Twice the width, but not beyond the middle between this piece and the next one."""
        count = max(4 * len(track.s_m), round(track.length_m / (0.1 * max(width, 1e-3))))
        points = track.position(np.arange(count) * (track.length_m / count))
        dx, dy = points[:, 0] - self._x, points[:, 1] - self._y
        along = dx * self._cos + dy * self._sin
        across = side * (dy * self._cos - dx * self._sin)
        change = along * np.roll(along, -1) <= 0
        hits = across[change & (across > 0.5 * width)]
        nearest = float(hits.min()) if len(hits) else math.inf
        return max(width, min(2.0 * width, nearest / 2.0))
