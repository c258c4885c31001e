"""The state of all cars on the terminal: a table of numbers, and below it each latest message."""

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final, Literal

from rich.console import Console, ConsoleOptions, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from bayesrace.errors import InputError
from bayesrace.messages import Status
from bayesrace.operation.lifecycle import (
    SOURCES,
    NetworkStatus,
    ProcessStatus,
    ask_statuses,
    find,
    follow,
)
from bayesrace.operation.terminal import printable
from bayesrace.operation.terminal.terminal import Terminal, plain_table
from bayesrace.transport import Endpoints, open_session

__all__ = ["COUNTERS_SHOWN", "StatusTable", "show_status"]

_PERIOD_S: Final = 0.2
"""Period of the display that follows the cars."""

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


def show_status(
    endpoints: Endpoints, name: str, timeout_s: float, watch: bool, as_json: bool
) -> None:
    """Prints the state of a car, or of all (""), once or with ``watch`` until a signal; as a line
    of JSON each time, or as a table. InputError if no process answers."""
    name = endpoints.car_named(name)
    with (
        open_session(endpoints, "viewer", reports_absence=False) as session,
        _closed_pipe_allowed(),
    ):
        found = ask_statuses(session, find(session, endpoints, timeout_s, name), timeout_s)
        if watch and as_json:
            for car in follow(session, found, name, 1.0):
                if car is not None:
                    _print_json(found, car)
        elif watch:
            with Live(console=Terminal(), auto_refresh=False) as live:
                for car in follow(session, found, name, _PERIOD_S):
                    if car is None:  # once a period, not for each heartbeat
                        live.update(StatusTable(found, brief=True), refresh=True)
        elif as_json:
            _print_json(found)
        else:
            Terminal().print(StatusTable(found))
    if not watch and not found.answering:
        raise InputError(
            f"no answer within {timeout_s:g} s from the processes found; they hang or are of "
            "another release, or the network is slow (--timeout)"
        )


def _print_json(found: NetworkStatus, car: str | None = None) -> None:
    sys.stdout.write(json.dumps(found.as_json(car), allow_nan=False) + "\n")
    sys.stdout.flush()


@contextmanager
def _closed_pipe_allowed() -> Iterator[None]:
    """A reader that closes the pipe (``| head -1``) is no error."""
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:
        # The rest of the buffer must not fail once more at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


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
