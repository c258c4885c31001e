"""Tracks: with laps by speed, or alone with the map that they were made of, to check them by."""

from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.transforms import Affine2D

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.files import write_whole
from bayesrace.operation.analysis.race import DrivenRun
from bayesrace.operation.look import look
from bayesrace.operation.report.style import (
    INK,
    MUTED,
    PANEL_WIDTH,
    PICTURE_WIDTH,
    SURFACE,
    WARNING,
    figure_style,
    inline_svg,
    speed_map,
    write_png,
)
from bayesrace.raceline import RaceLine
from bayesrace.tracks import Track

if TYPE_CHECKING:
    from bayesrace.tracks.maps import RosMap

__all__ = ["check_picture", "draw_edges", "lap_map", "show_all", "write_picture"]

_MARGIN_M: Final = 0.12
_SCALE: Final = 0.85
"""Beside a map, for its scale [inch]."""

_TITLE: Final = 0.45
"""Above a map [inch]."""

_SUFFIXES: Final = (".svg", ".png")
_EDGE: Final = "#0072B2"
_SHADES: Final = {"free": 255, "unknown": 200, "occupied": 90}


def lap_map(run: DrivenRun, track: Track, line: RaceLine) -> Figure:
    """The first lap of a run on the track, coloured by speed; later laps as a thin line.

    Off-track samples are those that the result table counts; a run without a lap is shown until the
    car left out a piece of the track. Map and scale are at fixed places: a layout by what is drawn
    would draw everything twice.
    """
    fastest = float(np.max(run.record.x[run.counted, 3], initial=0.0))
    speed = Normalize(0.0, max(fastest, float(line.vx_mps.max())))
    edges = track.boundaries(0.04)
    corners = np.concatenate(edges)
    width, height = np.ptp(corners, axis=0) + 2 * _MARGIN_M
    wide = PANEL_WIDTH - _SCALE
    tall = min(wide * height / width, 6.0)
    size = PANEL_WIDTH, tall + _TITLE
    figure = Figure(figsize=size)

    def place(left: float, bottom: float, width: float, height: float) -> Axes:
        return figure.add_axes(
            (left / size[0], bottom / size[1], width / size[0], height / size[1])
        )

    axes = place(0.05, 0.05, wide, tall)
    axes.axis("off")
    draw_edges(axes, *edges)
    path = np.concatenate([line.xy_m, line.xy_m[:1]])
    thin = path[:: max(1, len(path) // 600)]
    axes.plot(thin[:, 0], thin[:, 1], color=INK, linewidth=0.5, linestyle=(0, (5, 3)))
    _draw_start(axes, track)
    counted = run.counted if run.finished else run.shown()
    everything = run.record.x[counted]
    axes.plot(everything[:, 0], everything[:, 1], color=MUTED, linewidth=0.6)
    points = run.record.x[run.shown(), :2]
    trace = LineCollection(
        list(np.stack([points[:-1], points[1:]], axis=1)), cmap=speed_map(), norm=speed,
        linewidth=2.4, capstyle="round",
    )  # fmt: skip
    speeds = run.record.x[run.shown(), 3]
    trace.set_array((speeds[:-1] + speeds[1:]) / 2)
    axes.add_collection(trace)
    off = everything[run.off_track[counted]]
    axes.plot(off[:, 0], off[:, 1], "x", color=WARNING, markersize=3.6, zorder=5)
    show_all(axes, corners)
    name, colour, _ = look(run.controller, run.number)
    time = f"{run.laps.times_s[0]:.3f} s" if run.finished else "did not finish"
    axes.set_title(name, color=colour, fontweight="bold")
    axes.set_title(f"{time} · {int(run.off_track.sum())} off track", loc="right", color=INK)
    scale = place(0.1 + wide, 0.05 + 0.2 * tall, 0.11, 0.6 * tall)
    bar = figure.colorbar(ScalarMappable(speed, speed_map()), cax=scale, label="speed vx [m/s]")
    bar.outline.set_visible(False)
    return figure


def _draw_start(axes: Axes, track: Track) -> None:
    """The start line, and an arrow in driving direction."""
    right, left = (edge[0] for edge in track.boundaries())
    axes.plot(*np.stack([right, left], axis=1), color=INK, linewidth=1.8, label="start")
    x, y, psi = track.start_pose()
    reach = 0.7 * float(np.linalg.norm(left - right))
    tip = x + reach * np.cos(psi), y + reach * np.sin(psi)
    arrow = {"arrowstyle": "-|>", "color": INK, "linewidth": 0.8, "shrinkA": 0}
    axes.annotate("", tip, (x, y), arrowprops=arrow, zorder=6)


def draw_edges(axes: Axes, right: Floats, left: Floats) -> None:
    """The track as an area between its edges, each (n, 2)."""
    ring = np.concatenate([right, right[:1], left[:1], left[::-1]])
    # An artist alone: as a patch it would be searched for its extent, which show_all sets.
    axes.add_artist(Polygon(ring, color=SURFACE, linewidth=0))
    for edge in (right, left):
        closed = np.concatenate([edge, edge[:1]])
        axes.plot(closed[:, 0], closed[:, 1], color="#a3a39b", linewidth=0.7)


def show_all(axes: Axes, points: Floats, margin_m: float = _MARGIN_M) -> None:
    """Limits both axes, at one scale, to these points (n, 2) and a margin."""
    low, high = points.min(axis=0) - margin_m, points.max(axis=0) + margin_m
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")


def check_picture(path: Path) -> None:
    """InputError, before the work, for a file that :func:`write_picture` does not write."""
    if path.suffix not in _SUFFIXES:
        raise InputError(f"cannot draw a track in {path}: name a file in {', '.join(_SUFFIXES)}")


def write_picture(path: Path, track: Track, grid: "RosMap | None" = None) -> None:
    """Draws a track, SVG or PNG by the suffix, over the map that it was made of."""
    check_picture(path)
    width_m = float(np.median(track.width_right_m + track.width_left_m))
    edges = track.boundaries(width_m / 12)
    points = np.concatenate(edges)
    width, height = np.ptp(points, axis=0) + 2 * width_m
    with figure_style():
        tall = PICTURE_WIDTH * min(height / width, 2.0)
        figure = Figure(figsize=(PICTURE_WIDTH, tall), layout="tight")
        axes = figure.add_subplot()
        if grid is not None:
            _draw_map(axes, grid)
        centre = track.position(np.linspace(0.0, track.length_m, len(edges[0])))
        axes.plot(centre[:, 0], centre[:, 1], color=WARNING, linewidth=0.8, label="centreline")
        for edge, label in zip(edges, ("edges", None), strict=True):
            closed = np.concatenate([edge, edge[:1]])
            axes.plot(closed[:, 0], closed[:, 1], color=_EDGE, linewidth=0.8, label=label)
        _draw_start(axes, track)
        show_all(axes, points, width_m)
        axes.set(xlabel="x [m]", ylabel="y [m]", title=f"{track.name} · {track.length_m:.2f} m")
        axes.legend(loc="best")
        if path.suffix == ".png":
            write_png(figure, path)
        else:
            write_whole(path, inline_svg(figure))


def _draw_map(axes: Axes, grid: "RosMap") -> None:
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
