"""Figures of what Gaussian processes predict: error with its 95 % band, track, kernels."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from bayesrace.arrays import Flags, Floats
from bayesrace.gp.weights import OUTPUTS, UNITS
from bayesrace.learning.dataset import Dataset
from bayesrace.learning.target import KernelScore
from bayesrace.learning.validation import Validation, unbroken
from bayesrace.operation.analysis.validation import Validated
from bayesrace.operation.report.maps import draw_edges, show_all
from bayesrace.operation.report.style import (
    INK,
    MUTED,
    PICTURE_WIDTH,
    WARNING,
    figure_style,
    look,
    panel,
    write_png,
)
from bayesrace.operation.terminal.notation import SMOOTHNESS, SYMBOLS, UNCERTAIN
from bayesrace.tracks import Track

__all__ = [
    "band_figure",
    "gp_figures",
    "kernel_figure",
    "track_figure",
    "write_kernels",
    "write_validation",
]

_BAND: Final = "#bcd7ea"
_MEAN: Final = "#0072B2"
_LAPS: Final = 2.0
"""Shown of the drive in a report."""


def gp_figures(
    validations: Mapping[str, Validation], distance_m: Floats, lap_m: float
) -> list[Figure]:
    """Error after the correction and its 95 % band, a panel for each output and weights.

    ``distance_m`` (n,): how far the car had come at each validated sample.
    """
    shown = distance_m <= _LAPS * lap_m
    x, figures = distance_m[shown], []
    for row, output in enumerate(OUTPUTS):
        for controller, validation in validations.items():
            figure, axes = panel(1.9)
            error, band = validation.error[:, row], validation.band[:, row]
            _draw(axes, x, error[shown], 0.0, band[shown], validation.uncertain(UNCERTAIN)[shown])
            axes.axvline(lap_m, color=MUTED, linewidth=0.7, linestyle=(0, (1, 2)))
            appearance = look(controller)
            axes.set_title(f"{SYMBOLS[output]} · {appearance.name}", color=appearance.colour)
            rmse = f"RMSE {validation.metrics[output]['rmse']:.2g} {UNITS[output]}"
            axes.set_title(rmse, loc="right", color=MUTED)
            # Nearly all is shown: single spikes would flatten everything else.
            limit = 1.15 * float(np.percentile(np.abs([error, band]), 99.5, axis=1).max()) or 1.0
            axes.set(xlim=(0, float(x.max(initial=lap_m))), ylim=(-limit, limit))
            axes.set_ylabel(f"{SYMBOLS[output]} error [{UNITS[output]}]")
            axes.set_xlabel("distance driven by BestCase [m]")
            figures.append(figure)
    return figures


def band_figure(validation: Validation, step_s: float, threshold: float) -> Figure:
    """The paper's figure, one row an output: left, the nominal model's error and its prediction.

    Right, what the correction leaves, at its own scale. Marks below: largest sigma > ``threshold``.
    """
    figure = Figure(figsize=(PICTURE_WIDTH, 6.4))
    grid = figure.subplots(len(OUTPUTS), 2, sharex=True, squeeze=False)
    time_s: Floats = np.arange(len(validation.sigma), dtype=np.float64) * step_s
    marked = validation.uncertain(threshold)
    for row, output in enumerate(OUTPUTS):
        mean, half = validation.mean[:, row], validation.band[:, row]
        unit, metrics = UNITS[output], validation.metrics[output]
        scores = f"RMSE {metrics['rmse']:.3g} {unit} · R² {metrics['r2']:.4f}"
        for axes, error, middle, text in (
            (grid[row, 0], validation.residual[:, row], mean,
             f"RMSE without GP {metrics['uncorrected_rmse']:.3g} {unit}"),
            (grid[row, 1], validation.error[:, row], np.zeros(len(mean)),
             f"{scores} · coverage {metrics['coverage']:.2f}"),
        ):  # fmt: skip
            _draw(axes, time_s, error, middle, half, marked)
            axes.plot(time_s, middle, color=_MEAN, linewidth=0.9, zorder=1.9)
            axes.set_title(text, fontsize=7.6, color=MUTED, loc="right")
            # Where the band is widest it may leave the picture.
            low = min(float(error.min()), float(np.percentile(middle - half, 1)))
            high = max(float(error.max()), float(np.percentile(middle + half, 99)))
            room = 0.08 * (high - low) or 1.0
            axes.set_ylim(low - room, high + room)
        grid[row, 0].set_ylabel(f"{SYMBOLS[output]} error [{unit}]")
    for axes, title in zip(grid[0], ("nominal model", "after the correction"), strict=True):
        axes.set_title(title, fontsize=9.5, weight="bold")
    for axes in grid[-1]:
        axes.set_xlabel("samples, as time driven [s]")
        axes.set_xlim(0, max(float(time_s[-1]), step_s))
    figure.align_ylabels(list(grid[:, 0]))
    figure.subplots_adjust(left=0.07, right=0.99, top=0.9, bottom=0.075, hspace=0.3, wspace=0.14)
    uncertain = f"largest sigma > {threshold:g}"
    marks = [
        Line2D([], [], color=INK, linewidth=1, label="driven minus predicted"),
        Line2D([], [], color=_MEAN, linewidth=1, label="the GP's mean"),
        Patch(color=_BAND, label="95 % band predicted"),
        Line2D([], [], color=WARNING, marker="|", linestyle="", label=uncertain),
    ]
    figure.legend(handles=marks, loc="upper center", ncols=4)
    return figure


def _draw(
    axes: Axes, x: Floats, error: Floats, mean: Floats | float, half: Floats, marked: Flags
) -> None:
    """Draws errors (n,) at ``x`` (n,) over the band of ``mean`` plus and minus ``half`` (n,).

    A tick at the bottom for each sample that is ``marked`` (n,).
    """
    axes.fill_between(x, mean - half, mean + half, color=_BAND, linewidth=0, rasterized=True)
    axes.plot(x, error, color=INK, linewidth=0.7)
    axes.plot(
        x[marked], np.full(int(marked.sum()), 0.015), "|", color=WARNING, markersize=5,
        markeredgewidth=0.8, transform=axes.get_xaxis_transform(),
    )  # fmt: skip


def track_figure(
    dataset: Dataset, validation: Validation, threshold: float, track: Track | None = None
) -> Figure:
    """Where the car was, in red where the largest sigma is above ``threshold`` (paper's figure)."""
    xy = dataset.x[:, :2]
    corners = [xy]
    figure = Figure(figsize=(PICTURE_WIDTH * 0.72, 6.4))
    axes = figure.subplots()
    if track is not None:
        edges = track.boundaries(0.04)
        corners += edges
        draw_edges(axes, *edges)
    uncertain = validation.uncertain(threshold)
    segments = np.stack([xy, dataset.x_next[:, :2]], axis=1)
    large = f"largest sigma > {threshold:g}"
    marks = []
    for rows, colour, width, order, label in (
        (~uncertain, INK, 1.0, 3, "driven"), (uncertain, WARNING, 2.6, 4, large),
    ):  # fmt: skip
        lines = LineCollection(list(segments[rows]), color=colour, linewidth=width, zorder=order)
        lines.set_capstyle("round")
        axes.add_collection(lines)
        marks.append(Line2D([], [], color=colour, linewidth=width, label=label))
    breaks = len(dataset) - 1 - len(unbroken(dataset, 2))
    show_all(axes, np.concatenate(corners))
    axes.set(xlabel="x [m]", ylabel="y [m]")
    title = f"{int(uncertain.sum())} of {len(dataset)} samples with {large}"
    axes.set_title(title + (f" · {breaks} breaks in the drive" if breaks else ""))
    axes.legend(handles=marks, loc="best")
    figure.subplots_adjust(left=0.08, right=0.98, top=0.94, bottom=0.08)
    return figure


def kernel_figure(scores: Sequence[KernelScore]) -> Figure:
    """Held-out error against the smoothness of the kernel: the figure of the paper's appendix.

    One column an output; RMSE above, log predictive density below; the chosen kernel in red.
    """
    figure = Figure(figsize=(9.6, 4.8))
    grid = figure.subplots(2, len(OUTPUTS), sharex=True, squeeze=False)
    for column, output in zip(grid.T, OUTPUTS, strict=True):
        found = {score.kernel: score for score in scores if score.output == output}
        own = [found[kernel] for kernel in SMOOTHNESS if kernel in found]
        for axes, name in zip(column, ("rmse", "log_density"), strict=True):
            values = [getattr(score, name) for score in own]
            axes.plot(values, "o-", color=INK, linewidth=1, markersize=4)
            for place, score in enumerate(own):
                if score.chosen:
                    axes.plot(place, values[place], "o", color=WARNING, markersize=7, zorder=5)
            ticks = [SMOOTHNESS[score.kernel] for score in own]
            axes.set_xticks(range(len(own)), ticks, color=MUTED)
            axes.set_xlim(-0.4, len(own) - 0.6)
            axes.margins(y=0.15)
        column[0].set_title(f"{SYMBOLS[output]} RMSE [{UNITS[output]}]")
        column[0].set_ylim(bottom=0)
        column[1].set_title(f"{SYMBOLS[output]} log density")
        column[1].set_xlabel("smoothness ν of the Matérn kernel")
    figure.subplots_adjust(left=0.065, right=0.985, top=0.88, bottom=0.1, hspace=0.3, wspace=0.25)
    held, best = "held out, by parts of the drive", "chosen: largest log density"
    marks = [
        Line2D([], [], marker="o", color=INK, linewidth=1, label=held),
        Line2D([], [], marker="o", linestyle="", color=WARNING, label=best),
    ]
    figure.legend(handles=marks, loc="upper center", ncols=2)
    return figure


def write_kernels(scores: Sequence[KernelScore], path: Path) -> None:
    """Writes the figure of the kernels (PNG)."""
    with figure_style():
        write_png(kernel_figure(scores), path)


def write_validation(
    judged: Validated,
    threshold: float,
    bands: Sequence[Path],
    track_path: Path | None,
    track: Track | None,
) -> None:
    """Writes the error with its bands to some files, and where the car was to one (PNG)."""
    with figure_style():
        error = band_figure(judged.validation, judged.dataset.step_s, threshold)
        for path in bands:
            write_png(error, path)
        if track_path is not None:
            driven = track_figure(judged.dataset, judged.validation, threshold, track)
            write_png(driven, track_path)
