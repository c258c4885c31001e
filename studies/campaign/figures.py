"""Figures of a campaign: lap time and off-track rate by each factor, and by pairs of settings."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bayesrace.arrays import Floats
from operation.report.canvas import PANEL_WIDTH, panel
from operation.report.style import INK, look
from studies.campaign.summary import Laps, Levels

__all__ = ["factor_figures", "pair_figures"]

_MOST: Final = 16
"""Values in one figure; of more, those with the most laps off the track."""
_TEXT: Final = 14
"""Characters of a value that are shown."""
_SLANTED: Final[dict[str, Any]] = {"rotation": 30, "ha": "right", "rotation_mode": "anchor"}


def factor_figures(laps: Laps, name: str) -> list[Figure]:
    """Lap time and off-track rate of each controller over the values of a factor."""
    levels = laps.levels(name)
    order, note = _chosen(laps, levels)
    by_track = name == "track"
    values = laps.lap_time_s if by_track else laps.relative()
    timed, time_axes = panel(2.5)
    rated, rate_axes = panel(2.5)
    for number, controller in enumerate(laps.controllers):
        shift = 0.12 * (number - (len(laps.controllers) - 1) / 2)
        own = laps.controller == controller
        _draw_times(time_axes, values, own & laps.flying, levels, order, shift, controller)
        _draw_rates(rate_axes, laps, own, levels, order, shift, controller)
    time_axes.set_ylabel(
        "flying lap [s]" if by_track else "flying lap against\nits track's median [%]"
    )
    rate_axes.set_ylabel("laps off track or unfinished [%]")
    rate_axes.set_ylim(bottom=0)
    for axes in (time_axes, rate_axes):
        axes.set_title(name + note)
        labels = [_short(levels.labels[level]) for level in order]
        long = sum(map(len, labels)) > 48
        axes.set_xticks(range(len(order)), labels, **(_SLANTED if long else {}))
        axes.set_xlim(-0.6, len(order) - 0.4)
    return [timed, rated]


def _short(text: str) -> str:
    return text if len(text) <= _TEXT else f"{text[: _TEXT - 1]}…"


def _chosen(laps: Laps, levels: Levels) -> tuple[list[int], str]:
    """The values to show, in order, and what to add to the title."""
    count = len(levels.labels)
    if count <= _MOST:
        return list(range(count)), ""
    share = [laps.rate(levels.index == level).share for level in range(count)]
    worst = np.argsort(-np.nan_to_num(share), kind="stable")[:_MOST]
    return worst.tolist(), f": {_MOST} of {count}, most off track first"


def _draw_times(
    axes: Axes, values: Floats, rows: NDArray[np.bool_], levels: Levels, order: Sequence[int],
    shift: float, controller: str,
) -> None:  # fmt: skip
    """Median, with a bar from the 10th to the 90th percentile."""
    points = []
    for place, level in enumerate(order):
        own = values[rows & (levels.index == level)]
        own = own[np.isfinite(own)]
        if len(own):
            points.append((place + shift, *np.percentile(own, [10, 50, 90])))
    if points:
        x, low, middle, high = np.array(points).T
        axes.errorbar(
            x, middle, yerr=(middle - low, high - middle), fmt="o", markersize=3.5,
            linewidth=1.1, color=look(controller).colour,
        )  # fmt: skip


def _draw_rates(
    axes: Axes, laps: Laps, own: NDArray[np.bool_], levels: Levels, order: Sequence[int],
    shift: float, controller: str,
) -> None:  # fmt: skip
    """Share with its 95 % interval."""
    for place, level in enumerate(order):
        rate = laps.rate(own & (levels.index == level))
        if rate.total:
            low, high = rate.interval
            share = rate.share
            axes.errorbar(
                place + shift, 100 * share,
                yerr=([100 * max(share - low, 0)], [100 * max(high - share, 0)]), fmt="o",
                markersize=3.5, linewidth=1.1, color=look(controller).colour,
            )  # fmt: skip


def pair_figures(laps: Laps, first: Levels, second: Levels) -> list[Figure]:
    """Median flying lap and off-track rate over two settings, of one controller."""
    own = laps.controller == laps.shown
    relative = laps.relative()
    shape = len(second.labels), len(first.labels)
    times, rates = np.full(shape, np.nan), np.full(shape, np.nan)
    for i, j in np.ndindex(shape):
        rows = own & (second.index == i) & (first.index == j)
        known = relative[rows & laps.flying]
        known = known[np.isfinite(known)]
        times[i, j] = np.median(known) if len(known) else np.nan
        rates[i, j] = 100 * laps.rate(rows).share
    return [
        _heat(times, first, second, "flying lap against its track's median [%]", "{:+.2f}"),
        _heat(rates, first, second, "laps off track or unfinished [%]", "{:.1f}"),
    ]


def _heat(values: Floats, first: Levels, second: Levels, title: str, form: str) -> Figure:
    rows, columns = values.shape
    figure = Figure(figsize=(PANEL_WIDTH, 0.34 * rows + 1.1), layout="constrained")
    axes = figure.subplots()
    axes.imshow(values, cmap="YlOrRd", aspect="auto", origin="lower")
    middle = np.nanmean(values) if np.isfinite(values).any() else 0.0
    for i, j in np.ndindex(values.shape):
        if np.isfinite(values[i, j]):
            dark = values[i, j] > middle + 0.3 * (np.nanmax(values) - np.nanmin(values))
            colour = "white" if dark else INK
            axes.text(j, i, form.format(values[i, j]), ha="center", va="center", color=colour)
    axes.set_xticks(range(columns), [_short(one) for one in first.labels], **_SLANTED)
    axes.set_yticks(range(rows), [_short(one) for one in second.labels])
    axes.set(xlabel=first.name, ylabel=second.name, title=title)
    axes.grid(visible=False)
    return figure
