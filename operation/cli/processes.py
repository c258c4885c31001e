"""``plant`` and ``controller``, to be run side by side or on two machines, ``router`` between them,
and commands for those that run: ``status``, ``stop``, ``go``, ``doctor``."""

import contextlib
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from bayesrace.clock import die_with_parent
from bayesrace.errors import InputError
from operation.cli import options
from operation.cli.fields import Given, options_of

if TYPE_CHECKING:
    from bayesrace.configuration import Configuration
    from bayesrace.transport import Endpoints
    from controller.process_settings import ControllerSettings
    from operation.analysis.network_status import NetworkStatus
    from operation.lifecycle import Action
    from plant.process_settings import PlantSettings

__all__ = ["controller", "doctor", "go", "plant", "router", "status", "stop"]

Name = Annotated[str, typer.Option(show_default="", help="Name of the car.")]
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


def _endpoint(text: str, default: object = (), shown: str = "as configured") -> Any:
    return options.value(text, default, metavar="ENDPOINT", shown=shown)


@options_of(
    "plant.process_settings.PlantSettings",
    "car name rate_hz fmu fmu_map simulator delay_s noise seed realtime.cpu realtime.fifo "
    "realtime.lock_memory",
)
def plant(
    network: "Configuration",
    settings: "Given[PlantSettings]",
    endpoint: str | None = _endpoint(
        "Zenoh endpoint to listen on.", None, "as configured; tcp/127.0.0.1:7447"
    ),
    connect: list[str] = _endpoint("Endpoint to connect to, as of a router; repeatable."),
    low_latency: options.LowLatency = False,
    parent_pid: options.ParentPid = None,
) -> None:
    """Simulate the car: waits for runs, as of 'bayesrace drive', until Ctrl-C."""
    die_with_parent(parent_pid)
    from codegen.compiler import compiled
    from plant.process import main

    endpoints = network.endpoints(
        "plant",
        listen=None if endpoint is None else (endpoint,),
        connect=connect or None,
        low_latency=low_latency,
    )
    realtime = network.realtime.model_dump()
    chosen = settings({"realtime": realtime}, endpoints=endpoints, parent_pid=parent_pid)
    raise typer.Exit(main(chosen, compiled))


@options_of(
    "controller.process_settings.ControllerSettings",
    "car name rate_hz budget hold sensor_tolerance realtime.cpu realtime.fifo realtime.lock_memory",
)
def controller(
    network: "Configuration",
    settings: "Given[ControllerSettings]",
    track: options.TrackName,
    raceline: options.RaceLineFile,
    artefact: Path = options.value("Folder that 'bayesrace build' printed.", ..., metavar="DIR"),
    weights: options.Weights = None,
    mpc: options.MpcFile = None,
    store: Path | None = options.value(
        "Folder that keeps accepted weights for the next start.", metavar="DIR"
    ),
    endpoint: list[str] = _endpoint(
        "Zenoh endpoint of the plant.", shown="as configured; tcp/127.0.0.1:7447"
    ),
    listen: str | None = _endpoint(
        "Zenoh endpoint to listen on, for recorders and senders of weights.",
        None,
        "as configured; tcp/127.0.0.1:7448",
    ),
    delay: str = options.value(
        "Delay over which the state is predicted: measured, off, or milliseconds.", "measured"
    ),
    gate: Path | None = options.value("Thresholds for new weights (JSON): docs/learning.md."),
    low_latency: options.LowLatency = False,
    parent_pid: options.ParentPid = None,
) -> None:
    """Drive the car of a plant process with the compiled controller, until Ctrl-C."""
    die_with_parent(parent_pid)
    from controller.assembly import predictive_controller, read_settings
    from controller.process import main
    from controller.weights.settings import GateSettings

    endpoints = network.endpoints(
        "controller",
        listen=None if listen is None else (listen,),
        connect=endpoint or None,
        low_latency=low_latency,
    )
    chosen = settings(
        {"realtime": network.realtime.model_dump()},
        endpoints=endpoints,
        compensation=_compensation(delay),
        gate=read_settings(gate, GateSettings),
        parent_pid=parent_pid,
    )
    driver = predictive_controller(
        artefact, chosen.car, track, raceline, mpc, weights, store, chosen.gate
    )
    raise typer.Exit(main(chosen, driver))


