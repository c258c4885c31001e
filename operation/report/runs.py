"""Panels of whole runs: the states that they have visited, and how long the control steps took."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from bayesrace.arrays import Floats
from bayesrace.operation.analysis.race import DrivenRun
from bayesrace.operation.report.style import INK, PANEL_WIDTH, look, panel
from bayesrace.vehicles.parts import GRAVITY_MPS2

__all__ = ["coverage_figures", "solve_figure"]


def coverage_figures(training: DrivenRun, runs: Sequence[DrivenRun]) -> list[Figure]:
    """Speed against yaw rate, speed against slip, and accelerations along and across the way."""
    shown = [run for run in runs if run.controller == "bayesrace" and len(run.record.x) > 1]
    rows = (
        ("speed and yaw rate", "vx [m/s]", "ω [rad/s]", lambda run: run.record.x[:, (3, 5)]),
        ("speed and slip", "vx [m/s]", "β [°]", _slip),
        ("accelerations", "to the left [g]", "forwards [g]", _accelerations),
    )
    figures = []
    for title, across, up, values in rows:
        figure, axes = panel(3.2)
        for run, size in ((training, 5.0), *((run, 1.6) for run in shown)):
            appearance = look(run.controller, run.number)
            x, y = values(run).T
            axes.plot(
                x, y, "o", color=appearance.colour, markersize=size, alpha=0.5,
                markeredgewidth=0, label=appearance.name,
            )  # fmt: skip
        axes.set(title=title, xlabel=across, ylabel=up)
        axes.legend(loc="best", markerscale=1.5)
        figures.append(figure)
    return figures


def _slip(run: DrivenRun) -> Floats:
    return np.column_stack([run.record.x[:, 3], np.degrees(run.record.slip_rad)])


def _accelerations(run: DrivenRun) -> Floats:
    """Across and along the way, (n - 1, 2) [g]."""
    record = run.record
    forwards = np.diff(np.hypot(record.x[:, 3], record.x[:, 4])) / np.diff(record.time_s)
    return np.column_stack([record.lateral_mps2[:-1], forwards]) / GRAVITY_MPS2


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
