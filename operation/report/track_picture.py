"""A picture of a track to check it by: the map that it was made of, edges, centreline, start."""

from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import Affine2D

from bayesrace.errors import InputError
from bayesrace.files import write_whole
from bayesrace.tracks import Track
from bayesrace.tracks.maps import RosMap
from operation.report.canvas import inline_svg, write_png
from operation.report.style import INK, PICTURE_WIDTH, WARNING, figure_style

__all__ = ["check_picture", "write_picture"]

_SUFFIXES: Final = (".svg", ".png")
_EDGE: Final = "#0072B2"
_SHADES: Final = {"free": 255, "unknown": 200, "occupied": 90}


def check_picture(path: Path) -> None:
    """InputError, before the work, for a file that :func:`write_picture` does not write."""
    if path.suffix not in _SUFFIXES:
        raise InputError(f"cannot draw a track in {path}: name a file in {', '.join(_SUFFIXES)}")


def write_picture(path: Path, track: Track, grid: RosMap | None = None) -> None:
    """Draws a track, SVG or PNG by the suffix, over the map that it was made of."""
    check_picture(path)
    width_m = float(np.median(track.width_right_m + track.width_left_m))
    edges = track.boundaries(width_m / 12)
    low, high = (limit(np.concatenate(edges), axis=0) for limit in (np.min, np.max))
    low, high = low - width_m, high + width_m
    with figure_style():
        height = PICTURE_WIDTH * (high[1] - low[1]) / (high[0] - low[0])
        figure = Figure(figsize=(PICTURE_WIDTH, min(height, 2 * PICTURE_WIDTH)), layout="tight")
        axes = figure.add_subplot()
        if grid is not None:
            _draw_map(axes, grid)
        centre = track.position(np.linspace(0.0, track.length_m, len(edges[0])))
        axes.plot(centre[:, 0], centre[:, 1], color=WARNING, linewidth=0.8, label="centreline")
        for edge, label in zip(edges, ("edges", None), strict=True):
            closed = np.concatenate([edge, edge[:1]])
            axes.plot(closed[:, 0], closed[:, 1], color=_EDGE, linewidth=0.8, label=label)
        _draw_start(axes, track, width_m)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        axes.set(xlabel="x [m]", ylabel="y [m]", title=f"{track.name} · {track.length_m:.2f} m")
        axes.legend(loc="best")
        if path.suffix == ".png":
            write_png(figure, path)
        else:
            write_whole(path, inline_svg(figure))


def _draw_map(axes: Axes, grid: RosMap) -> None:
    known = np.where(grid.occupied, _SHADES["occupied"], _SHADES["unknown"])
    shade = np.where(grid.free, _SHADES["free"], known)
    rows, columns = len(shade), len(shade[0])
    x, y, yaw = grid.origin
    placed = Affine2D().scale(grid.resolution_m).rotate(yaw).translate(x, y)
    image = axes.imshow(
        shade, cmap="gray", vmin=0, vmax=255, extent=(0, columns, 0, rows), interpolation="none"
    )
    image.set_transform(placed + axes.transData)
    axes.grid(visible=False)


def _draw_start(axes: Axes, track: Track, width_m: float) -> None:
    """The start line, and an arrow in driving direction."""
    ends = np.stack([edge[0] for edge in track.boundaries()], axis=1)
    axes.plot(ends[0], ends[1], color=INK, linewidth=2.0, label="start")
    x, y, psi = track.start_pose()
    tip = x + width_m * np.cos(psi), y + width_m * np.sin(psi)
    axes.annotate("", tip, (x, y), arrowprops={"arrowstyle": "-|>", "color": INK}, zorder=6)
