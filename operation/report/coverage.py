"""Which states the training drive has visited, beside those that the learned controller drives."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from bayesrace.arrays import Floats
from bayesrace.vehicles.parts import GRAVITY_MPS2
from operation.analysis.race import DrivenRun
from operation.report.canvas import panel
from operation.report.style import look

__all__ = ["coverage_figures"]


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
