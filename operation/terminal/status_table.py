"""The state of all cars on the terminal: a table of numbers, and below it each latest message."""

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from rich.console import Group, RenderableType
from rich.live import Live
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

__all__ = ["COUNTERS_SHOWN", "show_status", "status_table"]

_PERIOD_S: Final = 0.2
"""Period of the display that follows the cars."""

_VALUES: Final = (
    "state",
    "rate Hz",
    "last state ms ago",
    "weights",
    "deadline misses",
    "fallbacks plan/brake/stop",
    "delay ms",
    "messages refused/lost/stale",
)
"""Shown of each process, in the order of :func:`_values`."""

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
                        live.update(status_table(found, brief=True), refresh=True)
        elif as_json:
            _print_json(found)
        else:
            Terminal().print(status_table(found))
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


def status_table(network: NetworkStatus, *, brief: bool = False) -> Group:
    """A table for each car with a column for each process, and the latest messages, for rich to
    print; ``brief`` cuts each message to a line."""
    cars = {
        car: [(source, processes[source]) for source in SOURCES if source in processes]
        for car, processes in network.cars.items()
    }
    if not cars:
        return Group("no process is present any more")
    shown: list[RenderableType] = []
    for car, processes in cars.items():
        sources = [source for source, _ in processes]
        table = plain_table(printable(car), *sources, left=1 + len(sources))
        columns = [_values(source, process) for source, process in processes]
        for title, *values in zip(_VALUES, *columns, strict=True):
            table.add_row(title, *values)
        shown += [table, ""]
    for car, processes in cars.items():
        for source, process in processes:
            text = _message(f"{car} {source}", process)
            text.no_wrap, text.overflow = brief, "ellipsis" if brief else "fold"
            shown.append(text)
    return Group(*shown)


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
