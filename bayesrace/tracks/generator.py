"""Random circuits from a seed: any seed gives a valid track, the same one everywhere.

A random patch of square cells is grown, mostly a tree of cells one wide; the way around it is a
closed loop with hairpins at the ends of branches and bends both ways where they join. Its corners
are moved a little and rounded.
"""

from typing import Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.tracks.checks import clearance_m, find_crossing
from bayesrace.tracks.spline import Corner, rounded_polygon
from bayesrace.tracks.track import Track

__all__ = ["RANDOM_TRACKS", "random_track"]

RANDOM_TRACKS: Final = {"random": 1.0, "random10": 4.3}
"""How much larger each kind of circuit is than those for 1:43 cars: the second is for 1:10 cars."""

Cell = tuple[int, int]

_WALL_M: Final = 0.05  # least clear space between the edges of neighbouring pieces
_LENGTH_M: Final = (11.0, 18.0)
_WIDTH_M: Final = (0.37, 0.46)
_JITTER: Final = 0.14  # how far corners move, in cells
_GRID: Final = (6, 4)  # cells in x and y
_COMPASS: Final = ((1, 0), (0, 1), (-1, 0), (0, -1))


def random_track(seed: int, kind: str = "random") -> Track:
    """Circuit of 11 to 18 m, 0.37 to 0.46 m wide, with hairpins and bends both ways; ``kind``: one
    of :data:`RANDOM_TRACKS`, which have the same shapes.

    Candidates are drawn until one keeps clear of itself. Raises InputError for a negative seed.
    """
    name, larger = f"{kind}:{seed}", RANDOM_TRACKS[kind]
    if seed < 0:
        raise InputError(f"{name}: the seed is negative; give a whole number from 0 on")
    rng = np.random.default_rng(seed)
    width = round(float(rng.uniform(*_WIDTH_M)), 3)
    points = None
    while points is None:  # two of five candidates are good
        points = _candidate(rng, width)
    return Track.from_points(name, larger * points, larger * width / 2, larger * width / 2)


# Quoted: numpy loads np.random, 2 MB, when it is named, and a controller has no use for it.
def _candidate(rng: "np.random.Generator", width: float) -> Floats | None:
    """One circuit, or None if its corners don't fit or it doesn't keep clear of itself."""
    outline = _outline(_grow(rng, int(rng.integers(7, 13))))
    if outline is None:
        return None
    cell = width + _WALL_M + float(rng.uniform(0.14, 0.40))
    xy = cell * (np.array(outline, dtype=float) + rng.uniform(-_JITTER, _JITTER, (len(outline), 2)))
    if rng.random() < 0.5:
        xy = xy * [1.0, -1.0]  # driven the other way round
    xy -= xy.mean(axis=0)
    corners = _with_radii(rng, xy, width)
    if corners is None:
        return None
    edge = np.linalg.norm(np.diff(np.append(xy, xy[:1], axis=0), axis=0), axis=1)
    longest = int(np.argmax(edge))
    corners = corners[longest + 1 :] + corners[: longest + 1]
    points = rounded_polygon(corners)
    if points is None or not _is_good(points, width):
        return None
    spacing = float(np.linalg.norm(points[1] - points[0]))
    return np.roll(points, round(0.3 * float(edge[longest]) / spacing), axis=0)


def _grow(rng: "np.random.Generator", size: int) -> set[Cell]:
    """``size`` joined cells, most of them in branches one cell wide."""
    cells: set[Cell] = {(int(rng.integers(_GRID[0])), int(rng.integers(_GRID[1])))}
    for _ in range(60 * size):
        if len(cells) == size:
            break
        x, y = sorted(cells)[int(rng.integers(len(cells)))]
        dx, dy = _COMPASS[int(rng.integers(4))]
        new = (x + dx, y + dy)
        if new in cells or not (0 <= new[0] < _GRID[0] and 0 <= new[1] < _GRID[1]):
            continue
        touching = sum((new[0] + i, new[1] + j) in cells for i, j in _COMPASS)
        if touching == 1 or rng.random() < 0.15:
            cells.add(new)
    return cells


def _outline(cells: set[Cell]) -> list[Cell] | None:
    """Corners of the way around the cells, anticlockwise; None if it isn't one simple loop."""
    following: dict[Cell, Cell] = {}
    edges = 0
    for x, y in sorted(cells):
        around = ((x, y), (x + 1, y), (x + 1, y + 1), (x, y + 1))
        for side, (dx, dy) in enumerate(((0, -1), (1, 0), (0, 1), (-1, 0))):
            if (x + dx, y + dy) not in cells:
                following[around[side]] = around[(side + 1) % 4]
                edges += 1
    if len(following) < edges:
        return None  # two cells touch at a corner only
    loop = [next(iter(following))]
    while (after := following[loop[-1]]) != loop[0]:
        loop.append(after)
    if len(loop) < edges:
        return None  # there is a hole
    return [
        here
        for before, here, after in zip(
            loop[-1:] + loop[:-1], loop, loop[1:] + loop[:1], strict=True
        )
        if (here[0] - before[0], here[1] - before[1]) != (after[0] - here[0], after[1] - here[1])
    ]


def _with_radii(rng: "np.random.Generator", xy: Floats, width: float) -> list[Corner] | None:
    """Corners rounded as far as their edges allow, at random; None if one must be too tight."""
    out = np.roll(xy, -1, axis=0) - xy
    into = np.roll(out, 1, axis=0)
    length = np.linalg.norm(out, axis=1)
    turn = np.arctan2(into[:, 0] * out[:, 1] - into[:, 1] * out[:, 0], np.sum(into * out, axis=1))
    room = 0.49 * np.minimum(length, np.roll(length, 1))
    largest = room / np.maximum(np.tan(np.abs(turn) / 2), 0.1)
    smallest = width / 2 + 0.04
    if (largest < smallest).any():
        return None
    radius = rng.uniform(smallest, np.minimum(largest, 0.7))
    return [(float(x), float(y), float(r)) for (x, y), r in zip(xy, radius, strict=True)]


def _is_good(points: Floats, width: float) -> bool:
    """Whether length and bends are as promised and all pieces keep clear of one another."""
    edge = np.roll(points, -1, axis=0) - points
    step = np.linalg.norm(edge, axis=1)
    heading = np.arctan2(edge[:, 1], edge[:, 0])
    turn = np.abs(np.angle(np.exp(1j * (heading - np.roll(heading, 1)))))
    if not _LENGTH_M[0] <= float(step.sum()) <= _LENGTH_M[1]:
        return False
    if float(np.max(turn / step)) > 1.0 / (width / 2 + 0.02):
        return False
    # Round a half circle of diameter d the ends are pi / 2 d of way but only d apart.
    spacing = width + _WALL_M
    return find_crossing(points) is None and (
        clearance_m(points, skip_m=np.pi / 2 * spacing) >= spacing
    )
