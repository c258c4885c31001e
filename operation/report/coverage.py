"""Figure of what was driven before, of what a racing line asks for."""

from matplotlib.figure import Figure

from bayesrace.learning.coverage import Coverage
from bayesrace.operation.report.style import INK, MUTED, WARNING, panel

__all__ = ["coverage_figure"]


def coverage_figure(known: Coverage) -> Figure:
    """Lateral acceleration over speed: of samples, and of the line."""
    figure, axes = panel(2.6)
    for points, colour, size, label in (
        (known.driven, MUTED, 2, "training and practice"),
        (known.asked[known.near], INK, 2, "racing line"),
        (known.asked[~known.near], WARNING, 4, "not driven before"),
    ):
        if len(points):
            axes.plot(*points.T, ".", color=colour, markersize=size, label=label, rasterized=True)
    reach = 1.5 * float(known.asked[:, 1].max())
    axes.set(xlabel="speed [m/s]", ylabel="lateral acceleration [m/s²]", ylim=(0, reach))
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3, markerscale=3, columnspacing=1)
    return figure
