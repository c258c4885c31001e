"""Figures of what Gaussian processes predict: error with its 95 % band, uncertain samples."""

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesrace.arrays import Flags, Floats
from bayesrace.gp.weights import OUTPUTS, UNITS
from bayesrace.learning.dataset import Dataset
from bayesrace.learning.validation import Validation, unbroken
from bayesrace.operation.analysis.validation import Validated
from bayesrace.operation.look import look
from bayesrace.operation.report.maps import draw_edges, show_all
from bayesrace.operation.report.style import (
    INK,
    MUTED,
    PICTURE_WIDTH,
    WARNING,
    figure_style,
    panel,
    write_png,
)
from bayesrace.operation.terminal import SYMBOLS, UNCERTAIN
from bayesrace.tracks import Track

__all__ = ["gp_figures", "write_validation"]

_BAND: Final = "#bcd7ea"
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
            _draw_error(axes, x, validation, row, shown, UNCERTAIN)
            axes.axvline(lap_m, color=MUTED, linewidth=0.7, linestyle=(0, (1, 2)))
            appearance = look(controller)
            axes.set_title(f"{SYMBOLS[output]} · {appearance.name}", color=appearance.colour)
            axes.set_xlim(0, float(x.max(initial=lap_m)))
            axes.set_xlabel("distance driven by BestCase [m]")
            figures.append(figure)
    return figures


def _draw_error(
    axes: Axes, x: Floats, validation: Validation, row: int, shown: slice | Flags, threshold: float
) -> None:
    """The error of one output after the correction over its band, for the samples ``shown`` at
    ``x`` (n,); a tick for each of which the largest sigma is above the threshold."""
    output, error, half = OUTPUTS[row], validation.error[:, row], validation.band[:, row]
    axes.fill_between(x, -half[shown], half[shown], color=_BAND, linewidth=0, rasterized=True)
    axes.plot(x, error[shown], color=INK, linewidth=0.7)
    marked = x[validation.uncertain(threshold)[shown]]
    axes.plot(
        marked, np.full(len(marked), 0.015), "|", color=WARNING, markersize=5, markeredgewidth=0.8,
        transform=axes.get_xaxis_transform(),
    )  # fmt: skip
    rmse = f"RMSE {validation.metrics[output]['rmse']:.2g} {UNITS[output]}"
    axes.set_title(rmse, loc="right", color=MUTED)
    # Nearly all is shown: single spikes would flatten everything else.
    limit = 1.15 * float(np.percentile(np.abs([error, half]), 99.5, axis=1).max()) or 1.0
    axes.set_ylim(-limit, limit)
    axes.set_ylabel(f"{SYMBOLS[output]} error [{UNITS[output]}]")


def _error_figure(validation: Validation, step_s: float, threshold: float) -> Figure:
    """Error after the correction and its band, a row for each output."""
    figure = Figure(figsize=(PICTURE_WIDTH, 6.4), layout="tight")
    rows = figure.subplots(len(OUTPUTS), 1, sharex=True)
    time_s: Floats = np.arange(len(validation.sigma), dtype=np.float64) * step_s
    for row, axes in enumerate(rows):
        _draw_error(axes, time_s, validation, row, slice(None), threshold)
    marks = f"red ticks: largest sigma > {threshold:g}"
    rows[0].set_title(f"error after the correction, 95 % band predicted; {marks}")
    rows[-1].set(xlabel="samples, as time driven [s]", xlim=(0, max(float(time_s[-1]), step_s)))
    return figure


def _track_figure(
    dataset: Dataset, validation: Validation, threshold: float, track: Track | None
) -> Figure:
    """Where the car was, in red where the largest sigma is above ``threshold`` (paper's figure)."""
    xy = dataset.x[:, :2]
    corners = [xy]
    figure = Figure(figsize=(PICTURE_WIDTH * 0.72, 6.4), layout="tight")
    axes = figure.subplots()
    if track is not None:
        edges = track.boundaries(0.04)
        corners += edges
        draw_edges(axes, *edges)
    uncertain = validation.uncertain(threshold)
    gaps = np.full_like(xy, np.nan)  # from one sample's step to the next
    steps = np.stack([xy, dataset.x_next[:, :2], gaps], axis=1)
    large = f"largest sigma > {threshold:g}"
    axes.plot(*steps[~uncertain].reshape(-1, 2).T, color=INK, linewidth=1.0, label="driven")
    axes.plot(*steps[uncertain].reshape(-1, 2).T, color=WARNING, linewidth=2.6, label=large)
    breaks = len(dataset) - 1 - len(unbroken(dataset, 2))
    show_all(axes, np.concatenate(corners))
    title = f"{int(uncertain.sum())} of {len(dataset)} samples with {large}"
    title += f" · {breaks} breaks in the drive" if breaks else ""
    axes.set(xlabel="x [m]", ylabel="y [m]", title=title)
    axes.legend(loc="best")
    return figure


def write_validation(
    judged: Validated, threshold: float, folder: Path, track: Track | None
) -> None:
    """Writes ``error.png``, the errors with their bands, and ``track.png``, where the car was."""
    step_s = judged.dataset.step_s
    with figure_style():
        error = _error_figure(judged.validation, step_s, threshold)
        write_png(error, folder / "error.png")
        driven = _track_figure(judged.dataset, judged.validation, threshold, track)
        write_png(driven, folder / "track.png")
