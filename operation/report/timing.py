"""The panel of the execution time of the controller's step."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from operation.analysis.race import DrivenRun
from operation.report.canvas import PANEL_WIDTH
from operation.report.style import INK, look

__all__ = ["solve_figure"]


def solve_figure(runs: Sequence[DrivenRun]) -> Figure:
    """Histogram of the step's execution time, one row a controller, logarithmic bins."""
    timed = [run for run in runs if len(run.record.telemetry)]
    tall = 0.85 * len(timed) + 0.5
    figure = Figure(figsize=(PANEL_WIDTH, tall))
    # fixed, as in a panel; 0.33 inch between two rows are for the title of the lower one
    figure.subplots_adjust(
        0.1 / PANEL_WIDTH, 0.5 / tall, 1 - 0.25 / PANEL_WIDTH, 1 - 0.33 / tall, hspace=0.33 / 0.52
    )
    grid = figure.subplots(len(timed), 1, sharex=True, squeeze=False)[:, 0]
    times = [np.maximum(run.record.telemetry["solve_us"], 1e-3) for run in timed]
    bins = np.geomspace(0.98 * min(map(np.min, times)), 1.02 * max(map(np.max, times)), 90)
    for axes, run, values in zip(grid, timed, times, strict=True):
        name, colour, _ = look(run.controller, run.number)
        p50, p99 = np.percentile(values, [50, 99])
        axes.hist(values, bins=list(bins), histtype="stepfilled", color=colour, alpha=0.75)
        axes.axvline(p50, color=INK, linewidth=1.2)
        axes.axvline(p99, color=INK, linewidth=1.0, linestyle=(0, (3, 2)))
        axes.set(xscale="log", yticks=[], xlim=(bins[0], bins[-1]))
        axes.set_title(name, color=colour, weight="bold")
        axes.set_title(f"p50 {p50:.0f} · p99 {p99:.0f} · max {values.max():.0f} µs", loc="right")
        axes.spines["left"].set_visible(False)
    grid[-1].set_xlabel("execution time of one step [µs], logarithmic")
    # On a logarithmic axis, plain numbers read better than powers.
    grid[-1].xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    grid[-1].xaxis.set_major_formatter("{x:g}")
    grid[-1].xaxis.set_minor_locator(NullLocator())
    return figure
