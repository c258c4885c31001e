"""The 95 % band of a GP in a figure, and marks where its sigma is large."""

from typing import Final

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from bayesrace.arrays import Floats
from operation.report.style import WARNING

__all__ = ["BAND", "draw_band", "mark_uncertain"]


BAND: Final = "#bcd7ea"


def draw_band(axes: Axes, x: Floats, mean: Floats | float, half: Floats) -> None:
    """The 95 % interval of each sample at ``x`` (n,): ``mean`` plus and minus ``half`` (n,)."""
    axes.fill_between(x, mean - half, mean + half, color=BAND, linewidth=0, rasterized=True)


def mark_uncertain(axes: Axes, x: Floats, marked: NDArray[np.bool_]) -> None:
    """A tick at the bottom for each sample at ``x`` (n,) that is ``marked`` (n,)."""
    axes.plot(
        x[marked],
        np.full(int(marked.sum()), 0.015),
        "|",
        color=WARNING,
        markersize=5,
        markeredgewidth=0.8,
        transform=axes.get_xaxis_transform(),
    )