def _compensation(delay: str) -> dict[str, str | float]:
    """The option's words as :class:`controller.cycle_settings.CompensationSettings`."""
    if delay in ("measured", "off"):
        return {"mode": delay}
    try:
        return {"mode": "fixed", "delay_s": float(delay) * 1e-3}
    except ValueError:
        raise InputError(
            f"--delay {delay}: give 'measured', 'off', or a number of milliseconds"
        ) from None


def router(
    network: "Configuration",
    listen: list[str] = _endpoint("Zenoh endpoint to listen on; repeatable."),
    connect: list[str] = _endpoint("Endpoint of another router; repeatable.", shown="none"),
    parent_pid: options.ParentPid = None,
) -> None:
    """Forward messages between all processes that connect to it, until Ctrl-C.

    Each plant, controller or command then needs this one endpoint only: for several cars in one
    network, and for machines that cannot reach each other directly.
    """
    die_with_parent(parent_pid)
    from operation.lifecycle import route

    endpoints = network.endpoints("router", listen=listen or None, connect=connect or None)
    if not endpoints.listen:
        raise InputError("a router needs an endpoint: give --listen, or [network] router")
    route(endpoints)


def status(
    network: "Configuration",
    name: Name = "",
    endpoint: options.Endpoint = None,
    as_json: bool = options.flag(
        "--json", 'Print {"cars": {NAME: {"plant": ..., "controller": ...}}} instead.'
    ),
    watch: bool = options.flag(
        "--watch", "Update until Ctrl-C; with --json, print a line for each heartbeat."
    ),
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

    endpoints = network.endpoints("viewer", connect=endpoint or None)
    name = endpoints.car_named(name)
    with open_session(endpoints, "viewer") as session, _closed_pipe_allowed():
        found = ask_statuses(session, find(session, endpoints, timeout, name), timeout)
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
            f"no answer within {timeout:g} s from the processes found; they hang or are of another "
            "release, or the network is slow (--timeout)"
        )


def _print_json(found: "NetworkStatus", car: str | None = None) -> None:
    typer.echo(json.dumps(found.as_json(car), allow_nan=False))


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
    network: "Configuration",
    name: Name = "",
    endpoint: options.Endpoint = None,
    reason: Reason = "",
    all_cars: bool = options.flag("--all", "All cars that are found."),
    run: bool = options.flag("--run", "End the plant's run instead, such as an abandoned one."),
    timeout: Timeout = 2.0,
) -> None:
    """Brake a car to standstill and keep it there.

    Without --name: the only car found. Exit code 2 if it refuses or does not answer.
    """
    if name and all_cars:
        raise InputError("--name and --all contradict each other; give one of them")
    where = network.endpoints("director", connect=endpoint or None)
    action: Action = "end" if run else "stop"
    _command(action, name, where, reason or "bayesrace stop", all_cars, timeout)


def go(
    network: "Configuration",
    name: Name = "",
    endpoint: options.Endpoint = None,
    reason: Reason = "",
    timeout: Timeout = 2.0,
) -> None:
    """Let a stopped or held controller drive.

    Without --name: the only car found. Exit code 2 if it refuses or does not answer.
    """
    where = network.endpoints("director", connect=endpoint or None)
    _command("go", name, where, reason or "bayesrace go", False, timeout)


def _command(
    action: "Action",
    name: str,
    endpoints: "Endpoints",
    reason: str,
    all_cars: bool,
    timeout: float,
) -> None:
    from bayesrace.messages import Reply
    from bayesrace.transport import open_session
    from operation.lifecycle import command, find, pick
    from operation.terminal.printable import printable

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


def doctor(network: "Configuration") -> None:
    """Say why processes do not meet: certificates, endpoints, access control, cars.

    Tries everything as a process of this machine would. Exit code 1 if something is wrong.
    """
    from operation.doctor import examine
    from operation.terminal.printable import printable

    faults = 0
    for check in examine(network):
        faults += not check.fine
        typer.echo(f"{'ok' if check.fine else 'FAULT':<6} {printable(check.text)}")
    if faults:
        raise typer.Exit(1)
