"""Nearest points on a closed spline: over all of it, or along the piece one is on."""

from functools import cached_property

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.tracks.spline import PlaneSpline

__all__ = ["CentrelineSearch"]

_CHUNK = 256  # query points per distance matrix, bounds its memory
_MAX_SAMPLES = 20_000


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

    def descend(self, points: Floats, s_guess: float) -> Floats:
        """Foot point (1,) of one point (1, 2) on the piece around ``s_guess``."""
        start = round(s_guess / self._step) % self._count
        sample = self._walk(float(points[0, 0]), float(points[0, 1]), start)
        return self._refine(points, np.array([sample]))

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
        return self._refine(points, samples)

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
