"""The picture: how often each leg takes how long, and where a cycle's time goes as time passes."""

from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator
from numpy.typing import NDArray

from experiments.latency.analysis import Analysis
from experiments.latency.legs import ANSWER
from experiments.latency.series import Series
from experiments.report.canvas import write_png
from experiments.report.style import INK, MUTED, figure_style

__all__ = ["plot"]

Floats = NDArray[np.float64]

_LINES: Final = {
    "state_to_actuation": ("state → actuation", INK),
    "actuation_transport": ("actuation transport", "#D55E00"),
    "compute": ("cycle", "#0072B2"),
    "state_transport": ("state transport", "#009E73"),
    "release_wait": ("wait for release", "#E69F00"),
    "wake_up": ("wake-up error", "#CC79A7"),
    "bare_loop": ("bare loop's wake-up error", MUTED),
}
"""Of the percentile plot, in Okabe and Ito's colours."""

_LAYERS: Final = (
    ("state transport", "#009E73", "state_transport", ""),
    ("decode", "#56B4E9", "decode", ""),
    ("wait for release", "#F0E442", "release_wait", "decode"),
    ("feedback", "#0072B2", "feedback", ""),
    ("rest of the cycle", "#8fbcdb", "compute", "feedback"),
    ("actuation transport", "#D55E00", "actuation_transport", ""),
)
"""Of a cycle's time: label, colour, the leg, and the leg in it that is another layer."""

_LEAST_US: Final = 1.0
"""Bottom of the logarithmic axis: what is shorter does not matter here."""

_POINTS: Final = 2000


def plot(path: Path, analysis: Analysis) -> None:
    """Writes the picture; what was not measured is left out of it."""
    result = analysis.result
    load = f", {result.load} busy processes beside" if result.load else ""
    bare = "" if result.bare_loop_us is None else f" (bare loop: {result.bare_loop_misses})"
    with figure_style():
        figure = Figure(figsize=(11.0, 4.6), layout="constrained")
        left, right = figure.subplots(1, 2, width_ratios=(1.15, 1.0))
        _percentiles(left, analysis.series)
        _budget(right, analysis)
        title = f"{result.car}, {result.rate_hz:g} Hz, {result.duration_s:.0f} s{load}: "
        title += f"{result.deadline_misses} of {result.ticks} deadlines missed{bare}"
        figure.suptitle(title, x=0.01, ha="left", fontsize=10)
        write_png(figure, path, dpi=130)


def _percentiles(axes: Axes, series: dict[str, Series]) -> None:
    axes.set_title("so many cycles stay below")
    most = 10.0
    for name, (label, colour) in _LINES.items():
        if name in series:
            count, ns = len(series[name].ns), np.sort(series[name].ns)
            most = max(most, float(count))
            # Counted from the largest value, so that points are even on the logarithmic axis.
            k = np.unique(np.geomspace(1, count, min(count, _POINTS)).astype(np.int64))
            axes.plot(count / k, np.maximum(ns[count - k] * 1e-3, _LEAST_US), label=label,
                      color=colour, linewidth=2.2 if name == ANSWER else 1.2,
                      linestyle="--" if name == "bare_loop" else "-")  # fmt: skip
    axes.set(xscale="log", yscale="log", xlim=(1.0, most * 1.1))
    axes.set_ylim(bottom=_LEAST_US)
    nines = range(int(np.log10(most)) + 1)
    axes.set_xticks([10.0**k for k in nines], [f"{100 - 10.0 ** (2 - k):.7g} %" for k in nines])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(_time))
    axes.grid(visible=True, which="minor", axis="y", linewidth=0.3)
    axes.set_xlabel("share of cycles, each step a nine more")
    if axes.lines:
        axes.legend(loc="lower right", ncols=2)


def _budget(axes: Axes, analysis: Analysis) -> None:
    axes.set_title("where a cycle's time goes: medians as time passes")
    axes.set_xlabel("time [s]")
    axes.yaxis.set_major_formatter(FuncFormatter(_time))
    if not {ANSWER, *(layer[2] for layer in _LAYERS)} <= set(analysis.series):
        axes.text(0.5, 0.5, "nothing to show", transform=axes.transAxes, ha="center")
        return
    edges_s, bottom = analysis.edges_s, np.zeros(len(analysis.edges_s) - 1)
    for label, colour, leg, less in _LAYERS:
        height = _medians(analysis, leg) - (_medians(analysis, less) if less else 0.0)
        top = bottom + np.maximum(height, 0.0)
        axes.stairs(top, edges_s, baseline=bottom, fill=True, color=colour, label=label,
                    linewidth=0)  # fmt: skip
        bottom = top
    answer = _medians(analysis, ANSWER)
    axes.stairs(answer, edges_s, baseline=None, color=INK, linewidth=1.6, label="state → actuation")
    axes.set(xlim=(0.0, edges_s[-1]), ylim=(0.0, 1.45 * np.nanmax([*bottom, *answer, _LEAST_US])))
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(handles[::-1], labels[::-1], loc="upper left", ncols=2)


def _medians(analysis: Analysis, leg: str) -> Floats:
    """In each interval [us]; NaN where there is no value."""
    intervals = analysis.series[leg].intervals(analysis.edges_s)
    return np.array([np.median(ns) * 1e-3 if len(ns) else np.nan for ns in intervals])


def _time(value_us: float, _position: int | None = None) -> str:
    return f"{value_us:g} µs" if value_us < 1e3 else f"{value_us / 1e3:g} ms"
