"""Checks that a list of points is a track in metres; each names the point at fault."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bayesrace.arrays import Floats

__all__ = [
    "default_car_width_m",
    "MIN_POINTS",
    "Fault",
    "clearance_m",
    "find_crossing",
    "find_fault",
    "find_scale_fault",
    "find_value_fault",
]

MIN_POINTS = 8
"""Fewer points don't describe a circuit: the spline through them would be a guess."""

_DUPLICATE_M = 1e-6
_OPEN = 4.0
"""A gap between the last and the first point of more than this many times the longest other one."""
_MOST_CARS = 100.0
"""Cars side by side on the widest plausible track."""
_WIDEST_M, _NARROWEST_M = 25.0, 0.15
"""Plausible widths of tracks, from 1:43 to full scale."""
_MOST_WIDTHS = 2_500.0
"""Length of the longest plausible track over its width; the Nordschleife has 2,300."""
_FARTHEST_WIDTHS = 10_000.0
"""Largest coordinate over the track's width: controllers count positions from the origin."""
_SMOOTH = "smooth them ('bayesrace tracks FILE --smooth --out smooth.csv')"
_IN_ORDER = (
    "give the points in driving order; if they are measured and lie closer than their noise, "
    f"{_SMOOTH}"
)
_CORNERS = 50
"""So few points may be the corners of a polygon; more of them are taken for samples of a curve."""
_ZIGZAG_RAD, _ALTERNATING = 0.1, -0.25
"""A centreline zigzags if its turns from point to point exceed the first (RMS) and the correlation
of each turn with the next is below the second. Noise alone has a correlation of -2/3, published
tracks have 0.84 and more."""
_UNITS = {"millimetres": 1e3, "centimetres": 1e2}
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


def find_fault(points: Floats, right: Floats, left: Floats, min_width_m: float) -> Fault | None:
    """The first fault of points (n, 2) with widths (n,), None if they make a track.

    ``min_width_m``: the least width, right plus left, normally that of the car.
    """
    return find_value_fault(points, right, left, min_width_m) or next(_shape_faults(points), None)


def find_value_fault(
    points: Floats, right: Floats, left: Floats, min_width_m: float
) -> Fault | None:
    """:func:`find_fault` of what no smoothing mends: all but the shape."""
    return next(_value_faults(points, right, left, min_width_m), None)


def _value_faults(
    points: Floats, right: Floats, left: Floats, min_width_m: float
) -> Iterator[Fault]:
    """In this order; what is behind the first fault need not make sense."""
    if len(points) < MIN_POINTS:
        remedy = f"a closed centreline needs at least {MIN_POINTS}"
        yield Fault(None, f"too few points ({len(points)})", remedy)
    bad = ~(np.isfinite(points).all(axis=1) & np.isfinite(right) & np.isfinite(left))
    if bad.any():
        remedy = "give every coordinate and width as a finite number in metres"
        yield Fault(int(np.argmax(bad)), "a value is not finite", remedy)
    negative = (right < 0) | (left < 0)
    if negative.any():
        remedy = "both widths count from the centreline outwards"
        yield Fault(int(np.argmax(negative)), "a width is negative", remedy)
    total = right + left
    narrow = (total < min_width_m) | (total <= 0)
    if narrow.any():
        index = int(np.argmax(narrow))
        yield Fault(
            index,
            f"the track is {total[index]:.3g} m wide, the car {min_width_m:.3g} m",
            "widen the track there, check that widths are in metres, or choose a smaller car",
        )
    length = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    if length[-1] > _OPEN * length[:-1].max():
        yield Fault(
            None,
            f"the centreline is not closed: the last point is {length[-1]:.3g} m from the first, "
            f"other neighbours at most {length[:-1].max():.3g} m",
            "give the whole lap, up to the point before the first one",
        )


