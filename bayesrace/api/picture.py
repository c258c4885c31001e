"""A run, and a car on its track, as pictures."""

import math
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from numpy.typing import NDArray

from bayesrace.api.values import State
from bayesrace.arrays import Floats
from bayesrace.operation.look import look
from bayesrace.operation.report.maps import draw_edges, show_all
from bayesrace.operation.report.style import (
    INK,
    MUTED,
    PICTURE_WIDTH,
    WARNING,
    figure_style,
    speed_map,
)
from bayesrace.tracks import Track
from bayesrace.vehicles import Car

if TYPE_CHECKING:
    from bayesrace.api.runs import Run

__all__ = ["CarPicture", "run_figure"]

_PICTURE_PX: Final = 640


def run_figure(run: "Run") -> Figure:
    """The last whole lap, or all of a run without one: its place by speed; speed and inputs over
    the way."""
    rows = _last_lap(run)
    x, u, track = run.x[rows], run.u[rows.start : rows.stop - 1], run.driven.track
    on_track = run.driven.projected
    s_m = np.unwrap(on_track.s_m[rows], period=track.length_m)
    with figure_style():
        figure = Figure(figsize=(PICTURE_WIDTH, 5.2), layout="constrained")
        grid = figure.add_gridspec(3, 2, width_ratios=(1.25, 1))
        place = figure.add_subplot(grid[:, 0])
        edges = track.boundaries(0.04)
        draw_edges(place, *edges)
        _draw_way(figure, place, x[:, :2], np.hypot(x[:, 3], x[:, 4]))
        off = x[on_track.off_track_m[rows] > 0]
        if len(off):
            place.plot(off[:, 0], off[:, 1], "o", color=WARNING, markersize=3, label="off track")
            place.legend()
        show_all(place, np.concatenate([*edges, x[:, :2]]))
        laps = ", ".join(f"{one:.3f}" for one in run.laps)
        place.set_title(f"{track.name}: {laps} s" if laps else f"{track.name}: no lap finished")
        place.set(xlabel="x [m]", ylabel="y [m]")
        beside = [figure.add_subplot(grid[i, 1]) for i in range(3)]
        line, colour = run.line, look("bayesrace").colour
        around = np.interp(s_m, *_along(run), period=track.length_m)
        beside[0].plot(s_m, around, color=MUTED, linewidth=1, label="racing line")
        beside[0].plot(s_m, np.hypot(x[:, 3], x[:, 4]), color=colour, label="driven")
        beside[0].set(ylabel="speed [m/s]", ylim=(0, 1.1 * float(line.vx_mps.max())))
        beside[0].legend()
        beside[1].step(s_m[: len(u)], u[:, 0], color=INK, where="post")
        beside[1].set(ylabel=run.driven.car.drive.command)
        beside[2].plot(s_m, np.degrees(x[:, 6]), color=INK)
        beside[2].set(ylabel="steering [°]", xlabel="along the track [m]")
        for axes in beside[:2]:
            axes.tick_params(labelbottom=False)
    return figure


def _last_lap(run: "Run") -> slice:
    ends = (0, *run.driven.laps.after)
    return slice(ends[-2], ends[-1] + 1) if len(ends) > 1 else slice(0, len(run.x))


def _along(run: "Run") -> tuple[Floats, Floats]:
    """Places along the track where the racing line has points, in order, and its speeds there."""
    s_m = run.driven.track.project_path(run.line.xy_m).s_m
    order = np.argsort(s_m)
    return s_m[order], run.line.vx_mps[order]


def _draw_way(figure: Figure, axes: Axes, xy: Floats, speed: Floats) -> None:
    pieces = np.stack([xy[:-1], xy[1:]], axis=1)
    way = LineCollection(list(pieces), cmap=speed_map(), linewidths=2.2)
    way.set_array(speed[:-1])
    axes.add_collection(way)
    figure.colorbar(way, ax=axes, label="speed [m/s]", shrink=0.7)


class CarPicture:
    """The car on the track from above. The track is drawn once: a picture takes a millisecond."""

    def __init__(self, car: Car, track: Track) -> None:
        width_m = float(np.median(track.width_right_m + track.width_left_m))
        right, left = track.boundaries(width_m / 12)
        corners = np.concatenate([right, left])
        wide, tall = np.ptp(corners, axis=0) + 2 * width_m
        size = np.array([wide, tall]) * (_PICTURE_PX / 100 / max(wide, tall))
        figure = Figure(figsize=(size[0], size[1]), dpi=100)
        self._canvas = cast("Any", FigureCanvasAgg(figure))
        self._axes = figure.add_axes((0, 0, 1, 1))
        self._axes.axis("off")
        draw_edges(self._axes, right, left)
        self._axes.plot(*np.stack([right[0], left[0]], axis=1), color=INK, linewidth=1.8)
        show_all(self._axes, corners, width_m)
        along, across = car.length_m / 2, car.width_m / 2
        self._outline = np.array([[along, 0], [-along, across], [-along, -across]])
        self._car = Polygon(self._outline, color=WARNING, animated=True)
        self._axes.add_patch(self._car)
        self._canvas.draw()
        self._empty = self._canvas.copy_from_bbox(figure.bbox)

    def of(self, state: State) -> NDArray[np.uint8]:
        """Pixels (height, width, 3)."""
        cos, sin = math.cos(state.psi), math.sin(state.psi)
        turned = self._outline @ np.array([[cos, sin], [-sin, cos]])
        self._canvas.restore_region(self._empty)
        self._car.set_xy(turned + np.array([state.x, state.y]))
        self._axes.draw_artist(self._car)
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()
