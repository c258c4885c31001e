"""Where tracks come from: built-in names, ``random:SEED``, ``random10:SEED``, and CSV files.

The built-in circuits are polygons with rounded corners: circuits.toml. Any seed gives a valid
random circuit, the same one everywhere: a random patch of square cells is grown, mostly a tree of
cells one wide; the way around it is a closed loop with hairpins at the ends of branches and bends
both ways where they join. Its corners are moved a little and rounded. Files have the form the TUM
and F1TENTH communities use, ``x_m, y_m, w_tr_right_m, w_tr_left_m``, one row per centreline point;
the first may be repeated at the end. tables.py has what all CSV files may look like.
"""

import re
import tomllib
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.tracks.checks import (
    Fault,
    clearance_m,
    default_car_width_m,
    find_crossing,
    find_fault,
    find_scale_fault,
    find_value_fault,
)
from bayesrace.tracks.spline import Corner, rounded_polygon, smooth
from bayesrace.tracks.tables import read_table, write_table
from bayesrace.tracks.track import Track, drop_repeated

if TYPE_CHECKING:
    from bayesrace.tracks.maps import RosMap

__all__ = [
    "DEFAULT_RACE_TRACK",
    "DEFAULT_TRAINING_TRACK",
    "builtin_tracks",
    "is_random_track",
    "load_any",
    "load_track",
    "random_track",
    "read_recentred",
    "read_smoothed",
    "read_track",
    "wide_enough",
    "write_track",
]

DEFAULT_TRAINING_TRACK: Final = "paddock"
DEFAULT_RACE_TRACK: Final = "harbour"

_COLUMNS: Final = ("x_m", "y_m", "w_tr_right_m", "w_tr_left_m")
_CIRCUITS: Final = Path(__file__).with_name("circuits.toml")
_MAPS: Final = (".yaml", ".yml")

RANDOM_TRACKS: Final = {"random": 1.0, "random10": 4.3}
"""How much larger each kind of circuit is than those for 1:43 cars: the second is for 1:10 cars."""

_RANDOM: Final = re.compile(rf"({'|'.join(RANDOM_TRACKS)}):[0-9]{{1,18}}")

Cell = tuple[int, int]

# Of random circuits for 1:43 cars:
_WALL_M: Final = 0.05  # least clear space between the edges of neighbouring pieces
_LENGTH_M: Final = (11.0, 18.0)
_WIDTH_M: Final = (0.37, 0.46)
_JITTER: Final = 0.14  # how far corners move, in cells
_GRID: Final = (6, 4)  # cells in x and y
_COMPASS: Final = ((1, 0), (0, 1), (-1, 0), (0, -1))


def builtin_tracks() -> tuple[str, ...]:
    """Names of the built-in tracks, for :func:`load_track`."""
    return tuple(sorted(_circuits()))


@cache
def _circuits() -> dict[str, Any]:
    return tomllib.loads(_CIRCUITS.read_text("utf-8"))


@cache
def _builtin_track(name: str) -> Track:
    circuit = _circuits()[name]
    scale, width_m = circuit["scale"], circuit["width_m"]
    points = rounded_polygon(circuit["corners"], 0.04 * scale, 0.05 * scale)
    if points is None:
        raise AssertionError(f"the corners of built-in track '{name}' overlap")
    spacing = float(np.linalg.norm(points[1] - points[0]))
    points = np.roll(points, round(circuit["start_m"] / spacing), axis=0)
    return Track.from_points(name, points, width_m / 2, width_m / 2)


def is_random_track(name: str) -> bool:
    """Whether the name is that of a generated circuit: ``random:SEED`` or ``random10:SEED``."""
    return _RANDOM.fullmatch(name) is not None


def load_track(name_or_path: str | Path, car_width_m: float | None = None) -> Track:
    """The built-in track of that name, ``random:SEED`` or ``random10:SEED`` (for 1:43 and 1:10
    cars), or the track in that CSV file.

    ``car_width_m``: least width of a track from a file; default: the default car's. Raises
    InputError saying what there is instead.
    """
    text = str(name_or_path)
    if text in builtin_tracks():
        return wide_enough(_builtin_track(text), car_width_m)
    kind, colon, seed = text.partition(":")
    if colon and kind in RANDOM_TRACKS:
        if not is_random_track(text):
            raise InputError(
                f"'{text[:40]}': the seed must be a whole number from 0 on, of at most 18 digits, "
                "as in random:7"
            )
        return wide_enough(random_track(int(seed), kind), car_width_m)
    path = Path(name_or_path)
    if not path.is_file():
        raise InputError(
            f"no track '{text}': neither a file nor built in; "
            f"built in: {', '.join(builtin_tracks())}, random:SEED, random10:SEED (1:10)"
        )
    if path.suffix in _MAPS:
        raise InputError(
            f"{text} is a map: 'bayesrace tracks {text} --out track.csv --picture track.svg' makes "
            "a track of it, and a picture to check it by"
        )
    return read_track(path, car_width_m)