def _shape_faults(points: Floats) -> Iterator[Fault]:
    edge = np.roll(points, -1, axis=0) - points
    before, length = np.roll(edge, 1, axis=0), np.linalg.norm(edge, axis=1)
    if (length < _DUPLICATE_M).any():
        first = int(np.argmax(length < _DUPLICATE_M))
        second = (first + 1) % len(points)
        yield Fault(second, "the same point as", "remove one of the two", other=first)
    along = np.sum(edge * before, axis=1)
    back = along / (length * np.roll(length, 1)) < -0.999
    if back.any():
        yield Fault(int(np.argmax(back)), "the centreline turns back on itself", _IN_ORDER)
    crossing = find_crossing(points)
    if crossing is not None:
        what = "the centreline crosses itself: the edge from here meets the one from"
        remedy = f"{_IN_ORDER}; bridges are not supported"
        yield Fault(crossing[1], what, remedy, other=crossing[0])
    turn = np.arctan2(before[:, 0] * edge[:, 1] - before[:, 1] * edge[:, 0], along)
    variance = float(np.mean(turn**2))
    alternating = float(np.mean(turn * np.roll(turn, 1))) / max(variance, 1e-30)
    if len(edge) > _CORNERS and variance > _ZIGZAG_RAD**2 and alternating < _ALTERNATING:
        yield Fault(
            None,
            f"the centreline zigzags: it turns by {np.degrees(variance**0.5):.0f}° (RMS) to one "
            "side and the other from point to point",
            f"if the points are measured with noise, {_SMOOTH}",
        )


def find_scale_fault(
    points: Floats, right: Floats, left: Floats, car_width_m: float | None
) -> Fault | None:
    """Sizes of a track (n, 2), (n,) that fit no track in metres; None if they are plausible.

    Compares the median width with the car's; ``car_width_m`` None: with tracks of any scale.
    """
    width_m = float(np.median(right + left))
    length_m = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    size = f"the track is {length_m:.0f} m long and {width_m:.3g} m wide"
    if length_m > _MOST_WIDTHS * width_m:
        remedy = "x, y and the widths probably have different units; give all of them in metres"
        return Fault(None, size, remedy)
    farthest_m = float(np.abs(points).max())
    if farthest_m > _FARTHEST_WIDTHS * width_m:
        return Fault(
            None,
            f"the track is {farthest_m:.3g} m from the origin and {width_m:.3g} m wide",
            "make its first point the origin: 'bayesrace tracks FILE --recentre --out local.csv'",
        )
    narrowest_m, widest_m = _NARROWEST_M, _WIDEST_M
    if car_width_m is not None:
        narrowest_m, widest_m = car_width_m, _MOST_CARS * car_width_m
        size += f", {width_m / car_width_m:.0f} times the car"
    if width_m <= widest_m:
        return None
    units = [name for name, by in _UNITS.items() if narrowest_m < width_m / by < widest_m]
    probably = f"the values are probably in {' or '.join(units) or 'another unit'}"
    remedy = "" if car_width_m is None else ", or choose a car of the track's scale"
    return Fault(None, size, f"{probably}; give them in metres{remedy}")


def find_crossing(points: Floats) -> tuple[int, int] | None:
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


def clearance_m(points: Floats, skip_m: float) -> float:
    """Least distance between points (n, 2) of a closed curve that are > skip_m apart along it."""
    length = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    s = np.concatenate([[0.0], np.cumsum(length[:-1])])
    total = float(length.sum())
    gap = np.abs(s[:, None] - s)
    far = np.minimum(gap, total - gap) > skip_m
    squared = np.where(far, _squared(points, points), np.inf)
    return float(np.sqrt(squared.min()))


def _squared(a: Floats, b: Floats) -> Floats:
    """Squared distances (len(a), len(b))."""
    return np.asarray((a[:, :1] - b[:, 0]) ** 2 + (a[:, 1:] - b[:, 1]) ** 2)


def _edges_meet(a: Floats, b: Floats, c: Floats, d: Floats) -> npt.NDArray[np.bool_]:
    """Whether edges a-b and c-d (each (m, 2)) meet, touching included."""

    def side(p: Floats, q: Floats, r: Floats) -> Floats:
        u, v = q - p, r - p
        return np.asarray(np.sign(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]))

    boxes = np.all(
        (np.minimum(a, b) <= np.maximum(c, d)) & (np.minimum(c, d) <= np.maximum(a, b)), axis=1
    )
    crosses = (side(a, b, c) * side(a, b, d) <= 0) & (side(c, d, a) * side(c, d, b) <= 0)
    return np.asarray(boxes & crosses)


def default_car_width_m(car_width_m: float | None) -> float:
    """The given width, or that of the default car."""
    if car_width_m is not None:
        return car_width_m
    from bayesrace.vehicles import DEFAULT_CAR, get_car

    return get_car(DEFAULT_CAR).width_m
