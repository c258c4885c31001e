"""``plant`` and ``controller``, to be run side by side or on two machines, ``router`` between them,
and commands for those that run: ``status``, ``stop``, ``go``, ``doctor``."""

import logging
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import typer

from bayesrace.errors import InputError, TransientError
from bayesrace.operation.cli import options
from bayesrace.operation.cli.declaration import Given, options_of
from bayesrace.processes import die_with_parent

if TYPE_CHECKING:
    from bayesrace.configuration import Configuration
    from bayesrace.controller.interface import Controller
    from bayesrace.controller.process_settings import ControllerSettings
    from bayesrace.messages import Role
    from bayesrace.operation.lifecycle import Action
    from bayesrace.plant.process_settings import PlantSettings
    from bayesrace.transport import Endpoints

__all__ = ["bridge", "controller", "doctor", "go", "plant", "router", "status", "stop"]

_log = logging.getLogger("bayesrace.links")

_NAME: Final = options.value("Name of the car.", "")
_REASON: Final = options.value(
    "Reason, which the controller's status then shows.", "", metavar="TEXT"
)
_TIMEOUT: Final = options.value(
    "Time limit [s], once for finding the cars and once for their answers.",
    2.0,
    metavar="S",
    min=0.1,
    max=60.0,
)


def _endpoint(text: str, shown: str = "as configured") -> Any:
    return options.value(text, (), metavar="ENDPOINT", shown=shown)


@options_of(
    "bayesrace.plant.process_settings.PlantSettings",
    "car name rate_hz fmu fmu_map simulator delay_s buffer_s sensors sensor_faults world seed "
    "realtime.cpu realtime.fifo realtime.lock_memory",
)
def plant(
    network: "Configuration",
    settings: "Given[PlantSettings]",
    endpoint: list[str] = _endpoint(
        "Zenoh endpoint to listen on; repeatable.", "as configured; tcp/127.0.0.1:7447"
    ),
    connect: list[str] = _endpoint("Endpoint to connect to, as of a router; repeatable."),
    low_latency: bool = options.LOW_LATENCY,
    parent_pid: int | None = options.PARENT_PID,
) -> None:
    """Simulate the car: waits for runs, as of 'bayesrace drive', until Ctrl-C."""
    die_with_parent(parent_pid)
    from bayesrace.codegen.compiler import compiled
    from bayesrace.plant.process import main

    endpoints = _once_valid(
        network, "plant", listen=endpoint, connect=connect, low_latency=low_latency
    )
    chosen = settings(
        endpoints=endpoints, hold_to_run=network.drive.hold_to_run, parent_pid=parent_pid
    )
    raise typer.Exit(main(chosen, compiled))


@options_of(
    "bayesrace.controller.process_settings.ControllerSettings",
    "car name shadow rate_hz budget hold compensation fallback.shifted_s sensor_tolerance "
    "realtime.cpu realtime.fifo realtime.lock_memory",
)
def controller(
    network: "Configuration",
    settings: "Given[ControllerSettings]",
    track: str = options.TRACK_GIVEN,
    raceline: Path = options.RACELINE,
    artefact: Path = options.value("Folder that 'bayesrace build' printed.", ..., metavar="DIR"),
    weights: Path | None = options.WEIGHTS,
    mpc: Path | None = options.MPC,
    store: Path | None = options.value(
        "Folder that keeps accepted weights for the next start.", metavar="DIR"
    ),
    endpoint: list[str] = _endpoint(
        "Zenoh endpoint of the plant, for a shadow of the controller, too; repeatable.",
        "as configured; tcp/127.0.0.1:7447",
    ),
    listen: list[str] = _endpoint(
        "Zenoh endpoint to listen on, for recorders and senders of weights; repeatable.",
        "as configured; tcp/127.0.0.1:7448",
    ),
    gate: Path | None = options.value("Thresholds for new weights (JSON): docs/learning.md."),
    pursuit: float | None = options.value(
        "Drive by pure pursuit instead, at this share of the line's speed: the first drive of a "
        "real car, and training data.",
        metavar="SHARE",
        min=0.05,
        max=2.0,
    ),
    low_latency: bool = options.LOW_LATENCY,
    parent_pid: int | None = options.PARENT_PID,
) -> None:
    """Drive the car of a plant process with the compiled controller, until Ctrl-C."""
    die_with_parent(parent_pid)
    from bayesrace.controller import process, shadow
    from bayesrace.controller.assembly import predictive_controller, read_settings
    from bayesrace.controller.settings import GateSettings

    role: Role = "shadow" if settings().shadow else "controller"
    if role == "shadow" and (store or settings().hold):
        raise InputError(f"a shadow drives nothing: leave out {'--store' if store else '--hold'}")
    endpoints = _once_valid(network, role, listen=listen, connect=endpoint, low_latency=low_latency)
    thresholds = read_settings(gate, GateSettings)
    chosen = settings(endpoints=endpoints, gate=thresholds, parent_pid=parent_pid)
    if pursuit is None:
        driver: Controller = predictive_controller(
            artefact, chosen.car, track, raceline, mpc, weights, store, chosen.gate
        )
    elif given := [one for one in (mpc, weights, store, gate) if one is not None]:
        raise InputError(f"--pursuit drives without {given[0]}: leave out one of them")
    else:
        from bayesrace.operation.collect import pursuit_controller

        driver = pursuit_controller(
            artefact, chosen.car, track, raceline, pursuit, 1 / chosen.rate_hz
        )
    main = shadow.main if role == "shadow" else process.main
    raise typer.Exit(main(chosen, driver))


