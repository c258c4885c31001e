"""``status``, ``stop``, ``go``, ``router``: operation of running plants and controllers."""

import contextlib
import json
import os
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from bayesrace.clock import die_with_parent
from bayesrace.errors import InputError
from operation.cli.configured import connect_to, current
from operation.cli.options import Endpoint, ParentPid

if TYPE_CHECKING:
    from operation.analysis.network_status import NetworkStatus
    from operation.lifecycle import Action

__all__ = ["doctor", "go", "router", "status", "stop"]

Name = Annotated[str, typer.Option(metavar="NAME", show_default="", help="Name of the car.")]
Timeout = Annotated[
    float,
    typer.Option(
        metavar="S",
        min=0.1,
        max=60.0,
        help="Time limit [s], once for finding the cars and once for their answers.",
    ),
]
Reason = Annotated[
    str, typer.Option(metavar="TEXT", help="Reason, which the controller's status then shows.")
]

_PERIOD_S = 0.2
"""Period of the display of ``status --watch``."""


def status(
    name: Name = "",
    endpoint: Endpoint = None,
    as_json: Annotated[
        bool,
        typer.Option(
            "--json", help='Print {"cars": {NAME: {"plant": ..., "controller": ...}}} instead.'
        ),
    ] = False,
    watch: Annotated[
        bool,
        typer.Option(
            "--watch", help="Update until Ctrl-C; with --json, print a line for each heartbeat."
        ),
    ] = False,
    timeout: Timeout = 2.0,
) -> None:
    """Show plants and controllers: phase, rate, deadline misses, fallbacks, counters.

    Without --name: all cars found. A process that is present and does not answer is shown as such;
    if none answers, that is an error.
    """
    from rich.live import Live

    from bayesrace.transport import open_session
    from operation.lifecycle import ask_statuses, find, follow
    from operation.terminal.status_table import StatusTable
    from operation.terminal.terminal import Terminal

    endpoints = connect_to(endpoint, "viewer")
    name = endpoints.car_named(name)
    with open_session(endpoints, "viewer") as session, _closed_pipe_allowed():
        network = ask_statuses(session, find(session, endpoints, timeout, name), timeout)
        if watch and as_json:
            for car in follow(session, network, name, 1.0):
                if car is not None:
                    _print_json(network, car)
        elif watch:
            with Live(console=Terminal(), auto_refresh=False) as live:
                for car in follow(session, network, name, _PERIOD_S):
                    if car is None:  # once a period, not for each heartbeat
                        live.update(StatusTable(network, brief=True), refresh=True)
        elif as_json:
            _print_json(network)
        else:
            Terminal().print(StatusTable(network))
    if not watch and not network.answering:
        raise InputError(
            f"no answer within {timeout:g} s from the processes found; they hang or are of another "
            "release, or the network is slow (--timeout)"
        )


def _print_json(network: "NetworkStatus", car: str | None = None) -> None:
    typer.echo(json.dumps(network.as_json(car), allow_nan=False))


@contextlib.contextmanager
def _closed_pipe_allowed() -> Iterator[None]:
    """A reader that closes the pipe (``| head -1``) is no error."""
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:
        # The rest of the buffer must not fail once more at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def stop(
    name: Name = "",
    endpoint: Endpoint = None,
    reason: Reason = "",
    all_cars: Annotated[bool, typer.Option("--all", help="All cars that are found.")] = False,
    run: Annotated[
        bool,
        typer.Option("--run", help="End the run of the plant instead, such as an abandoned one."),
    ] = False,
    timeout: Timeout = 2.0,
) -> None:
    """Brake a car to standstill and keep it there.

    Without --name: the only car found. Exit code 2 if it refuses or does not answer.
    """
    if name and all_cars:
        raise InputError("--name and --all contradict each other; give one of them")
    action: Literal["stop", "end"] = "end" if run else "stop"
    _command(action, name, endpoint, reason or "bayesrace stop", all_cars, timeout)


def go(
    name: Name = "", endpoint: Endpoint = None, reason: Reason = "", timeout: Timeout = 2.0
) -> None:
    """Let a stopped or held controller drive.

    Without --name: the only car found. Exit code 2 if it refuses or does not answer.
    """
    _command("go", name, endpoint, reason or "bayesrace go", False, timeout)


def _command(
    action: "Action",
    name: str,
    endpoint: list[str] | None,
    reason: str,
    all_cars: bool,
    timeout: float,
) -> None:
    from bayesrace.messages import Reply
    from bayesrace.transport import open_session
    from operation.lifecycle import command, find, pick
    from operation.terminal.printable import printable

    endpoints = connect_to(endpoint, "director")
    name = endpoints.car_named(name)
    with open_session(endpoints, "director") as session:
        source = "plant" if action == "end" else "controller"
        cars = pick(find(session, endpoints, timeout, name, (source,)), name, all_cars, source)
        answers = command(session, cars, action, reason, timeout)
    failures = []
    for car, answer in answers.items():
        if isinstance(answer, Reply) and answer.accepted:
            typer.echo(f"{car}: {printable(answer.text)}")
        else:
            why = f"refused: {answer.text}" if isinstance(answer, Reply) else f"failed: {answer}"
            failures.append(f"{action} of car '{car}' {printable(why)}")
    if failures:
        raise InputError("; ".join(failures))


def doctor() -> None:
    """Say why processes do not meet: certificates, endpoints, access control, cars.

    Tries everything as a process of this machine would. Exit code 1 if something is wrong.
    """
    from operation.doctor import examine
    from operation.terminal.printable import printable

    faults = 0
    for check in examine(current()):
        faults += not check.fine
        typer.echo(f"{'ok' if check.fine else 'FAULT':<6} {printable(check.text)}")
    if faults:
        raise typer.Exit(1)


def router(
    listen: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ENDPOINT",
            show_default="as configured",
            help="Zenoh endpoint to listen on; repeatable.",
        ),
    ] = None,
    connect: Annotated[
        list[str] | None,
        typer.Option(metavar="ENDPOINT", help="Endpoint of another router; repeatable."),
    ] = None,
    parent_pid: ParentPid = None,
) -> None:
    """Forward messages between all processes that connect to it, until Ctrl-C.

    Each plant, controller or command then needs this one endpoint only: for several cars in one
    network, and for machines that cannot reach each other directly.
    """
    die_with_parent(parent_pid)
    from operation.lifecycle import route

    endpoints = current().endpoints("router", listen=listen or None, connect=connect or None)
    if not endpoints.listen:
        raise InputError("a router needs an endpoint: give --listen, or [network] router")
    route(endpoints)
