"""What the figures of a GP's error have in common: its 95 % band, and marks where it is unsure."""

from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from experiments.report.style import WARNING

__all__ = ["band_patch", "draw_band", "mark_uncertain", "uncertain_handle"]

Floats = NDArray[np.float64]

_BAND: Final = "#bcd7ea"


def draw_band(axes: Axes, x: Floats, mean: Floats | float, half: Floats) -> None:
    """The 95 % interval of each sample at ``x`` (n,): ``mean`` plus and minus ``half`` (n,)."""
    axes.fill_between(x, mean - half, mean + half, color=_BAND, linewidth=0, rasterized=True)


def band_patch() -> Patch:
    """What the legend calls the band."""
    return Patch(color=_BAND, label="95 % band predicted")


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


def uncertain_handle(threshold: float) -> Line2D:
    """What the legend calls the ticks."""
    label = f"largest sigma > {threshold:g}"
    return Line2D([], [], color=WARNING, marker="|", linestyle="", label=label)
