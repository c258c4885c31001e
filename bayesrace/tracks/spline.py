"""Closed plane curves, in numpy alone: periodic cubic splines over arc length, nearest points,
smoothing and resampling, and polygons with rounded corners.

scipy has splines too, but importing it costs more than loading a track, and the controller process
must start fast.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt

from bayesrace.arrays import Floats

__all__ = [
    "CentrelineSearch",
    "Corner",
    "PlaneSpline",
    "fit_arc_length",
    "resample_closed",
    "rounded_polygon",
    "smooth",
    "smooth_closed",
]

_GAUSS_X, _GAUSS_W = np.polynomial.legendre.leggauss(5)
_BESIDE = 2.5  # track widths between the two feet of a car inside a bend, up to 135 degrees
_ONE_FOOT = 0.8  # of the least radius: nearer to the curve, a bend has one foot
_CHUNK = 256  # query points per distance matrix, bounds its memory
_MAX_SAMPLES = 20_000
_NODES_A_WIDTH: Final = 6
"""Nodes of a smooth centreline in a width of the track."""
_FEWEST: Final = 24
_STRENGTHS: Final = np.geomspace(1e-3, 1e13, 200)
"""Of the smoothing: a filter over a thirtieth of a point to a thousand points."""

Corner = tuple[float, float, float]
"""x [m], y [m] of a polygon's vertex and the radius [m] of the arc that rounds it."""


@dataclass(frozen=True, eq=False)
class PlaneSpline:
    """C2 periodic interpolating cubic spline through ``points`` at ascending ``knots``.

    ``knots`` (n,) start anywhere, ``points`` (n, 2); after ``period`` the curve repeats, so the
    first point is not given twice.
    """

    knots: Floats
    points: Floats
    period: float

    @cached_property
    def _table(self) -> Floats:
        """Power coefficients (4, n, 2): point = c0 + c1 t + c2 t^2 + c3 t^3, t from the knot."""
        step = np.diff(np.append(self.knots, self.knots[0] + self.period))
        following = np.roll(self.points, -1, axis=0)
        slope = (following - self.points) / step[:, None]
        second = _cyclic_second_derivatives(step, 6.0 * (slope - np.roll(slope, 1, axis=0)))
        second_following = np.roll(second, -1, axis=0)
        width = step[:, None]
        return np.stack(
            [
                self.points,
                slope - width * (2.0 * second + second_following) / 6.0,
                second / 2.0,
                (second_following - second) / (6.0 * width),
            ]
        )

    def __call__(self, s: npt.ArrayLike, derivative: int = 0) -> Floats:
        """Point (..., 2), or its first or second derivative, at any real ``s`` (...)."""
        return self.derivatives(np.asarray(s, dtype=float))[derivative]

    def derivatives(self, s: Floats) -> tuple[Floats, Floats, Floats]:
        """Point, first and second derivative in one look-up."""
        local, piece = self._locate(s)
        c0, c1, c2, c3 = self._table[:, piece]
        t = local[..., None]
        return (
            c0 + t * (c1 + t * (c2 + t * c3)),
            c1 + t * (2.0 * c2 + t * 3.0 * c3),
            2.0 * c2 + 6.0 * t * c3,
        )

    def piece_lengths(self) -> Floats:
        """Arc length of each of the n pieces (5-point Gauss quadrature)."""
        step = np.diff(np.append(self.knots, self.knots[0] + self.period))
        at = self.knots[:, None] + step[:, None] * (_GAUSS_X + 1.0) / 2.0
        speed = np.linalg.norm(self(at, 1), axis=-1)
        return np.asarray(speed @ _GAUSS_W * step / 2.0)

    def _locate(self, s: Floats) -> tuple[Floats, npt.NDArray[np.intp]]:
        offset = np.mod(s - self.knots[0], self.period)
        piece = np.searchsorted(self.knots - self.knots[0], offset, side="right") - 1
        return offset - (self.knots[piece] - self.knots[0]), piece


