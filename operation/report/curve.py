"""Figure of a search: the best lap against the number of evaluations."""

from typing import Final

import numpy as np
from matplotlib.figure import Figure

from bayesrace.arrays import Floats
from operation.report.canvas import panel
from operation.report.style import INK, MUTED

__all__ = ["curve_figure"]

_COLOURS: Final = "#0072B2", "#D55E00"


def curve_figure(bayesian: Floats, random: Floats, direct_s: float) -> Figure:
    """Mean and range over the trials of both searches, each (trials, evaluations) [s].

    ``random`` may have no trials. ``direct_s``: lap along the minimum-time line, a level.
    """
    figure, axes = panel(3.0)
    names = "Bayesian optimisation", "random search"
    for name, colour, laps in zip(names, _COLOURS, (bayesian, random), strict=True):
        if len(laps) == 0:
            continue
        known = np.where(np.isfinite(laps), laps, np.nan)
        evaluation = np.arange(1, laps.shape[1] + 1)
        axes.fill_between(
            evaluation, known.min(axis=0), known.max(axis=0), color=colour, alpha=0.2, linewidth=0
        )
        axes.plot(evaluation, known.mean(axis=0), color=colour, linewidth=1.4, label=name)
    axes.axhline(direct_s, color=INK, linewidth=0.9, linestyle=(0, (4, 2)), label="minimum time")
    axes.set(xlabel="evaluations", ylabel="best lap [s]", xlim=(1, bayesian.shape[1]))
    trials = len(bayesian)
    axes.set_title(f"mean and range of {trials} seeds" if trials > 1 else "", color=MUTED)
    axes.legend(loc="upper right")
    return figure
