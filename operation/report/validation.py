"""Weights on a drive: error with its 95 % band, and the track where they are uncertain."""

from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from bayesrace.arrays import Floats
from bayesrace.gp.weights import OUTPUTS, UNITS
from bayesrace.tracks import Track
from learning.dataset import Dataset
from learning.validation import Validation, unbroken
from operation.report.bands import BAND, draw_band, mark_uncertain
from operation.report.maps import draw_edges
from operation.report.style import INK, MUTED, PICTURE_WIDTH, WARNING
from operation.terminal.notation import SYMBOLS

__all__ = ["band_figure", "track_figure"]


_MEAN: Final = "#0072B2"
_MARGIN_M: Final = 0.12


def band_figure(validation: Validation, step_s: float, threshold: float) -> Figure:
    """The paper's figure, one row an output: left, the nominal model's error and its prediction.

    Right, what the correction leaves, at its own scale. Marks below: largest sigma > ``threshold``.
    """
    figure = Figure(figsize=(PICTURE_WIDTH, 6.4))
    grid = figure.subplots(len(OUTPUTS), 2, sharex=True, squeeze=False)
    time_s: Floats = np.arange(len(validation.sigma), dtype=np.float64) * step_s
    marked = validation.uncertain(threshold)
    nothing = np.zeros(len(time_s))
    for row, output in enumerate(OUTPUTS):
        mean, half = validation.mean[:, row], validation.band[:, row]
        before, after = grid[row]
        _draw(before, time_s, validation.residual[:, row], mean, half)
        _draw(after, time_s, validation.error[:, row], nothing, half)
        for axes in (before, after):
            mark_uncertain(axes, time_s, marked)
        before.set_ylabel(f"{SYMBOLS[output]} error [{UNITS[output]}]")
        metrics = validation.metrics[output]
        before.set_title(
            f"RMSE without GP {metrics['uncorrected_rmse']:.3g} {UNITS[output]}",
            fontsize=7.6, color=MUTED, loc="right",
        )  # fmt: skip
        after.set_title(
            f"RMSE {metrics['rmse']:.3g} {UNITS[output]} · R² {metrics['r2']:.4f}"
            f" · coverage {metrics['coverage']:.2f}",
            fontsize=7.6, color=MUTED, loc="right",
        )  # fmt: skip
    grid[0, 0].set_title("nominal model", fontsize=9.5, weight="bold")
    grid[0, 1].set_title("after the correction", fontsize=9.5, weight="bold")
    for axes in grid[-1]:
        axes.set_xlabel("samples, as time driven [s]")
        axes.set_xlim(0, max(float(time_s[-1]), step_s))
    figure.align_ylabels(list(grid[:, 0]))
    figure.subplots_adjust(left=0.07, right=0.99, top=0.9, bottom=0.075, hspace=0.3, wspace=0.14)
    figure.legend(handles=_marks(threshold), loc="upper center", ncols=4)
    return figure


def _draw(axes: Axes, time_s: Floats, error: Floats, mean: Floats, half: Floats) -> None:
    """Error, prediction and its band; where the band is widest it may leave the picture."""
    draw_band(axes, time_s, mean, half)
    axes.plot(time_s, mean, color=_MEAN, linewidth=0.9)
    axes.plot(time_s, error, color=INK, linewidth=0.7)
    low = min(float(error.min()), float(np.percentile(mean - half, 1)))
    high = max(float(error.max()), float(np.percentile(mean + half, 99)))
    room = 0.08 * (high - low) or 1.0
    axes.set_ylim(low - room, high + room)


def _marks(threshold: float) -> list[Line2D | Patch]:
    return [
        Line2D([], [], color=INK, linewidth=1, label="driven minus predicted"),
        Line2D([], [], color=_MEAN, linewidth=1, label="the GP's mean"),
        Patch(color=BAND, label="95 % band predicted"),
        Line2D(
            [], [], color=WARNING, marker="|", linestyle="", label=f"largest sigma > {threshold:g}"
        ),
    ]


def track_figure(
    dataset: Dataset, validation: Validation, threshold: float, track: Track | None = None
) -> Figure:
    """Where the car was, in red where the largest sigma is above ``threshold`` (paper's figure)."""
    xy = dataset.x[:, :2]
    corners = xy
    figure = Figure(figsize=(PICTURE_WIDTH * 0.72, 6.4))
    axes = figure.subplots()
    if track is not None:
        right, left = track.boundaries(0.04)
        corners = np.concatenate([xy, right, left])
        draw_edges(axes, right, left)
    uncertain = validation.uncertain(threshold)
    segments = np.stack([xy, dataset.x_next[:, :2]], axis=1)
    for rows, colour, width, order in (
        (~uncertain, INK, 1.0, 3),
        (uncertain, WARNING, 2.6, 4),
    ):
        axes.add_collection(
            LineCollection(
                list(segments[rows]), color=colour, linewidth=width, capstyle="round", zorder=order
            )
        )
    breaks = len(dataset) - 1 - len(unbroken(dataset, 2))
    low, high = corners.min(axis=0) - _MARGIN_M, corners.max(axis=0) + _MARGIN_M
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    axes.set(xlabel="x [m]", ylabel="y [m]")
    axes.set_title(
        f"{int(uncertain.sum())} of {len(dataset)} samples with largest sigma > {threshold:g}"
        + (f" · {breaks} breaks in the drive" if breaks else "")
    )
    marks = [
        Line2D([], [], color=INK, linewidth=1, label="driven"),
        Line2D([], [], color=WARNING, linewidth=2.6, label=f"largest sigma > {threshold:g}"),
    ]
    axes.legend(handles=marks, loc="best")
    figure.subplots_adjust(left=0.08, right=0.98, top=0.94, bottom=0.08)
    return figure
