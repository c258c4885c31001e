"""The state of all cars on the terminal: numbers in a table, and below it what each said last."""

from collections.abc import Iterator
from typing import Final, Literal

from rich import box
from rich.console import Console, ConsoleOptions, RenderableType
from rich.table import Table
from rich.text import Text

from bayesrace.messages import Status
from experiments.picture import SOURCES, Picture, Process
from experiments.printable import printable

__all__ = ["COUNTERS_SHOWN", "StatusTable"]

_ROWS: Final[tuple[tuple[str, Literal["left", "right"]], ...]] = (
    ("state", "left"),
    ("rate\nHz", "right"),
    ("last state\nms ago", "right"),
    ("weights", "left"),
    ("deadline\nmisses", "right"),
    ("fallbacks\nplan/brake/stop", "right"),
    ("delay\nms", "right"),
    ("messages\nrefused/lost/stale", "right"),
)
"""What is told of each process: a column of the wide table, a row of the narrow one."""

_WIDE: Final = 115
"""Columns of a terminal that the wide table fits into, names being short."""

_COLOURS: Final = {
    "driving": "green", "running": "green", "fallback": "red", "stopped": "yellow",
    "waiting": "yellow", "ready": "cyan", "idle": "cyan",
}  # fmt: skip

COUNTERS_SHOWN: Final = {
    "controller": (
        ("deadline_misses",),
        ("shifted_plan", "brake", "stop"),
        ("refused", "states_lost", "states_stale"),
    ),
    "plant": (("overruns",), ("", "braked", ""), ("refused", "actuations_lost", "stale")),
}
"""Of each process, what is shown under misses, fallbacks, and messages."""


class StatusTable:
    """All that is known, for rich to print: a row per process, or a column where that is too wide.

    ``brief`` cuts what processes said to a line each.
    """

    def __init__(self, picture: Picture, *, brief: bool = False) -> None:
        self._cars = picture.cars
        self._brief = brief

    def __rich_console__(
        self, console: Console, options: ConsoleOptions
    ) -> Iterator[RenderableType]:
        if not self._cars:
            yield "nobody is there any more"
        elif options.max_width >= _WIDE:
            yield self._wide()
            yield ""
        else:
            for car, processes in self._cars.items():
                yield _narrow(car, processes)
                yield ""
        for car, processes in self._cars.items():
            for source, process in _in_order(processes):
                said = _said(f"{car} {source}", process)
                said.no_wrap, said.overflow = self._brief, "ellipsis" if self._brief else "fold"
                yield said

    def _wide(self) -> Table:
        table = Table(box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False, show_edge=False)
        table.add_column("car", overflow="fold")
        table.add_column("process")
        for title, justify in _ROWS:
            table.add_column(title, justify=justify)
        for car, processes in self._cars.items():
            for source, process in _in_order(processes):
                table.add_row(printable(car), source, *_cells(source, process))
        return table


def _narrow(car: str, processes: dict[str, Process]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False, show_edge=False)
    table.add_column(printable(car))
    columns = [_cells(source, process) for source, process in _in_order(processes)]
    for source, _ in _in_order(processes):
        table.add_column(source)
    for i, (title, _) in enumerate(_ROWS):
        cells = (column[i] if i < len(column) else "" for column in columns)
        table.add_row(title.replace("\n", " "), *cells)
    return table


def _in_order(processes: dict[str, Process]) -> list[tuple[str, Process]]:
    return [(source, processes[source]) for source in SOURCES if source in processes]


def _cells(source: str, process: Process) -> list[Text | str]:
    status = process.status
    if status is None:
        return [Text("no answer", style="red")]
    phase = Text(status.phase, style=_COLOURS.get(status.phase, ""))
    if process.processes > 1:
        phase.append(f" ×{process.processes}", style="red")
    misses, fallbacks, messages = (
        "/".join(_count(status, name) for name in names) for names in COUNTERS_SHOWN[source]
    )
    return [
        phase,
        f"{status.rate_hz:g}" if status.rate_hz else "lockstep",
        "–" if status.state_age_s < 0 else f"{status.state_age_s * 1e3:.0f}",
        Text(printable(status.weights_version) or "–"),
        misses,
        fallbacks,
        f"{status.delay_s * 1e3:.1f}",
        messages,
    ]


def _count(status: Status, name: str) -> str:
    return str(status.counters.get(name, "–"))


def _said(who: str, process: Process) -> Text:
    """A line about the process."""
    words = process.fault if process.status is None else process.status.text
    if process.processes > 1:
        words = f"{process.processes} processes answer to this name; end all but one. {words}"
    return Text.assemble((f"{printable(who)}: ", "bold"), printable(words) or "nothing to say")
