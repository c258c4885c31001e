"""The state of all cars on the terminal: a table of numbers, and below it each latest message."""

from collections.abc import Iterator
from typing import Final, Literal

from rich.console import Console, ConsoleOptions, RenderableType
from rich.table import Table
from rich.text import Text

from bayesrace.messages import Status
from operation.analysis.network_status import SOURCES, NetworkStatus, ProcessStatus
from operation.terminal.printable import printable
from operation.terminal.terminal import plain_table

__all__ = ["COUNTERS_SHOWN", "StatusTable"]

_VALUES: Final[tuple[tuple[str, Literal["left", "right"]], ...]] = (
    ("state", "left"),
    ("rate\nHz", "right"),
    ("last state\nms ago", "right"),
    ("weights", "left"),
    ("deadline\nmisses", "right"),
    ("fallbacks\nplan/brake/stop", "right"),
    ("delay\nms", "right"),
    ("messages\nrefused/lost/stale", "right"),
)
"""Shown of each process: columns of the wide table, rows of the narrow ones."""

_WIDE: Final = 115
"""Columns of a terminal that the wide table fits into, if names are short."""

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
"""Counters of each process that are shown as misses, fallbacks, and messages."""


class StatusTable:
    """The network for rich to print: a row per process, or a table per car where that is too wide.

    ``brief`` cuts each message to a line.
    """

    def __init__(self, network: NetworkStatus, *, brief: bool = False) -> None:
        self._cars: dict[str, list[tuple[str, ProcessStatus]]] = {
            car: [(source, processes[source]) for source in SOURCES if source in processes]
            for car, processes in network.cars.items()
        }
        self._brief = brief

    def __rich_console__(
        self, console: Console, options: ConsoleOptions
    ) -> Iterator[RenderableType]:
        if not self._cars:
            yield "no process is present any more"
        elif options.max_width >= _WIDE:
            yield self._wide()
            yield ""
        else:
            for car, processes in self._cars.items():
                yield _narrow(car, processes)
                yield ""
        for car, processes in self._cars.items():
            for source, process in processes:
                text = _message(f"{car} {source}", process)
                text.no_wrap, text.overflow = self._brief, "ellipsis" if self._brief else "fold"
                yield text

    def _wide(self) -> Table:
        table = plain_table("car", "process", *(title for title, _ in _VALUES), left=2)
        for column, (_, justify) in zip(table.columns[2:], _VALUES, strict=True):
            column.justify, column.no_wrap = justify, justify == "right"
        for car, processes in self._cars.items():
            for source, process in processes:
                table.add_row(printable(car), source, *_values(source, process))
        return table


def _narrow(car: str, processes: list[tuple[str, ProcessStatus]]) -> Table:
    sources = [source for source, _ in processes]
    table = plain_table(printable(car), *sources, left=1 + len(sources))
    columns = [_values(source, process) for source, process in processes]
    for (title, _), *values in zip(_VALUES, *columns, strict=True):
        table.add_row(title.replace("\n", " "), *values)
    return table


def _values(source: str, process: ProcessStatus) -> list[Text | str]:
    status = process.status
    if status is None:
        return [Text("no answer", style="red"), *[""] * (len(_VALUES) - 1)]
    phase = Text(status.phase, style=_COLOURS.get(status.phase, ""))
    if process.processes > 1:
        phase.append(f" ×{process.processes}", style="red")
    misses, fallbacks, messages = (_counts(status, names) for names in COUNTERS_SHOWN[source])
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


def _counts(status: Status, names: tuple[str, ...]) -> str:
    return "/".join(str(status.counters.get(name, "–")) for name in names)


def _message(who: str, process: ProcessStatus) -> Text:
    text = process.fault if process.status is None else process.status.text
    if process.processes > 1:
        text = f"{process.processes} processes answer under this name; end all but one. {text}"
    return Text.assemble((f"{printable(who)}: ", "bold"), printable(text) or "no message")
