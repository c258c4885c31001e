"""What the GPs know, and how long the controller thinks."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from numpy.typing import NDArray

from bayesrace.gp.weights import OUTPUTS, UNITS
from experiments.analysis import DrivenRun
from experiments.notation import SYMBOLS, UNCERTAIN
from experiments.report.bands import band_patch, draw_band, mark_uncertain, uncertain_handle
from experiments.report.style import INK, MUTED, PAGE_WIDTH, look
from learning.validation import Validation

__all__ = ["gp_figure", "solve_figure"]

Floats = NDArray[np.float64]


def gp_figure(validations: Mapping[str, Validation], distance_m: Floats, lap_m: float) -> Figure:
    """Error after the correction and its 95 % band, one row an output, one column the weights.

    ``distance_m`` (n,): how far the car had come at each validated sample.
    """
    figure = Figure(figsize=(PAGE_WIDTH, 6.1))
    grid = figure.subplots(len(OUTPUTS), len(validations), sharex=True, squeeze=False)
    shown = distance_m <= 3.02 * lap_m
    for column, (controller, validation) in enumerate(validations.items()):
        marked = validation.uncertain(UNCERTAIN)[shown]
        for row, output in enumerate(OUTPUTS):
            axes = grid[row, column]
            _draw_error(axes, distance_m[shown], validation, row, shown)
            mark_uncertain(axes, distance_m[shown], marked)
            metrics = validation.metrics[output]
            axes.set_title(_caption(output, metrics), fontsize=7.6, color=MUTED, loc="right")
            axes.set_ylim(*_limits(validation, row))
            if row == 0:
                _draw_heading(axes, controller)
            if column == 0:
                axes.set_ylabel(f"{SYMBOLS[output]} error [{UNITS[output]}]")
    for axes in grid[-1]:
        axes.set_xlabel("distance driven by BestCase [m]")
        axes.set_xlim(0, float(distance_m[shown].max(initial=lap_m)))
    figure.align_ylabels(list(grid[:, 0]))
    _draw_lap_ends(list(grid.flat), distance_m[shown], lap_m)
    figure.subplots_adjust(left=0.07, right=0.99, top=0.87, bottom=0.08, hspace=0.3, wspace=0.12)
    figure.legend(handles=_gp_marks(), loc="upper right", ncols=3)
    return figure


def _draw_heading(axes: Axes, controller: str) -> None:
    appearance = look(controller)
    axes.text(
        0.0,
        1.24,
        appearance.name,
        transform=axes.transAxes,
        color=appearance.colour,
        fontsize=9.5,
        weight="bold",
    )


def _draw_error(
    axes: Axes, distance_m: Floats, validation: Validation, row: int, shown: NDArray[np.bool_]
) -> None:
    draw_band(axes, distance_m, 0.0, validation.band[shown, row])
    axes.plot(distance_m, validation.error[shown, row], color=INK, linewidth=0.7)


def _limits(validation: Validation, row: int) -> tuple[float, float]:
    """Shows nearly all: single spikes would flatten everything else."""
    error = float(np.percentile(np.abs(validation.error[:, row]), 99.5))
    band = float(np.percentile(validation.band[:, row], 99.5))
    limit = 1.15 * max(error, band) or 1.0
    return -limit, limit


def _caption(output: str, metrics: Mapping[str, float]) -> str:
    return (
        f"RMSE {metrics['rmse']:.3g}, without GP {metrics['uncorrected_rmse']:.3g} {UNITS[output]}"
        f" · R² {metrics['r2']:.3f} · coverage {metrics['coverage']:.2f}"
    )


def _draw_lap_ends(panels: Iterable[Axes], distance_m: Floats, lap_m: float) -> None:
    for end_m in np.arange(lap_m, float(distance_m.max(initial=0.0)), lap_m):
        for axes in panels:
            axes.axvline(end_m, color=MUTED, linewidth=0.7, linestyle=(0, (1, 2)))


def _gp_marks() -> list[Line2D | Patch]:
    return [
        Line2D([], [], color=INK, linewidth=1, label="error left after the correction"),
        band_patch(),
        uncertain_handle(UNCERTAIN),
    ]


def solve_figure(runs: Sequence[DrivenRun]) -> Figure:
    """Histogram of the step's execution time, one row a controller, logarithmic bins."""
    timed = [run for run in runs if len(run.record.solve_us)]
    height = 0.72 * len(timed) + 0.75
    figure = Figure(figsize=(PAGE_WIDTH, height))
    grid = figure.subplots(len(timed), 1, sharex=True, squeeze=False)[:, 0]
    all_us = np.concatenate([run.record.solve_us for run in timed])
    positive = np.maximum(all_us, 1e-3)
    bins = np.geomspace(float(positive.min()) * 0.98, float(positive.max()) * 1.02, 90)
    for axes, run in zip(grid, timed, strict=True):
        _draw_solve(axes, run, bins)
    grid[-1].set_xlabel("execution time of one step [µs], logarithmic")
    # On a logarithmic axis, plain numbers read better than powers.
    grid[-1].xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    grid[-1].xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    grid[-1].xaxis.set_minor_locator(NullLocator())
    figure.subplots_adjust(
        left=0.145, right=0.76, top=1 - 0.1 / height, bottom=0.5 / height, hspace=0.28
    )
    return figure


def _draw_solve(axes: Axes, run: DrivenRun, bins: Floats) -> None:
    appearance, values = look(run.controller), run.record.solve_us
    p50, p99 = np.percentile(values, [50, 99])
    axes.hist(np.maximum(values, 1e-3), bins=list(bins), color=appearance.colour, alpha=0.75)
    axes.axvline(p50, color=INK, linewidth=1.2)
    axes.axvline(p99, color=INK, linewidth=1.0, linestyle=(0, (3, 2)))
    axes.set(xscale="log", yticks=[], xlim=(bins[0], bins[-1]))
    axes.set_ylabel(
        appearance.name, rotation=0, ha="right", va="center", color=appearance.colour, weight="bold"
    )
    axes.text(
        1.015,
        0.5,
        f"p50 {p50:.0f} · p99 {p99:.0f} · max {values.max():.0f} µs",
        transform=axes.transAxes,
        va="center",
        fontsize=8,
    )
    axes.spines["left"].set_visible(False)