def bridge(
    network: "Configuration",
    link: str = options.argument("LINK", "udp:ADDRESS:PORT or unix:PATH of the controller."),
    track: str = options.TRACK_GIVEN,
    car: str = options.CAR,
    name: str = _NAME,
    rate: float = options.value("The controller's own --rate [Hz].", 50.0, min=1.0, max=500.0),
    endpoint: list[str] = _endpoint(
        "Zenoh endpoint of the plant; repeatable.", "as configured; tcp/127.0.0.1:7447"
    ),
    listen: list[str] = _endpoint(
        "Zenoh endpoint to listen on, for recorders; repeatable.",
        "as configured; tcp/127.0.0.1:7448",
    ),
    parent_pid: int | None = options.PARENT_PID,
) -> None:
    """Join the network on behalf of a controller without Python, until Ctrl-C."""
    die_with_parent(parent_pid)
    from bayesrace.controller.bridge import main
    from bayesrace.tracks import load_track
    from bayesrace.vehicles import get_car

    driven = get_car(car)
    endpoints = _once_valid(network, "controller", listen=listen, connect=endpoint)
    identity = load_track(track, driven.width_m).identity
    raise typer.Exit(main(name or driven.name, endpoints, link, identity, rate, parent_pid))


def router(
    network: "Configuration",
    listen: list[str] = _endpoint("Zenoh endpoint to listen on; repeatable."),
    connect: list[str] = _endpoint("Endpoint of another router; repeatable.", shown="none"),
    parent_pid: int | None = options.PARENT_PID,
) -> None:
    """Forward messages between all processes that connect to it, until Ctrl-C.

    Each plant, controller or command then needs this one endpoint only: for several cars in one
    network, and for machines that cannot reach each other directly.
    """
    die_with_parent(parent_pid)
    from bayesrace.operation.lifecycle import route

    endpoints = _once_valid(network, "router", listen=listen, connect=connect)
    if not endpoints.listen:
        raise InputError("a router needs an endpoint: give --listen, or [network] router")
    route(endpoints)


def _once_valid(network: "Configuration", role: "Role", **where: Any) -> "Endpoints":
    """The endpoints of a process, once its certificate is valid.

    The log says once what is wrong with it: somebody may renew or copy it, and the clock of a board
    may be set after its start.
    """
    said = ""
    while True:
        try:
            return network.endpoints(role, **where)
        except TransientError as error:
            text = str(error)
        if (fault := text.partition(": ")[0]) != said:  # what follows has the time in it
            _log.warning("%s; this waits until then", text)
        said = fault
        time.sleep(1.0)


def status(
    viewer: "Endpoints",
    name: str = _NAME,
    as_json: bool = options.flag(
        "--json", 'Print {"cars": {NAME: {"plant": ..., "controller": ...}}} instead.'
    ),
    watch: bool = options.flag(
        "--watch", "Update until Ctrl-C; with --json, print a line for each heartbeat."
    ),
    timeout: float = _TIMEOUT,
) -> None:
    """Show plants and controllers: phase, rate, deadline misses, fallbacks, counters.

    Without --name: all cars found. A process that is present and does not answer is shown as such;
    if none answers, that is an error.
    """
    from bayesrace.operation.terminal.status_table import show_status

    show_status(viewer, name, timeout, watch, as_json)


def stop(
    director: "Endpoints",
    name: str = _NAME,
    reason: str = _REASON,
    all_cars: bool = options.flag("--all", "All cars that are found."),
    run: bool = options.flag("--run", "End the plant's run instead, such as an abandoned one."),
    timeout: float = _TIMEOUT,
) -> None:
    """Brake a car to standstill and keep it there.

    Without --name: the only car found. Exit code 2 if it refuses or does not answer.
    """
    if name and all_cars:
        raise InputError("--name and --all contradict each other; give one of them")
    action: Action = "end" if run else "stop"
    _command(action, name, director, reason or "bayesrace stop", all_cars, timeout)


def go(
    director: "Endpoints",
    name: str = _NAME,
    reason: str = _REASON,
    timeout: float = _TIMEOUT,
) -> None:
    """Let a stopped or held controller drive.

    Without --name: the only car found. Exit code 2 if it refuses or does not answer.
    """
    _command("go", name, director, reason or "bayesrace go", False, timeout)


def _command(
    action: "Action", name: str, endpoints: "Endpoints", reason: str, all_cars: bool, timeout: float
) -> None:
    from bayesrace.operation.lifecycle import command_cars
    from bayesrace.operation.terminal import printable

    done, failed = command_cars(endpoints, action, name, all_cars, reason, timeout)
    for answer in done:
        typer.echo(printable(answer))
    if failed:
        raise InputError("; ".join(failed))


def doctor(network: "Configuration") -> None:
    """Say why processes do not meet: certificates, endpoints, access control, cars.

    Tries everything as a process of this machine would. Exit code 1 if something is wrong.
    """
    from bayesrace.operation.doctor import examine
    from bayesrace.operation.terminal import printable

    faults = 0
    for check in examine(network):
        faults += not check.fine
        typer.echo(f"{'ok' if check.fine else 'FAULT':<6} {printable(check.text)}")
    if faults:
        raise typer.Exit(1)
