"""Held-out error against the smoothness of the kernel: the figure of the paper's appendix."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from bayesrace.gp.weights import OUTPUTS, UNITS
from learning.assessment import KernelScore
from operation.report.style import INK, MUTED, WARNING
from operation.terminal.notation import SMOOTHNESS, SYMBOLS

__all__ = ["kernel_figure"]


def kernel_figure(scores: Sequence[KernelScore]) -> Figure:
    """One column an output; RMSE above, log predictive density below; the chosen kernel in red."""
    figure = Figure(figsize=(9.6, 4.8))
    grid = figure.subplots(2, len(OUTPUTS), sharex=True, squeeze=False)
    for column, output in enumerate(OUTPUTS):
        own = sorted(
            (score for score in scores if score.output == output),
            key=lambda score: list(SMOOTHNESS).index(score.kernel),
        )
        name = SYMBOLS[output]
        above, below = grid[:, column]
        _draw(above, own, [score.rmse for score in own])
        above.set_title(f"{name} RMSE [{UNITS[output]}]")
        above.set_ylim(bottom=0)
        _draw(below, own, [score.log_density for score in own])
        below.set_title(f"{name} log density")
        below.set_xlabel("smoothness ν of the Matérn kernel")
    figure.subplots_adjust(left=0.065, right=0.985, top=0.88, bottom=0.1, hspace=0.3, wspace=0.25)
    chosen = Line2D(
        [], [], marker="o", linestyle="", color=WARNING, label="chosen: largest log density"
    )
    label = "held out, by parts of the drive"
    held = Line2D([], [], marker="o", color=INK, linewidth=1, label=label)
    figure.legend(handles=[held, chosen], loc="upper center", ncols=2)
    return figure


def _draw(axes: Axes, scores: Sequence[KernelScore], values: Sequence[float]) -> None:
    places = np.arange(len(scores))
    axes.plot(places, values, "o-", color=INK, linewidth=1, markersize=4)
    for place, score, value in zip(places, scores, values, strict=True):
        if score.chosen:
            axes.plot(place, value, "o", color=WARNING, markersize=7, zorder=5)
    axes.set_xticks(places, [SMOOTHNESS[score.kernel] for score in scores], color=MUTED)
    axes.set_xlim(-0.4, len(scores) - 0.6)
    axes.margins(y=0.15)
