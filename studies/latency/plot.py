"""The picture: how often each leg takes how long, and where a cycle's time goes as time passes."""

from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from operation.report.canvas import write_png
from operation.report.style import INK, MUTED, figure_style
from studies.latency.analysis import Analysis
from studies.latency.legs import ANSWER, BESIDE, LEGS

__all__ = ["plot"]

_STACKED: Final = ("state_transport", "release_wait", "compute", "actuation_transport")
"""Legs that follow one another from state to actuation."""

_COLOURS: Final = {
    ANSWER: INK,
    **dict(zip(_STACKED, ("#009E73", "#E69F00", "#0072B2", "#D55E00"), strict=True)),
    "wake_up": "#CC79A7",
    "bare_loop": MUTED,
    "round_trip": "#56B4E9",
}
"""Okabe and Ito's."""

_LEAST_US: Final = 1.0
"""Bottom of the logarithmic axis: what is shorter does not matter here."""

_POINTS: Final = 2000


def plot(path: Path, analysis: Analysis) -> None:
    """Writes the picture; what was not measured is left out of it."""
    result = analysis.result
    title = f"{result.car}, {result.rate_hz:g} Hz, {result.duration_s:.0f} s"
    title += f", {result.load} busy processes beside" if result.load else ""
    title += f": {result.deadline_misses} of {result.ticks} deadlines missed"
    title += f" (bare loop: {result.bare_loop_misses})" if result.bare_loop_us else ""
    with figure_style():
        figure = Figure(figsize=(11.0, 4.6), layout="constrained")
        left, right = figure.subplots(1, 2, width_ratios=(1.15, 1.0))
        _percentiles(left, analysis)
        _budget(right, analysis)
        for axes in (left, right):
            axes.yaxis.set_major_formatter(
                lambda us, _: f"{us:g} µs" if us < 1e3 else f"{us / 1e3:g} ms"
            )
        figure.suptitle(title, x=0.01, ha="left", fontsize=10)
        write_png(figure, path, dpi=130)


def _percentiles(axes: Axes, analysis: Analysis) -> None:
    most = 10
    for name, colour in _COLOURS.items():
        if name in analysis.series:
            ns = np.sort(analysis.series[name].ns)
            most = max(most, len(ns))
            # Counted from the largest value, so that points are even on the logarithmic axis.
            k = np.unique(np.geomspace(1, len(ns), min(len(ns), _POINTS)).astype(int))
            axes.plot(
                len(ns) / k, np.maximum(ns[len(ns) - k] * 1e-3, _LEAST_US), color=colour,
                label=LEGS[name][0] if name in LEGS else BESIDE[name],
                linewidth=2.2 if name == ANSWER else 1.2,
            )  # fmt: skip
    axes.set(
        title="share of cycles below a time", xlabel="share of cycles, each step a nine more",
        xscale="log", yscale="log", xlim=(1.0, most * 1.1),
    )  # fmt: skip
    axes.set_ylim(bottom=_LEAST_US)
    nines = range(int(np.log10(most)) + 1)
    axes.set_xticks([10.0**k for k in nines], [f"{100 - 10.0 ** (2 - k):.7g} %" for k in nines])
    axes.minorticks_off()
    if axes.lines:
        axes.legend(loc="lower right", ncols=2)


def _budget(axes: Axes, analysis: Analysis) -> None:
    axes.set(title="where a cycle's time goes: medians as time passes", xlabel="time [s]")
    if not {ANSWER, *_STACKED} <= set(analysis.series):
        axes.text(0.5, 0.5, "nothing to show", transform=axes.transAxes, ha="center")
        return
    edges_s, medians = analysis.edges_s, {}
    for leg in (*_STACKED, ANSWER):
        intervals = analysis.series[leg].intervals(edges_s)
        medians[leg] = [np.median(ns) * 1e-3 if len(ns) else np.nan for ns in intervals]
    tops = np.cumsum([np.zeros(len(edges_s) - 1), *(medians[leg] for leg in _STACKED)], axis=0)
    for k, leg in enumerate(_STACKED):
        axes.stairs(
            tops[k + 1], edges_s, baseline=tops[k], fill=True, color=_COLOURS[leg], linewidth=0,
            label=LEGS[leg][0],
        )  # fmt: skip
    axes.stairs(medians[ANSWER], edges_s, baseline=None, color=INK, label=LEGS[ANSWER][0])
    axes.set(
        xlim=(0.0, edges_s[-1]), ylim=(0.0, 1.45 * np.nanmax([*tops[-1], *medians[ANSWER], 1.0]))
    )
    axes.legend(loc="upper left", ncols=2, reverse=True)
