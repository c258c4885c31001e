"""ROS maps as tracks: the free space of an occupancy grid gives centreline and widths.

A map is a YAML file and an image, as ``map_server`` and ``nav2_map_server`` write and read them.
The track is the one piece of free space that goes round an infield. Its centreline is where the
distances to the infield and to the outside are equal (the zero of their difference, between the
pixels), smoothed over a quarter of the width; the widths are those distances. A circle of the
width about a point of the centreline is free, so both edges are, too.
"""

from pathlib import Path
from typing import Any, Final, Literal, NamedTuple, Self

import numpy as np
import numpy.typing as npt
import yaml
from contourpy import contour_generator
from PIL import Image
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from scipy import ndimage

from bayesrace.arrays import Floats
from bayesrace.errors import InputError, faults_in
from bayesrace.files import read_text
from bayesrace.tracks.checks import default_car_width_m, find_fault
from bayesrace.tracks.spline import resample_closed, smooth_closed
from bayesrace.tracks.track import Track

__all__ = ["RosMap", "read_map", "track_of_map"]

Pixels = npt.NDArray[np.bool_]

_MOST_PIXELS: Final = 25_000_000
_MODES: Final = ("1", "L", "LA", "P", "RGB", "RGBA")
"""Pillow's names of images with at most 8 bits a channel."""
_SPECK: Final = 4
"""Pixels of the largest obstacle that is taken for noise of the mapping."""
_NODES_A_WIDTH: Final = 6
"""Nodes of the centreline in a width of the track."""
_SMOOTHING: Final = 0.25
"""Of the width: standard deviation of the filter along the centreline."""
_TOUCHING: Final = np.ones((3, 3), dtype=bool)
"""Walls join at corners of pixels; free space does not."""


class _Description(BaseModel):
    """The YAML file; other keys are ignored, as ROS ignores them."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    image: str = Field(min_length=1)
    resolution: float = Field(gt=0, description="size of a pixel [m]")
    origin: tuple[float, float, float]
    negate: bool
    occupied_thresh: float = Field(gt=0, le=1)
    free_thresh: float = Field(ge=0, lt=1)
    mode: Literal["trinary", "scale"] = "trinary"

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.free_thresh > self.occupied_thresh:
            raise ValueError("free_thresh is above occupied_thresh")
        return self


class RosMap(NamedTuple):
    """An occupancy grid; row 0 of the arrays is the image's top."""

    name: str
    free: Pixels
    occupied: Pixels
    """What is neither is unknown."""
    resolution_m: float
    origin: tuple[float, float, float]
    """x [m], y [m] of the lower left corner, and the grid's rotation about it [rad]."""

    def metres(self, points: Floats) -> Floats:
        """World coordinates (n, 2) of (column, row), counted from the top left pixel's centre."""
        x, y, yaw = self.origin
        right = (points[:, 0] + 0.5) * self.resolution_m
        up = (len(self.free) - 0.5 - points[:, 1]) * self.resolution_m
        cosine, sine = np.cos(yaw), np.sin(yaw)
        return np.column_stack([x + cosine * right - sine * up, y + sine * right + cosine * up])


def read_map(path: Path | str) -> RosMap:
    """The map that a YAML file describes.

    As ROS has it: a pixel is occupied with probability (255 - mean of its channels) / 255, with
    ``negate`` mean / 255; above ``occupied_thresh`` it is occupied, below ``free_thresh`` free,
    else unknown. Raises InputError naming file, field and remedy.
    """
    path = Path(path)
    remedy = "give the YAML file that map_server or nav2_map_server saved"
    try:
        content = yaml.safe_load(read_text(path, "the map", remedy))
        description = _Description.model_validate(content)
    except yaml.YAMLError as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"the map {path} is no YAML: {reason}; {remedy}") from None
    except ValidationError as error:
        raise InputError(
            f"the map {path}: {faults_in(error, 'the file', _Description)}; correct the file"
        ) from None
    picture = path.parent / description.image
    brightness = _brightness(picture, path)
    probability = brightness / 255 if description.negate else (255 - brightness) / 255
    return RosMap(
        path.stem,
        probability < description.free_thresh,
        probability > description.occupied_thresh,
        description.resolution,
        description.origin,
    )


def _brightness(picture: Path, source: Path) -> Floats:
    """Mean of the colour channels (rows, columns), 0 to 255; transparent pixels are in between."""
    try:
        with Image.open(picture) as image:
            if image.width * image.height > _MOST_PIXELS:
                raise InputError(
                    f"the map {source}: {picture} has {image.width} x {image.height} pixels, the "
                    f"most is {_MOST_PIXELS // 1_000_000} million; crop it, or make it coarser"
                )
            if image.mode not in _MODES:
                raise InputError(
                    f"the map {source}: {picture} has pixels of kind {image.mode}; save it with "
                    "8 bits a channel"
                )
            channels = np.asarray(image.convert("RGBA"), dtype=np.float64)
    except InputError:
        raise
    except Exception as error:  # Pillow raises whatever its decoders do
        raise InputError(
            f"the map {source}: its image {picture} cannot be read ({error}); put the image beside "
            "the YAML file, as its field 'image' names it"
        ) from None
    return np.where(channels[..., 3] > 0, channels[..., :3].mean(axis=2), 0.5 * 255)


