"""The picture: how often each leg takes how long, and where a cycle's time goes as time passes."""

from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator
from numpy.typing import NDArray

from experiments.latency.histograms import curve
from experiments.latency.legs import ANSWER
from experiments.latency.results import LatencyResult
from experiments.report.canvas import write_png
from experiments.report.style import INK, MUTED, figure_style

__all__ = ["plot"]

_SHOWN: Final = {
    "state_to_actuation": ("state → actuation", INK),
    "actuation_transport": ("actuation transport", "#D55E00"),
    "compute": ("cycle", "#0072B2"),
    "state_transport": ("state transport", "#009E73"),
    "release_wait": ("wait for release", "#E69F00"),
    "wake_up": ("wake-up error", "#CC79A7"),
}
"""Legs of the percentile plot, in Okabe and Ito's colours."""

_LEAST_US: Final = 1.0
"""Bottom of the logarithmic axis: what is shorter does not matter here."""

_NINES: Final = {1.0: "0", 2.0: "50 %", 10.0: "90 %", 1e2: "99 %", 1e3: "99.9 %", 1e4: "99.99 %",
                 1e5: "99.999 %", 1e6: "99.9999 %"}  # fmt: skip

Series = list[tuple[float, float]]
Floats = NDArray[np.float64]


class _Layer(NamedTuple):
    """One layer of the budget: the leg, less what is shown of it already."""

    label: str
    colour: str
    leg: str
    less: str = ""


_LAYERS: Final = (
    _Layer("state transport", "#009E73", "state_transport"),
    _Layer("decode", "#56B4E9", "decode"),
    _Layer("wait for release", "#F0E442", "release_wait", "decode"),
    _Layer("feedback", "#0072B2", "feedback"),
    _Layer("rest of the cycle", "#8fbcdb", "compute", "feedback"),
    _Layer("actuation transport", "#D55E00", "actuation_transport"),
)


def plot(
    path: Path,
    result: LatencyResult,
    histograms: dict[str, Any],
    medians: dict[str, Series],
    bare: Any | None,
) -> None:
    """Writes the picture; what was not measured is left out of it."""
    with figure_style():
        figure = Figure(figsize=(11.0, 4.6), layout="constrained")
        left, right = figure.subplots(1, 2, width_ratios=(1.15, 1.0))
        _percentiles(left, histograms, bare)
        _budget(right, medians, result)
        figure.suptitle(_title(result), x=0.01, ha="left", fontsize=10)
        write_png(figure, path, dpi=130)


def _title(result: LatencyResult) -> str:
    load = f", {result.load} busy processes beside" if result.load else ""
    return (
        f"{result.car}, {result.rate_hz:g} Hz, {result.duration_s:.0f} s{load}: "
        f"{result.deadline_misses} of {result.ticks} deadlines missed "
        f"(bare loop: {result.bare_loop_misses})"
    )


def _percentiles(axes: Axes, histograms: dict[str, Any], bare: Any | None) -> None:
    axes.set_title("so many cycles stay below")
    most = 10.0
    for name, (label, colour) in _SHOWN.items():
        histogram = histograms.get(name)
        if histogram is None or not histogram.get_total_count():
            continue
        most = max(most, float(histogram.get_total_count()))
        width = 2.2 if name == ANSWER else 1.2
        axes.plot(*_line(histogram), label=label, color=colour, linewidth=width)
    if bare is not None and bare.get_total_count():
        most = max(most, float(bare.get_total_count()))
        label = "bare loop's wake-up error"
        axes.plot(*_line(bare), label=label, color=MUTED, linestyle="--")
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(1.0, most * 1.1)
    axes.set_ylim(bottom=_LEAST_US)
    ticks = [at for at in _NINES if at <= most]
    axes.set_xticks(ticks, [_NINES[at] for at in ticks])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(FuncFormatter(_time))
    axes.grid(visible=True, which="minor", axis="y", linewidth=0.3)
    axes.set_xlabel("share of cycles, each step a nine more")
    if axes.lines:
        axes.legend(loc="lower right", ncols=2)


def _line(histogram: Any) -> tuple[list[float], list[float]]:
    x, y = curve(histogram)
    total = float(histogram.get_total_count())
    # the largest value reaches as far as there are cycles
    return [*x, total], [max(value, _LEAST_US) for value in (*y, y[-1])]


def _time(value_us: float, _position: int | None = None) -> str:
    return f"{value_us:g} µs" if value_us < 1e3 else f"{value_us / 1e3:g} ms"


def _budget(axes: Axes, medians: dict[str, Series], result: LatencyResult) -> None:
    axes.set_title("where a cycle's time goes: medians as time passes")
    axes.set_xlabel("time [s]")
    axes.yaxis.set_major_formatter(FuncFormatter(_time))
    names = {ANSWER, *(one.leg for one in _LAYERS), *(one.less for one in _LAYERS if one.less)}
    ends = sorted(set.intersection(*({at for at, _ in medians.get(name, [])} for name in names)))
    if not ends:
        axes.text(0.5, 0.5, "nothing to show", transform=axes.transAxes, ha="center")
        return
    table = {name: np.array([dict(medians[name])[at] for at in ends]) for name in names}
    layers = [_height(table, layer) for layer in _LAYERS]
    # Each median stands for the interval that ends there.
    edges = np.array([0.0, *ends])
    bottom = np.zeros(len(ends))
    for layer, height in zip(_LAYERS, layers, strict=True):
        axes.stairs(bottom + height, edges, baseline=bottom, fill=True, color=layer.colour,
                    label=layer.label, linewidth=0)  # fmt: skip
        bottom = bottom + height
    axes.stairs(table[ANSWER], edges, baseline=None, color=INK, linewidth=1.6,
                label="state → actuation")  # fmt: skip
    top = max(float(bottom.max()), float(table[ANSWER].max()))
    axes.set_ylim(0.0, 1.45 * top)
    axes.set_xlim(0.0, max(result.duration_s, ends[-1]))
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(handles[::-1], labels[::-1], loc="upper left", ncols=2)


def _height(table: dict[str, Floats], layer: _Layer) -> Floats:
    height = table[layer.leg]
    return np.maximum(height - table[layer.less], 0.0) if layer.less else height