def fit_arc_length(points: Floats) -> PlaneSpline:
    """Periodic spline through ``points`` (n, 2), not repeated, whose parameter is arc length.

    Starts from chord lengths; refitting over the measured arc lengths converges in few rounds
    (the remaining error is that of the spline's own speed between knots).
    """
    lengths = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    for _ in range(4):
        knots = np.concatenate([[0.0], np.cumsum(lengths[:-1])])
        spline = PlaneSpline(knots, points, float(lengths.sum()))
        lengths = spline.piece_lengths()
    return spline


def _cyclic_second_derivatives(step: Floats, rhs: Floats) -> Floats:
    """Solves h_{i-1} M_{i-1} + 2 (h_{i-1} + h_i) M_i + h_i M_{i+1} = rhs_i, indices cyclic.

    Sherman-Morrison turns the cyclic system into two tridiagonal ones, solved by Thomas'
    algorithm on plain floats (faster than numpy scalars).
    """
    count = len(step)
    before = np.roll(step, 1)
    diagonal = 2.0 * (before + step)
    corner = float(before[0])  # couples the first with the last unknown
    gamma = -float(diagonal[0])
    diagonal[0] -= gamma
    diagonal[-1] -= corner * corner / gamma
    u = np.zeros(count)
    u[0], u[-1] = gamma, corner
    y, z = _tridiagonal(step[:-1], diagonal, np.column_stack([rhs, u]))
    ratio = corner / gamma
    factor = (y[0] + ratio * y[-1]) / (1.0 + z[0] + ratio * z[-1])
    return np.asarray(y - z[:, None] * factor)


def _tridiagonal(off: Floats, diagonal: Floats, rhs: Floats) -> tuple[Floats, Floats]:
    """Symmetric tridiagonal solve; the last column of ``rhs`` is returned apart."""
    count = len(diagonal)
    e, d = off.tolist(), diagonal.tolist()
    columns = []
    factors = [0.0] * count
    for i in range(1, count):
        factors[i] = e[i - 1] / d[i - 1]
        d[i] -= factors[i] * e[i - 1]
    for column in rhs.T.tolist():
        for i in range(1, count):
            column[i] -= factors[i] * column[i - 1]
        column[-1] /= d[-1]
        for i in range(count - 2, -1, -1):
            column[i] = (column[i] - e[i] * column[i + 1]) / d[i]
        columns.append(column)
    solution = np.array(columns).T
    return solution[:, :-1], solution[:, -1]