def track_of_map(grid: RosMap, car_width_m: float | None = None) -> Track:
    """The track in a map, driven anticlockwise from where it is nearest to the frame's origin.

    ``car_width_m``: least width, by default that of the default car. Raises InputError where there
    is no loop, or more than one.
    """
    ring = _only_ring(grid)
    to_infield = ndimage.distance_transform_edt(~ring.infield)
    to_outside = ndimage.distance_transform_edt(~ring.outside)
    lines: Any = contour_generator(z=to_infield - to_outside).lines(0.0)
    points = max(lines, key=len)[:-1]  # it is the only one but for rounding
    width = 2.0 * float(np.median(_at(to_infield, points)))
    points = resample_closed(points, 1.0)
    once = smooth_closed(points, _SMOOTHING * width)
    # Twice the filtered line less the line filtered twice: bends stay where they are.
    points = 2.0 * once - smooth_closed(once, _SMOOTHING * width)
    points = resample_closed(points, max(width / _NODES_A_WIDTH, 1.0))
    xy = grid.metres(points + ring.corner)
    # The edge is half a pixel before the centre of the first pixel beyond it.
    right, left = ((_at(one, points) - 0.5) * grid.resolution_m for one in (to_outside, to_infield))
    fault = find_fault(xy, right, left, default_car_width_m(car_width_m))
    if fault is not None:
        where = "" if fault.index is None else _place(xy[fault.index])
        raise InputError(f"the map '{grid.name}'{where}: {fault.what}; {fault.remedy}")
    following = np.roll(xy, -1, axis=0)
    area = float(np.sum(xy[:, 0] * following[:, 1] - xy[:, 1] * following[:, 0]))
    if area > 0:
        return Track.from_points(grid.name, xy, right, left).driven_from((0.0, 0.0))
    clockwise = Track.from_points(grid.name, xy, left, right)
    return clockwise.driven_from((0.0, 0.0), reverse=True)


def _at(distance: Floats, points: Floats) -> Floats:
    """Values (n,) of an array between its pixels, at (column, row)."""
    return np.asarray(ndimage.map_coordinates(distance, points[:, ::-1].T, order=1))


def _place(xy: Floats) -> str:
    return f" at x = {xy[0]:.2f} m, y = {xy[1]:.2f} m"


class _Ring(NamedTuple):
    """A piece of free space that goes round something: what is not the track, in a part of the map.

    Specks belong to neither side.
    """

    infield: Pixels
    outside: Pixels
    corner: tuple[int, int]
    """Column and row, in the map, of the part's first pixel."""
    obstacles: list[tuple[float, float]]
    """What else the piece goes round: column and row, in the part."""


def _only_ring(grid: RosMap) -> _Ring:
    """The track's piece of free space."""
    if not grid.free.any():
        raise InputError(
            f"the map '{grid.name}' has no free pixel: check negate, free_thresh and its image"
        )
    pieces, _ = ndimage.label(grid.free)
    edge = (pieces[0], pieces[-1], pieces[:, 0], pieces[:, -1])
    is_open = {int(piece) for piece in np.unique(np.concatenate(edge))} - {0}
    rings = [
        ring
        for piece, part in enumerate(ndimage.find_objects(pieces), start=1)
        if piece not in is_open and (ring := _ring(pieces[part] == piece, part)) is not None
    ]
    if not rings:
        unknown = 1.0 - float(np.mean(grid.free | grid.occupied))
        gaps = ", but some is open to the image's edge: close the gaps of the walls"
        raise InputError(
            f"the map '{grid.name}' has no loop: no free space within walls goes round an infield"
            f"{gaps if is_open else ': paint infield and walls black'} "
            f"({100 * np.mean(grid.free):.0f} % of the pixels are free, {100 * unknown:.0f} % "
            "unknown, and unknown is no part of a track)"
        )
    if len(rings) > 1:
        raise InputError(
            f"the map '{grid.name}' has several loops: {len(rings)} pieces of free space go round "
            "something; paint all but the track black"
        )
    if rings[0].obstacles:
        others = rings[0].obstacles
        place = _place(grid.metres(np.array([others[0]]) + rings[0].corner)[0])
        raise InputError(
            f"the map '{grid.name}' has several loops: its free space goes round the infield and "
            f"{len(others)} more,{place}; paint what is on the track white, or join it to a wall"
        )
    return rings[0]


def _ring(piece: Pixels, part: Any) -> _Ring | None:
    """Of a piece of free space that fills this part of the map; None if it goes round nothing."""
    if piece.size < _SPECK**2:
        return None
    islands, count = ndimage.label(~np.pad(piece, 1), _TOUCHING)
    sizes = np.bincount(islands.ravel(), minlength=count + 1)
    outside = islands[0, 0]
    around = [k for k in range(1, count + 1) if k != outside and sizes[k] > _SPECK]
    if not around:
        return None
    infield = max(around, key=lambda label: sizes[label])
    others = ndimage.center_of_mass(islands > 0, islands, [k for k in around if k != infield])
    return _Ring(
        islands == infield,
        islands == outside,
        (part[1].start - 1, part[0].start - 1),
        [(float(column), float(row)) for row, column in others],
    )
