"""Shows the record of a learning job: a table on the terminal, and lap time against lap number."""

from itertools import groupby
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from rich.console import Console
from rich.text import Text

from bayesrace.operation.learn.records import LapRecord, Record, UpdateRecord
from bayesrace.operation.look import look
from bayesrace.operation.report.style import INK, MUTED, WARNING, figure_style, write_png
from bayesrace.operation.terminal.terminal import Terminal, plain_table

__all__ = ["draw", "print_laps"]

_MOST_ROWS: Final = 40


def print_laps(record: Record, console: Console | None = None) -> None:
    """Prints a row for each of the last laps, with the update that followed it."""
    console = console or Terminal()
    updates = {after: [*some] for after, some in groupby(record.updates, lambda one: one.after_lap)}
    table = plain_table("lap", "time\ns", "new", "of", "in\ns", "weights", "controller", left=0)
    for column in table.columns[-2:]:
        column.justify = "left"
    for update in updates.get(0, []):
        table.add_row("–", "", "", *_cells(update))
    for lap in record.laps[-_MOST_ROWS:]:
        after = updates.get(lap.lap, [])
        table.add_row(str(lap.lap), _time(lap), str(lap.samples), *_cells(next(iter(after), None)))
        for update in after[1:]:
            table.add_row("", "", "", *_cells(update))
    if len(record.laps) > _MOST_ROWS:
        console.print(Text(f"the last {_MOST_ROWS} of {len(record.laps)} laps"))
    console.print(table)
    notes = ["new: samples of the lap; of: samples learned from; in: training time"]
    if any(not lap.flying or lap.off_track_m for lap in record.laps):
        notes.append("*: from rest; !: off the track")
    if any(update.verdict == "pending" for update in record.updates):
        notes.append("pending: no controller has accepted or refused; sent when the job resumes")
    for note in (*notes, *(f"nothing to learn from: {remark}" for remark in record.remarks)):
        console.print(Text(note))


def _time(lap: LapRecord) -> str:
    if lap.time_s is None:
        return "–"
    return f"{lap.time_s:.3f}" + ("" if lap.flying else "*") + ("!" if lap.off_track_m else "")


def _cells(update: UpdateRecord | None) -> list[str]:
    if update is None:
        return []
    cycle = "" if update.cycle is None else f", cycle {update.cycle}"
    learned = [str(update.samples), f"{update.training_s:.1f}"] if update.samples else ["", ""]
    return [*learned, update.version, update.verdict + cycle]


def draw(record: Record, path: Path) -> None:
    """Writes the figure (PNG), whole or not at all; none without a timed lap.

    A line joins flying laps; the weights are at the lower edge, between the laps. A lap that takes
    far longer than the others is at the upper edge, with its time as a text.
    """
    laps = [lap for lap in record.laps if lap.time_s is not None]
    if not laps:
        return
    number, time_s = np.array([(lap.lap, lap.time_s) for lap in laps]).T
    flying = np.array([lap.flying for lap in laps])
    off_track = np.array([bool(lap.off_track_m) for lap in laps])
    shown = time_s[flying] if flying.any() else time_s[:1]
    usual = shown[shown <= 1.25 * np.median(shown)]
    top = usual.max() + max(0.3 * np.ptp(usual), 0.006 * usual.max())
    with figure_style():
        figure = Figure(figsize=(7.2, 3.8))
        axes = figure.add_subplot(
            xlabel="lap", ylabel="lap time [s]", title="Lap time while learning"
        )
        line = flying & (time_s <= top)
        axes.plot(number[line], time_s[line], color=INK, linewidth=1)
        for label, colour, fill, rows in (
            ("flying lap", INK, INK, flying),
            ("from rest", MUTED, "white", ~flying),
            ("off the track", WARNING, "none", off_track),
        ):
            axes.plot(
                number[rows], np.minimum(time_s[rows], top), "o", markersize=4.5,
                markeredgecolor=colour, markerfacecolor=fill, label=label if rows.any() else None,
            )  # fmt: skip
        for k in np.flatnonzero(time_s > top):
            text = f"↑ {time_s[k]:.2f} s\n"
            axes.annotate(text, (number[k], top), ha="center", fontsize=6.5)
        green = look("bayesrace-updated").colour
        for label, marker, colour, verdicts in (
            ("new weights taken over", "|", green, {"accepted"}),
            ("refused or rolled back", "x", WARNING, {"refused", "rolled back"}),
        ):
            at = [one.after_lap + 0.5 for one in record.updates if one.verdict in verdicts]
            axes.plot(
                at, [0.0] * len(at), marker, markersize=8, color=colour, clip_on=False,
                transform=axes.get_xaxis_transform(), label=label if at else None,
            )  # fmt: skip
        axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
        axes.ticklabel_format(axis="y", useOffset=False)
        axes.set_xlim(0.4, len(record.laps) + 0.6)
        axes.margins(y=0.12)
        figure.legend(loc="lower center", ncols=4, fontsize=7)
        figure.subplots_adjust(left=0.1, right=0.98, top=0.9, bottom=0.26)
        write_png(figure, path)