def load_any(
    name: str, car_width_m: float | None, smoothed: bool = False, recentred: bool = False
) -> "tuple[Track, RosMap | None, str]":
    """:func:`load_track`, or the track in a ROS map or in a file of measured points; the map that
    it was found in, and what was done to the points. InputError as for ``bayesrace tracks``."""
    is_map = Path(name).suffix in _MAPS
    if smoothed and recentred:
        raise InputError("--recentre and --smooth are a step each: smooth the file of the first")
    if (smoothed or recentred) and (is_map or not Path(name).is_file()):
        option = "--smooth" if smoothed else "--recentre"
        raise InputError(f"{option} is for a CSV file of measured points, not for '{name}'")
    if is_map:
        from bayesrace.tracks.maps import read_map, track_of_map  # with packages for pictures

        grid = read_map(name)
        return track_of_map(grid, car_width_m), grid, ""
    if smoothed:
        track, away_m = read_smoothed(name, car_width_m)
        rms_mm, largest_mm = 1e3 * np.sqrt(np.mean(away_m**2)), 1e3 * away_m.max()
        away = f"{rms_mm:.1f} mm (RMS) and at most {largest_mm:.1f} mm away"
        return track, None, f"{len(away_m)} points are {away} from the smooth centreline"
    if recentred:
        track, (x, y) = read_recentred(name, car_width_m)
        return track, None, f"the origin is at x = {float(x)}, y = {float(y)} of the file"
    return load_track(name, car_width_m), None, ""


def wide_enough(track: Track, car_width_m: float | None) -> Track:
    """The same track; raises InputError if it is narrower than the car."""
    width = float((track.width_right_m + track.width_left_m).min())
    car = default_car_width_m(car_width_m)
    if width < car:
        raise InputError(
            f"track '{track.name}' is {width:.3g} m wide, the car {car:.3g} m; "
            "choose a wider track or a smaller car"
        )
    return track


def read_track(path: Path | str, car_width_m: float | None = None) -> Track:
    """The track in a CSV file, named after the file.

    ``car_width_m``: the track must be at least as wide and of the car's scale; 0: of any scale;
    default: at least as wide as the default car, of any scale that is usual in metres. Raises
    InputError naming file, row (line number in the file) and remedy.
    """
    return _checked(Path(path), *_read_points(Path(path)), car_width_m)


def read_recentred(path: Path | str, car_width_m: float | None = None) -> tuple[Track, Floats]:
    """The same of a file with a map's coordinates, such as UTM's: the first point is the origin.

    And where that is in the file, (2,) [m].
    """
    points, right, left, rows = _read_points(Path(path))
    origin = points[:1].sum(axis=0)  # zero without a point
    return _checked(Path(path), points - origin, right, left, rows, car_width_m), origin


def _checked(
    path: Path, points: Floats, right: Floats, left: Floats, rows: list[int], width_m: float | None
) -> Track:
    _refuse(path, rows, find_fault(points, right, left, default_car_width_m(width_m)))
    if width_m != 0:
        _refuse(path, rows, find_scale_fault(points, right, left, width_m))
    return Track._from_checked(path.stem, points, right, left)


def read_smoothed(path: Path | str, car_width_m: float | None = None) -> tuple[Track, Floats]:
    """The track in a CSV file of points that were measured with noise, which is taken off; and how
    far each point is from the smooth centreline, (n,) [m].

    Raises InputError like :func:`read_track`, and where the smooth centreline is no track.
    """
    path = Path(path)
    points, right, left, rows = _read_points(path)
    least_m = default_car_width_m(car_width_m)
    moved = (points != np.roll(points, 1, axis=0)).any(axis=1)  # a logger that stood repeats itself
    distinct = points[moved], right[moved], left[moved]
    fault = find_value_fault(*distinct, least_m)
    _refuse(
        path,
        [row for row, kept in zip(rows, moved.tolist(), strict=False) if kept],
        fault or find_scale_fault(*distinct, car_width_m),
    )
    smoothed = smooth(*distinct)
    if find_fault(*smoothed, least_m) is not None:
        raise InputError(
            f"{path}: even smoothed, the centreline crosses itself or turns back; give the points "
            "of one lap in driving order"
        )
    track = Track._from_checked(path.stem, *smoothed)
    away_m = np.abs(track.project_points(points).n_m)
    if (outlier := away_m > right + left).any():
        first = int(np.argmax(outlier))
        raise InputError(
            f"{path}, row {rows[first]}: the point is {away_m[first]:.3g} m from the smooth "
            "centreline, farther than the track is wide; leave it out"
        )
    return track, away_m


def _read_points(path: Path) -> tuple[Floats, Floats, Floats, list[int]]:
    """Points (n, 2), widths to the right and to the left (n,), number of each row."""
    table, rows, _ = read_table(path, _COLUMNS)
    return *drop_repeated(table[:, :2], table[:, 2], table[:, 3]), rows


def _refuse(path: Path, rows: list[int], fault: Fault | None) -> None:
    if fault is not None:
        raise InputError(fault.text(str(path), "row", rows))


def write_track(path: Path | str, track: Track) -> None:
    """Writes the nodes of a track; reading the file gives the same numbers."""
    nodes = np.column_stack([track.x_m, track.y_m, track.width_right_m, track.width_left_m])
    write_table(path, _COLUMNS, nodes, separator=",")


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
