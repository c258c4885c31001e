"""What a learning job did, on the terminal."""

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from experiments.learn.journal import LapRecord, Record, UpdateRecord
from experiments.terminal import Terminal

__all__ = ["print_laps"]

_MOST: int = 40
"""Rows; of more, the last ones."""


def print_laps(record: Record, console: Console | None = None) -> None:
    """A row for each lap, with the update that followed it."""
    console = console or Terminal()
    updates = {update.after_lap: update for update in record.updates}
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False)
    for title in ("lap", "time\ns", "new", "of", "in\ns"):
        table.add_column(title, justify="right", no_wrap=True)
    for title in ("weights", "controller"):
        table.add_column(title, no_wrap=True)
    if first := updates.get(0):
        table.add_row("–", "", "", *_update_cells(first))
    for lap in record.laps[-_MOST:]:
        update = updates.get(lap.lap)
        cells = ["", "", "", ""] if update is None else _update_cells(update)
        table.add_row(str(lap.lap), _time(lap), str(lap.samples), *cells)
    if len(record.laps) > _MOST:
        console.print(Text(f"the last {_MOST} of {len(record.laps)} laps"))
    console.print(table)
    console.print(Text("new: samples of the lap; of: samples learned from; in: training time"))
    if any(not lap.flying or lap.off_track_m for lap in record.laps):
        console.print(Text("*: from rest; !: off the track"))
    if any(update.verdict == "waiting" for update in record.updates):
        console.print(
            Text("waiting: no controller has answered for good; sent when the job is gone on with")
        )
    for remark in record.remarks:
        console.print(Text(f"nothing to learn from: {remark}"))


def _time(lap: LapRecord) -> str:
    if lap.time_s is None:
        return "–"
    return f"{lap.time_s:.3f}" + ("" if lap.flying else "*") + ("!" if lap.off_track_m else "")


def _update_cells(update: UpdateRecord) -> list[str]:
    cycle = "" if update.cycle is None else f", cycle {update.cycle}"
    learned = [str(update.samples), f"{update.training_s:.1f}"] if update.samples else ["", ""]
    return [*learned, update.version, update.verdict + cycle]
