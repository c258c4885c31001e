"""Panels of what the GPs predict, and of the controller's execution time."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from bayesrace.arrays import Floats
from bayesrace.gp.weights import OUTPUTS, UNITS
from learning.validation import Validation
from operation.analysis.race import DrivenRun
from operation.report.bands import draw_band, mark_uncertain
from operation.report.canvas import PANEL_WIDTH, panel
from operation.report.style import INK, MUTED, look
from operation.terminal.notation import SYMBOLS, UNCERTAIN

__all__ = ["gp_figures", "solve_figure"]


_LAPS = 2.0
"""Shown of the drive."""


def gp_figures(
    validations: Mapping[str, Validation], distance_m: Floats, lap_m: float
) -> list[Figure]:
    """Error after the correction and its 95 % band, a panel for each output and weights.

    ``distance_m`` (n,): how far the car had come at each validated sample.
    """
    shown = distance_m <= _LAPS * lap_m
    figures = []
    for row, output in enumerate(OUTPUTS):
        for controller, validation in validations.items():
            figure, axes = panel(1.9)
            draw_band(axes, distance_m[shown], 0.0, validation.band[shown, row])
            axes.plot(distance_m[shown], validation.error[shown, row], color=INK, linewidth=0.7)
            mark_uncertain(axes, distance_m[shown], validation.uncertain(UNCERTAIN)[shown])
            axes.axvline(lap_m, color=MUTED, linewidth=0.7, linestyle=(0, (1, 2)))
            appearance = look(controller)
            axes.set_title(f"{SYMBOLS[output]} · {appearance.name}", color=appearance.colour)
            rmse = f"RMSE {validation.metrics[output]['rmse']:.2g} {UNITS[output]}"
            axes.set_title(rmse, loc="right", color=MUTED)
            limit = _limit(validation, row)
            axes.set(xlim=(0, float(distance_m[shown].max(initial=lap_m))), ylim=(-limit, limit))
            axes.set_ylabel(f"{SYMBOLS[output]} error [{UNITS[output]}]")
            axes.set_xlabel("distance driven by BestCase [m]")
            figures.append(figure)
    return figures


def _limit(validation: Validation, row: int) -> float:
    """Of an axis that shows nearly all: single spikes would flatten everything else."""
    both = np.abs(validation.error[:, row]), validation.band[:, row]
    return 1.15 * max(float(np.percentile(one, 99.5)) for one in both) or 1.0


def solve_figure(runs: Sequence[DrivenRun]) -> Figure:
    """Histogram of the step's execution time, one row a controller, logarithmic bins."""
    timed = [run for run in runs if len(run.record.solve_us)]
    figure = Figure(figsize=(PANEL_WIDTH, 0.85 * len(timed) + 0.5), layout="constrained")
    grid = figure.subplots(len(timed), 1, sharex=True, squeeze=False)[:, 0]
    positive = np.maximum(np.concatenate([run.record.solve_us for run in timed]), 1e-3)
    bins = np.geomspace(float(positive.min()) * 0.98, float(positive.max()) * 1.02, 90)
    for axes, run in zip(grid, timed, strict=True):
        _draw_solve(axes, run, bins)
    grid[-1].set_xlabel("execution time of one step [µs], logarithmic")
    # On a logarithmic axis, plain numbers read better than powers.
    grid[-1].xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    grid[-1].xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    grid[-1].xaxis.set_minor_locator(NullLocator())
    return figure


def _draw_solve(axes: Axes, run: DrivenRun, bins: Floats) -> None:
    appearance, values = look(run.controller), run.record.solve_us
    p50, p99 = np.percentile(values, [50, 99])
    axes.hist(np.maximum(values, 1e-3), bins=list(bins), color=appearance.colour, alpha=0.75)
    axes.axvline(p50, color=INK, linewidth=1.2)
    axes.axvline(p99, color=INK, linewidth=1.0, linestyle=(0, (3, 2)))
    axes.set(xscale="log", yticks=[], xlim=(bins[0], bins[-1]))
    axes.set_title(appearance.name, color=appearance.colour, weight="bold")
    axes.set_title(f"p50 {p50:.0f} · p99 {p99:.0f} · max {values.max():.0f} µs", loc="right")
    axes.spines["left"].set_visible(False)