class CentrelineSearch:
    """Searches on samples of the curve first, then refines on the curve itself.

    ``spacing_m``: distance of the samples, to be small against the width of the track.
    """

    def __init__(self, curve: PlaneSpline, spacing_m: float) -> None:
        count = int(np.ceil(curve.period / spacing_m))
        self._count = min(max(count, 4 * len(curve.knots)), _MAX_SAMPLES)
        self._curve = curve
        self._step = curve.period / self._count
        self._samples = curve(np.arange(self._count) * self._step)

    @cached_property
    def _lists(self) -> tuple[list[float], list[float]]:
        """The samples as plain floats: the walk below visits few of them, one by one."""
        return self._samples[:, 0].tolist(), self._samples[:, 1].tolist()

    @cached_property
    def one_foot_m(self) -> float:
        """Nearer to the curve than this, a place has one nearest point on it."""
        s: Floats = np.arange(self._count, dtype=np.float64) * self._step
        _, first, second = self._curve.derivatives(s)
        cross = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
        curvature = np.abs(cross) / np.linalg.norm(first, axis=1) ** 3
        return _ONE_FOOT * float(1 / np.max(curvature, initial=1e-9))

    def nearest(self, points: Floats) -> Floats:
        """Arc lengths (m,) in [0, period) of the globally nearest curve points to (m, 2)."""
        parts = [self._nearest_chunk(points[i : i + _CHUNK]) for i in range(0, len(points), _CHUNK)]
        return np.concatenate(parts) if parts else np.empty(0)

    def _nearest_chunk(self, points: Floats) -> Floats:
        # Several pieces can be almost equally near. A local minimum of the true distance is at
        # most half a step from a sample, so every sampled local minimum that is within half a
        # step of the best one may hide the true nearest point: all of them are refined.
        distance = np.hypot(
            points[:, :1] - self._samples[:, 0], points[:, 1:] - self._samples[:, 1]
        )
        bound = distance.min(axis=1, keepdims=True) + self._step / 2
        lowest = (distance <= np.roll(distance, 1, axis=1)) & (
            distance <= np.roll(distance, -1, axis=1)
        )
        query, sample = np.nonzero(lowest & (distance <= bound))
        s = self._refine(points[query], sample)
        exact = np.linalg.norm(self._curve(s) - points[query], axis=1)
        order = np.lexsort((s, exact, query))
        _, first = np.unique(query[order], return_index=True)
        return np.asarray(s[order[first]])

    def follow(self, points: Floats, s_guess: float | None, reach: float) -> Floats:
        """Foot points (m,) of a trajectory (m, 2); global search after gaps beyond ``reach``."""
        if not len(points):
            return np.empty(0)
        gap = np.zeros(len(points))
        gap[1:] = np.linalg.norm(np.diff(points, axis=0), axis=1)
        at = None if s_guess is None else round(s_guess / self._step) % self._count
        xs, ys = self._lists
        samples = np.empty(len(points), dtype=np.intp)
        for k, (x, y) in enumerate(points.tolist()):
            at = self._walk(x, y, at) if at is not None and gap[k] <= reach else None
            if at is None or (x - xs[at]) ** 2 + (y - ys[at]) ** 2 > reach**2:
                s = self._nearest_chunk(points[k : k + 1])
                at = round(float(s[0]) / self._step) % self._count
            samples[k] = at
        return self._refine(points, self._nearest_beside(points, samples, reach))

    def _nearest_beside(self, points: Floats, samples: np.ndarray, reach: float) -> np.ndarray:
        """Nearest samples of those that are up to :data:`_BESIDE` times ``reach`` before and after
        these. Of two that are as near to within a sample, either may be taken.

        Inside a bend that is tighter than the track is wide, the walk stays behind at a local
        minimum: beside it lies the piece after the bend, where the car is.
        """
        most = min(round(_BESIDE * reach / self._step), self._count // 2)
        around, found = np.arange(-most, most + 1), samples.copy()
        away_m = np.linalg.norm(points - self._samples[samples], axis=1)
        sought = np.flatnonzero(away_m > self.one_foot_m)
        for part in (sought[i : i + _CHUNK] for i in range(0, len(sought), _CHUNK)):
            near = (samples[part, None] + around) % self._count
            square = np.sum((points[part, None] - self._samples[near]) ** 2, axis=2)
            found[part] = near[np.arange(len(part)), np.argmin(square, axis=1)]
        return found

    def _walk(self, x: float, y: float, at: int) -> int:
        """Index of the sample where the distance stops falling, going from ``at``."""
        xs, ys = self._lists
        count = self._count
        here = (x - xs[at]) ** 2 + (y - ys[at]) ** 2
        for direction in (1, -1):
            moved = False
            for _ in range(count):
                following = (at + direction) % count
                there = (x - xs[following]) ** 2 + (y - ys[following]) ** 2
                if there >= here:
                    break
                at, here, moved = following, there, True
            if moved:
                break
        return at

    def _refine(self, points: Floats, samples: np.ndarray) -> Floats:
        """Newton on the derivative of the squared distance, kept within one step by bisection."""
        s = samples * self._step
        low, high = s - self._step, s + self._step
        for _ in range(60):
            centre, first, second = self._curve.derivatives(s)
            away = centre - points
            slope = np.sum(away * first, axis=1)
            bend = np.sum(first * first, axis=1) + np.sum(away * second, axis=1)
            low = np.where(slope < 0, s, low)
            high = np.where(slope > 0, s, high)
            with np.errstate(divide="ignore", invalid="ignore"):
                newton = s - slope / bend
            inside = (bend > 0) & (newton >= low) & (newton <= high)
            following = np.where(inside, newton, (low + high) / 2)
            following = np.where(slope == 0, s, following)
            change = float(np.max(np.abs(following - s), initial=0.0))
            s = following
            if change < 1e-12 * self._curve.period:
                break
        wrapped = np.mod(s, self._curve.period)
        wrapped[wrapped >= self._curve.period] = 0.0  # the remainder of -1e-20 rounds up
        return np.asarray(wrapped)


def rounded_polygon(
    corners: Sequence[Corner], spacing_m: float = 0.04, easing_m: float = 0.05
) -> Floats | None:
    """Points (n, 2), about ``spacing_m`` apart, along the closed polygon with rounded corners.

    Smoothing over ``easing_m`` lets the curvature grow over a short way instead of jumping where
    an arc begins. None if arcs overlap: the radii don't fit into the polygon.
    """
    vertices = np.array([corner[:2] for corner in corners])
    radii = np.array([corner[2] for corner in corners])
    edge = np.roll(vertices, -1, axis=0) - vertices
    length = np.linalg.norm(edge, axis=1)
    out = edge / length[:, None]
    into = np.roll(out, 1, axis=0)
    turn = np.arctan2(into[:, 0] * out[:, 1] - into[:, 1] * out[:, 0], np.sum(into * out, axis=1))
    tangent = radii * np.tan(np.abs(turn) / 2)
    if np.any(tangent + np.roll(tangent, -1) > length):
        return None
    dense = [
        _arc(vertices[i] - tangent[i] * into[i], into[i], turn[i], radii[i])
        for i in range(len(corners))
    ]
    points = resample_closed(np.concatenate(dense), 0.005)
    return resample_closed(smooth_closed(points, easing_m / 0.005), spacing_m)


def smooth_closed(points: Floats, sigma_samples: float) -> Floats:
    """Periodic Gaussian filter of evenly spaced points (n, 2); sigma counted in points."""
    frequency = 2 * np.pi * np.fft.rfftfreq(len(points))
    gain = np.exp(-0.5 * (sigma_samples * frequency) ** 2)
    spectrum = np.fft.rfft(points, axis=0) * gain[:, None]
    return np.asarray(np.fft.irfft(spectrum, len(points), axis=0))


def resample_closed(points: Floats, spacing_m: float) -> Floats:
    """Evenly spaced points on the closed polyline, starting at its first point."""
    closed = np.concatenate([points, points[:1]])
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    count = max(8, round(float(s[-1]) / spacing_m))
    at = np.arange(count) * (s[-1] / count)
    return np.column_stack([np.interp(at, s, closed[:, 0]), np.interp(at, s, closed[:, 1])])


def _arc(start: Floats, direction: Floats, turn: float, radius: float) -> Floats:
    """Points from ``start`` along an arc that turns by ``turn`` [rad], a few mm apart."""
    count = max(2, int(np.ceil(abs(turn) * radius / 0.005)))
    angle = np.linspace(0.0, turn, count)
    left = np.array([-direction[1], direction[0]])
    sign = np.sign(turn) if turn else 1.0
    forward, sideways = radius * np.sin(np.abs(angle)), radius * (1 - np.cos(angle))
    return np.asarray(start + forward[:, None] * direction + sign * sideways[:, None] * left)


def smooth(points: Floats, right: Floats, left: Floats) -> tuple[Floats, Floats, Floats]:
    """Evenly spaced points (m, 2) of a smooth closed curve along measured ones (n, 2) in driving
    order, and the widths (m,) there, linear between those given (n,).

    The periodic smoothing spline over the points' numbers, as a filter; how smooth it is follows
    from the points alone, by generalised cross-validation (Craven and Wahba 1979).
    """
    count = len(points)
    spectrum = np.fft.fft(points[:, 0] + 1j * points[:, 1])
    bend = (2 - 2 * np.cos(2 * np.pi * np.arange(count) / count)) ** 2
    gains = 1 / (1 + _STRENGTHS[:, None] * bend)
    rest = np.sum((1 - gains) ** 2 * np.abs(spectrum) ** 2, axis=1)
    best = int(np.argmin(rest / (count - gains.sum(axis=1)) ** 2))
    filtered = np.fft.ifft(gains[best] * spectrum)
    curve = fit_arc_length(np.column_stack([filtered.real, filtered.imag]))
    wanted = round(_NODES_A_WIDTH * curve.period / float(np.median(right + left)))
    nodes = min(count, max(wanted, _FEWEST))
    at = curve.knots[0] + np.arange(nodes) * (curve.period / nodes)
    knots = np.append(curve.knots, curve.knots[0] + curve.period)
    widths = (np.interp(at, knots, np.append(side, side[0])) for side in (right, left))
    return curve(at), *widths
