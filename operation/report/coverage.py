"""Figures of what was driven before, of what a racing line asks for."""

import numpy as np
from matplotlib.figure import Figure

from bayesrace.learning.coverage import Coverage
from bayesrace.operation.report.maps import draw_edges, show_all
from bayesrace.operation.report.style import INK, MUTED, WARNING, panel
from bayesrace.raceline import RaceLine
from bayesrace.tracks import Track

__all__ = ["coverage_figures"]


def coverage_figures(known: Coverage, track: Track, line: RaceLine) -> list[Figure]:
    """By speed and lateral acceleration; and on the track, if anything was not driven before."""
    figures = [_by_speed(known)]
    return figures if known.near.all() else [*figures, _on_track(known, track, line)]


def _on_track(known: Coverage, track: Track, line: RaceLine) -> Figure:
    figure, axes = panel(2.6)
    edges = track.boundaries(0.04)
    draw_edges(axes, *edges)
    axes.plot(*line.xy_m.T, color=INK, linewidth=0.6)
    places = line.xy_m[~known.near].T
    axes.plot(*places, ".", color=WARNING, markersize=3, label="not driven before")
    show_all(axes, np.concatenate(edges))
    axes.axis("off")
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), markerscale=3)
    return figure


def _by_speed(known: Coverage) -> Figure:
    """Lateral acceleration over speed: of samples, and of the line."""
    figure, axes = panel(2.6)
    for points, colour, size, label in (
        (known.driven, MUTED, 2, "training and practice"),
        (known.asked[known.near], INK, 2, "racing line"),
        (known.asked[~known.near], WARNING, 4, "not driven before"),
    ):
        if len(points):
            axes.plot(*points.T, ".", color=colour, markersize=size, label=label, rasterized=True)
    reach = 1.5 * float(known.asked[:, 1].max())
    axes.set(xlabel="speed [m/s]", ylabel="lateral acceleration [m/s²]", ylim=(0, reach))
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3, markerscale=3, columnspacing=1)
    return figure
