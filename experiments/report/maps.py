"""Laps drawn on the track, coloured by speed."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from bayesrace.raceline import RaceLine
from bayesrace.tracks import Track
from experiments.analysis import DrivenRun
from experiments.report.style import INK, MUTED, PAGE_WIDTH, SURFACE, WARNING, look, speed_map

__all__ = ["draw_edges", "laps_on_track"]

Floats = NDArray[np.float64]

_MARGIN_M: Final = 0.12
_MOST_SEGMENTS: Final = 1500


def laps_on_track(runs: Sequence[DrivenRun], track: Track, line: RaceLine) -> Figure:
    """One panel a run, the same colour scale: its first lap, later ones as a thin line.

    Off-track samples are those that the result table counts; a run that did not finish a lap is
    shown until the car left out a piece of the track.
    """
    right, left = track.boundaries(0.04)
    edges = np.concatenate([right, left])
    low, high = edges.min(axis=0) - _MARGIN_M, edges.max(axis=0) + _MARGIN_M
    columns = 1 if len(runs) == 1 else 2
    rows = max(1, -(-len(runs) // columns))
    panel_width = (PAGE_WIDTH - 1.0) / columns
    panel_height = min(panel_width * float((high[1] - low[1]) / (high[0] - low[0])), 6.0)
    figure = Figure(figsize=(PAGE_WIDTH, rows * (panel_height + 0.42) + 0.35))
    grid = figure.subplots(rows, columns, squeeze=False)
    speed = Normalize(0.0, _top_speed(runs, line))
    for axes, run in zip(grid.flat, runs, strict=False):
        _draw_track(axes, track, line, right, left)
        _draw_run(axes, run, speed)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    for axes in grid.flat:
        axes.axis("off")
    height = figure.get_size_inches()[1]
    figure.subplots_adjust(
        left=0.005, right=0.915, bottom=0.35 / height, top=1 - 0.32 / height, wspace=0.03,
        hspace=0.42 / panel_height,
    )  # fmt: skip
    _draw_scale(figure, speed)
    return figure


def _top_speed(runs: Sequence[DrivenRun], line: RaceLine) -> float:
    speeds = [float(np.max(run.record.x[run.counted, 3], initial=0.0)) for run in runs]
    return max([*speeds, float(line.vx_mps.max())])


def draw_edges(axes: Axes, right: Floats, left: Floats) -> None:
    """The track as an area between its edges, each (n, 2)."""
    ring = np.concatenate([right, right[:1], left[:1], left[::-1]])
    axes.fill(ring[:, 0], ring[:, 1], color=SURFACE, linewidth=0)
    for edge in (right, left):
        closed = np.concatenate([edge, edge[:1]])
        axes.plot(closed[:, 0], closed[:, 1], color="#a3a39b", linewidth=0.7)


def _draw_track(axes: Axes, track: Track, line: RaceLine, right: Floats, left: Floats) -> None:
    draw_edges(axes, right, left)
    path = np.concatenate([line.xy_m, line.xy_m[:1]])
    thin = path[:: max(1, len(path) // 600)]
    axes.plot(thin[:, 0], thin[:, 1], color=INK, linewidth=0.5, linestyle=(0, (5, 3)))
    start = np.array([right[0], left[0]])
    axes.plot(start[:, 0], start[:, 1], color=INK, linewidth=1.8, solid_capstyle="butt")
    x, y, psi = track.start_pose()
    axes.annotate(
        "",
        (x + 0.28 * np.cos(psi), y + 0.28 * np.sin(psi)),
        (x + 0.03 * np.cos(psi), y + 0.03 * np.sin(psi)),
        arrowprops={"arrowstyle": "-|>", "color": INK, "linewidth": 0.8, "shrinkA": 0},
        zorder=6,
    )


def _draw_run(axes: Axes, run: DrivenRun, speed: Normalize) -> None:
    lap = run.shown()
    counted = run.counted if run.finished else lap
    everything = run.record.x[counted]
    axes.plot(everything[:, 0], everything[:, 1], color=MUTED, linewidth=0.6)
    x = run.record.x[lap][:: max(1, len(run.record.x[lap]) // _MOST_SEGMENTS)]
    if len(x) > 1:
        points = x[:, :2]
        segments = np.stack([points[:-1], points[1:]], axis=1)
        trace = LineCollection(
            list(segments), cmap=speed_map(), norm=speed, linewidth=2.4, capstyle="round"
        )
        trace.set_array((x[:-1, 3] + x[1:, 3]) / 2)
        axes.add_collection(trace)
    off = everything[run.off_track[counted]]
    axes.plot(
        off[:, 0], off[:, 1], "x", color=WARNING, markersize=3.6, markeredgewidth=0.9, zorder=5
    )
    appearance = look(run.controller)
    time = f"{run.laps.times_s[0]:.3f} s" if run.finished else "did not finish"
    axes.set_title(appearance.name, color=appearance.colour, fontsize=10.5, fontweight="bold")
    count = int(run.off_track.sum())
    axes.set_title(f"{time}  ·  {count} off track", loc="right", fontsize=9, color=INK)


def _draw_scale(figure: Figure, speed: Normalize) -> None:
    bar = figure.add_axes((0.935, 0.3, 0.012, 0.4))
    figure.colorbar(ScalarMappable(speed, speed_map()), cax=bar, label="speed vx [m/s]")
    bar.grid(False)
    for spine in bar.spines.values():
        spine.set_visible(False)
    marks = [
        Line2D([], [], color=INK, linewidth=0.7, linestyle=(0, (5, 3)), label="racing line"),
        Line2D([], [], color=MUTED, linewidth=0.8, label="later laps"),
        Line2D([], [], color=WARNING, marker="x", linestyle="", markersize=4, label="off track"),
        Line2D([], [], color=INK, linewidth=1.8, label="start line"),
    ]
    figure.legend(handles=marks, loc="lower left", ncols=4, labelcolor=MUTED)
