"""The report of a campaign, made from its Parquet files alone: ``report.html``.

Its figures show lap time and off-track rate by each factor, and by pairs of settings.
"""

from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from bayesrace.arrays import Floats
from bayesrace.files import write_whole
from bayesrace.operation.report.render import template
from bayesrace.operation.report.style import INK, PANEL_WIDTH, figure_style, inline_svg, look, panel
from bayesrace.studies.campaign import summary
from bayesrace.studies.campaign.summary import Levels, summarised

__all__ = ["render_campaign"]

_MOST: Final = 16  # values in one figure; of more, those with the most laps off the track
_TEXT: Final = 14  # characters of a value that are shown
_SLANTED: Final[dict[str, Any]] = {"rotation": 30, "ha": "right", "rotation_mode": "anchor"}


def _factor_figures(laps: pd.DataFrame, name: str) -> list[Figure]:
    """Lap time and off-track rate of each controller over the values of a factor.

    Times are medians with a bar from the 10th to the 90th percentile, rates have their 95 %
    interval.
    """
    found, note, by_track = summary.levels(laps, name), "", name == "track"
    laps, order = laps.assign(level=found.index), np.arange(len(found.labels))
    if len(order) > _MOST:
        share = summarised(laps, ["level"]).share.reindex(order).fillna(0.0)
        order = np.argsort(-share.to_numpy(), kind="stable")[:_MOST]
        note = f": {_MOST} of {len(found.labels)}, most off track first"
    times = "flying lap [s]" if by_track else "flying lap against\nits track's median [%]"
    table = summarised(laps, ["controller", "level"], "compared" if by_track else "relative")
    figures, drivers = [], summary.in_order(laps)
    for title, middle, low, high in (
        (times, "median", "low", "high"),
        ("laps off track or unfinished [%]", "share", "share_low", "share_high"),
    ):
        figure, axes = panel(2.5)
        for number, controller in enumerate(drivers):
            own = table.loc[controller].reindex(order).assign(place=np.arange(len(order)))
            own = own[own[middle].notna()]
            axes.errorbar(
                own.place + 0.12 * (number - (len(drivers) - 1) / 2), own[middle],
                yerr=np.maximum([own[middle] - own[low], own[high] - own[middle]], 0.0), fmt="o",
                markersize=3.5, linewidth=1.1, color=look(controller).colour,
            )  # fmt: skip
        labels = [_short(found.labels[level]) for level in order]
        form = _SLANTED if sum(map(len, labels)) > 48 else {}
        axes.set_xticks(range(len(order)), labels, **form)
        axes.set(title=name + note, ylabel=title, xlim=(-0.6, len(order) - 0.4))
        figures.append(figure)
    axes.set_ylim(bottom=0)
    return figures


def _short(text: str) -> str:
    return text if len(text) <= _TEXT else f"{text[: _TEXT - 1]}…"


def _pair_figures(laps: pd.DataFrame, first: Levels, second: Levels) -> list[Figure]:
    """Median flying lap and off-track rate over two settings, of one controller."""
    both = laps.assign(row=second.index, column=first.index)
    table = summarised(both[laps.controller == summary.shown(laps)], ["row", "column"])
    rows, columns = range(len(second.labels)), range(len(first.labels))
    times, rates = (
        table[name].unstack().reindex(index=rows, columns=columns).to_numpy()
        for name in ("median", "share")
    )
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


def render_campaign(folder: Path) -> Path:
    """Writes the page into the folder of a campaign's results; returns its path.

    InputError if there are no results.
    """
    laps, others = summary.read_laps(folder)
    with figure_style():
        drawn = {name: _factor_figures(laps, name) for name in summary.varied(laps)}
        drawn |= {
            f"{first.name} × {second.name}": _pair_figures(laps, first, second)
            for first, second in summary.pairs(laps)
        }
        figures = {name: [inline_svg(one) for one in own] for name, own in drawn.items()}
    page = template("campaign.html.j2", Path(__file__).parent).render(
        title=folder.resolve().name, facts=summary.facts(laps), look=look, figures=figures,
        controllers=list(summary.by_controller(laps).itertuples()), shown=summary.shown(laps),
        failures=summary.failures(laps), worst=summary.worst(laps), others=others,
    )  # fmt: skip
    path = folder / "report.html"
    write_whole(path, page)
    return path
