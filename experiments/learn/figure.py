"""Lap time against lap number."""

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, ScalarFormatter

from experiments.learn.journal import LapRecord, Record
from experiments.report.canvas import write_png
from experiments.report.style import INK, MUTED, WARNING, figure_style, look
from experiments.results import read_result

__all__ = ["References", "draw", "lap_figure", "references"]

_FAR: Final = 1.25
"""Laps this many times the median are far longer than usual."""

References = Mapping[str, float]
"""Controller to flying lap time [s], drawn for comparison."""


def references(race: Path | None) -> References:
    """Flying lap times of a race, from its run directory; InputError if it is none."""
    if race is None:
        return {}
    result = read_result(race / "result.json")
    return {
        lap.controller: lap.flying_lap_time_s
        for lap in result.laps
        if lap.flying_lap_time_s is not None
    }


def draw(record: Record, beside: References, path: Path) -> None:
    """Writes the picture (PNG), whole or not at all; none without a timed lap."""
    if not any(lap.time_s is not None for lap in record.laps):
        return
    with figure_style():
        write_png(lap_figure(record, beside), path)


def lap_figure(record: Record, beside: References) -> Figure:
    """Laps as points, those from rest hollow; at the lower edge, the weights between them.

    A lap that takes far longer than the others is drawn at the upper edge with its time in words.
    """
    figure = Figure(figsize=(7.2, 3.8))
    axes = figure.add_subplot()
    laps = [(lap, lap.time_s) for lap in record.laps if lap.time_s is not None]
    shown = [time_s for lap, time_s in laps if lap.flying] or [time_s for _, time_s in laps]
    shown += beside.values()
    usual = [time_s for time_s in shown if time_s <= _FAR * float(np.median(shown))]
    ceiling = max(usual) + 0.3 * max(max(usual) - min(usual), 0.02 * max(usual))
    line = [(lap.lap, time_s) for lap, time_s in laps if lap.flying and time_s <= ceiling]
    if line:
        axes.plot(*zip(*line, strict=True), color=INK, linewidth=1, zorder=2)
    for lap, time_s in laps:
        _point(axes, lap, time_s, ceiling)
    for controller, time_s in beside.items():
        axes.axhline(time_s, color=look(controller).colour, linewidth=1, linestyle="--", zorder=1)
    _updates(axes, record)
    axes.set_xlabel("lap")
    axes.set_ylabel("lap time [s]")
    axes.set_title("Lap time while learning")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    axes.yaxis.set_major_formatter(ScalarFormatter(useOffset=False))
    axes.set_xlim(0.4, max(len(record.laps), 1) + 0.6)
    axes.margins(y=0.12)
    _legend(figure, record, beside)
    figure.subplots_adjust(left=0.1, right=0.98, top=0.9, bottom=0.26)
    return figure


def _point(axes: Axes, lap: LapRecord, time_s: float, ceiling: float) -> None:
    off, above = bool(lap.off_track_m), time_s > ceiling
    edge = WARNING if off else INK if lap.flying else MUTED
    axes.plot(
        lap.lap, min(time_s, ceiling), "^" if above else "o", markersize=4.5, zorder=3,
        markeredgecolor=edge, markerfacecolor=edge if lap.flying else "white",
    )  # fmt: skip
    if above:
        axes.annotate(
            f"{time_s:.2f} s", (lap.lap, ceiling), xytext=(5, 0), va="center",
            textcoords="offset points", fontsize=6.5, color=edge,
        )  # fmt: skip


def _updates(axes: Axes, record: Record) -> None:
    """A tick at the lower edge where weights were taken over, a cross where they were not kept."""
    for update in record.updates:
        place = max(update.after_lap, 0) + 0.5
        good = update.verdict == "accepted"
        if good or update.verdict in ("refused", "rolled back"):
            axes.plot(
                place, 0.0, "|" if good else "x", color=look("bayesrace-updated").colour
                if good else WARNING, markersize=9 if good else 6, clip_on=False, zorder=5,
                transform=axes.get_xaxis_transform(),
            )  # fmt: skip


def _legend(figure: Figure, record: Record, beside: References) -> None:
    green = look("bayesrace-updated").colour
    verdicts = {update.verdict for update in record.updates}
    entries = [Line2D([], [], color=INK, marker="o", markersize=4, linewidth=1, label="flying lap")]
    if any(not lap.flying for lap in record.laps) and any(lap.flying for lap in record.laps):
        rest = Line2D(
            [], [], marker="o", linestyle="", markerfacecolor="white", markeredgecolor=MUTED,
            markersize=4, label="from rest",
        )  # fmt: skip
        entries.append(rest)
    if any(lap.off_track_m for lap in record.laps):
        entries.append(
            Line2D([], [], marker="o", linestyle="", color=WARNING, label="off the track")
        )
    if "accepted" in verdicts:
        entries.append(
            Line2D(
                [],
                [],
                marker="|",
                linestyle="",
                color=green,
                label="new weights taken over",
            )
        )
    if verdicts & {"refused", "rolled back"}:
        entries.append(
            Line2D([], [], marker="x", linestyle="", color=WARNING, label="refused or rolled back")
        )
    for controller, time_s in beside.items():
        style = look(controller)
        label = f"{style.name} {time_s:.3f} s"
        entries.append(Line2D([], [], color=style.colour, linewidth=1, linestyle="--", label=label))
    figure.legend(handles=entries, loc="lower center", ncols=4, fontsize=7)
