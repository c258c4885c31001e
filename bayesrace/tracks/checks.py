"""What makes a list of points a track, and which point breaks it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bayesrace.tracks.spline import FloatArray

__all__ = ["MIN_POINTS", "Fault", "clearance_m", "find_crossing", "find_fault"]

MIN_POINTS = 8
"""Fewer points don't describe a circuit: the spline through them would be a guess."""

_DUPLICATE_M = 1e-6
_CHUNK = 512


@dataclass(frozen=True)
class Fault:
    """One reason why points are no track; ``index`` and ``other`` count from 0."""

    index: int | None
    what: str
    remedy: str
    other: int | None = None

    def text(self, source: str, word: str, rows: Sequence[int]) -> str:
        """One line naming the source, the row (as ``rows`` numbers them) and the remedy."""
        place = "" if self.index is None else f", {word} {rows[self.index]}"
        other = "" if self.other is None else f" {word} {rows[self.other]}"
        return f"{source}{place}: {self.what}{other}; {self.remedy}"


def find_fault(
    points: FloatArray, right: FloatArray, left: FloatArray, min_width_m: float
) -> Fault | None:
    """The first fault of points (n, 2) with widths (n,), None if they make a track.

    ``min_width_m``: the least width, right plus left, normally that of the car.
    """
    if len(points) < MIN_POINTS:
        return Fault(
            None,
            f"too few points ({len(points)})",
            f"a closed centreline needs at least {MIN_POINTS}",
        )
    finite = np.isfinite(points).all(axis=1) & np.isfinite(right) & np.isfinite(left)
    if not finite.all():
        return Fault(
            int(np.argmin(finite)),
            "a value is not finite",
            "give every coordinate and width as a finite number in metres",
        )
    return _find_width_fault(right, left, min_width_m) or _find_shape_fault(points)


def _find_width_fault(right: FloatArray, left: FloatArray, min_width_m: float) -> Fault | None:
    negative = (right < 0) | (left < 0)
    if negative.any():
        return Fault(
            int(np.argmax(negative)),
            "a width is negative",
            "both widths count from the centreline outwards",
        )
    total = right + left
    narrow = (total < min_width_m) | (total <= 0)
    if narrow.any():
        index = int(np.argmax(narrow))
        return Fault(
            index,
            f"the track is {total[index]:.3g} m wide, the car {min_width_m:.3g} m",
            "widen the track there, check that widths are in metres, or choose a smaller car",
        )
    return None


def _find_shape_fault(points: FloatArray) -> Fault | None:
    edge = np.roll(points, -1, axis=0) - points
    length = np.linalg.norm(edge, axis=1)
    if (length < _DUPLICATE_M).any():
        first = int(np.argmax(length < _DUPLICATE_M))
        second = (first + 1) % len(points)
        return Fault(second, "the same point as", "remove one of the two", other=first)
    before = np.roll(edge, 1, axis=0)
    cosine = np.sum(edge * before, axis=1) / (length * np.roll(length, 1))
    if (cosine < -0.999).any():
        return Fault(
            int(np.argmax(cosine < -0.999)),
            "the centreline turns back on itself",
            "give the points in driving order",
        )
    crossing = find_crossing(points)
    if crossing is not None:
        return Fault(
            crossing[1],
            "the centreline crosses itself: the edge from here meets the one from",
            "give the points in driving order; bridges are not supported",
            other=crossing[0],
        )
    return None


def find_crossing(points: FloatArray) -> tuple[int, int] | None:
    """First pair (i, j), i < j, of edges of the closed polygon (n, 2) that meet; None if none."""
    count = len(points)
    following = np.roll(points, -1, axis=0)
    middle = (points + following) / 2
    longest = float(np.max(np.linalg.norm(following - points, axis=1)))
    for start in range(0, count, _CHUNK):
        rows = slice(start, start + _CHUNK)
        near = _squared(middle[rows], middle) <= longest**2
        i, j = np.nonzero(near)
        i += start
        apart = (j > i + 1) & ~((i == 0) & (j == count - 1))  # neighbours share a point
        i, j = i[apart], j[apart]
        hit = _edges_meet(points[i], following[i], points[j], following[j])
        if hit.any():
            first = int(np.argmax(hit))
            return int(i[first]), int(j[first])
    return None


def clearance_m(points: FloatArray, skip_m: float) -> float:
    """Least distance between points (n, 2) of a closed curve that are > skip_m apart along it."""
    length = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    s = np.concatenate([[0.0], np.cumsum(length[:-1])])
    total = float(length.sum())
    gap = np.abs(s[:, None] - s)
    far = np.minimum(gap, total - gap) > skip_m
    squared = np.where(far, _squared(points, points), np.inf)
    return float(np.sqrt(squared.min()))


def _squared(a: FloatArray, b: FloatArray) -> FloatArray:
    """Squared distances (len(a), len(b))."""
    return np.asarray((a[:, :1] - b[:, 0]) ** 2 + (a[:, 1:] - b[:, 1]) ** 2)


def _edges_meet(
    a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray
) -> npt.NDArray[np.bool_]:
    """Whether edges a-b and c-d (each (m, 2)) meet, touching included."""

    def side(p: FloatArray, q: FloatArray, r: FloatArray) -> FloatArray:
        u, v = q - p, r - p
        return np.asarray(np.sign(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]))

    boxes = np.all(
        (np.minimum(a, b) <= np.maximum(c, d)) & (np.minimum(c, d) <= np.maximum(a, b)), axis=1
    )
    crosses = (side(a, b, c) * side(a, b, d) <= 0) & (side(c, d, a) * side(c, d, b) <= 0)
    return np.asarray(boxes & crosses)
