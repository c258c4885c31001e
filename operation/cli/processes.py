"""``plant`` and ``controller``, to be run side by side or on two machines, ``router`` between them,
commands for those that run (``status``, ``stop``, ``go``, ``doctor``), and a view for ``ros2``."""

import logging
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import typer

from bayesrace.errors import InputError, TransientError
from bayesrace.operation.cli import options
from bayesrace.operation.cli.declaration import Given, options_of
from bayesrace.processes import die_with_parent

if TYPE_CHECKING:
    from bayesrace.configuration import Configuration
    from bayesrace.controller.bridge import Updates
    from bayesrace.controller.interface import Controller
    from bayesrace.controller.process_settings import ControllerSettings
    from bayesrace.messages import Role
    from bayesrace.operation.lifecycle import Action
    from bayesrace.plant.process_settings import PlantSettings
    from bayesrace.transport import Endpoints
    from bayesrace.vehicles import Car

__all__ = ["bridge", "controller", "doctor", "go", "plant", "ros2", "router", "status", "stop"]

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

_STORE: Final = options.value(
    "Folder that keeps accepted weights for the next start.", metavar="DIR"
)
_ROS_ENDPOINT: Final = options.value(
    "Zenoh endpoint of the ROS network's router.",
    "",
    metavar="ENDPOINT",
    shown="as in the file; tcp/localhost:7447",
)
_GATE: Final = options.value("Thresholds for new weights (JSON): docs/learning.md.")


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
    hardware: str = options.value(
        "Drive a real car instead: ros2, or the file of its ROS 2 topics (TOML): docs/ros2.md.",
        "",
        metavar="ros2|FILE",
        shown="a simulated car",
    ),
    ros_endpoint: str = _ROS_ENDPOINT,
    parent_pid: int | None = options.PARENT_PID,
) -> None:
    """Simulate the car, or guard a real one: waits for runs, as of 'bayesrace drive', until Ctrl-C.

    A real car is one that speaks ROS 2; for others see docs/hardware.md.
    """
    die_with_parent(parent_pid)
    from bayesrace.codegen.compiler import compiled
    from bayesrace.plant.process import main

    endpoints = _once_valid(
        network, "plant", listen=endpoint, connect=connect, low_latency=low_latency
    )
    chosen = settings(
        endpoints=endpoints, hold_to_run=network.drive.hold_to_run, parent_pid=parent_pid
    )
    if not hardware:
        if ros_endpoint:
            raise InputError("--ros-endpoint is of a real car: add --hardware ros2")
        raise typer.Exit(main(chosen, compiled))
    if chosen.fmu is not None or chosen.simulator != "equations":
        raise InputError("a real car is not simulated: leave out --fmu, --simulator")
    from bayesrace.plant.ros2_car import Ros2Car
    from bayesrace.ros2.node import open_node
    from bayesrace.ros2.settings import Ros2Settings

    file = None if hardware == "ros2" else Path(hardware)
    topics = Ros2Settings.chosen(file, ros_endpoint, network.network.insecure)
    with (
        open_node(topics, "plant") as node,
        Ros2Car(chosen.car, node, topics, chosen.rate_hz) as driven,
    ):
        raise typer.Exit(main(chosen, hardware=driven))


@options_of(
    "bayesrace.controller.process_settings.ControllerSettings",
    "car name shadow rate_hz budget hold compensation fallback.shifted_s sensor_tolerance "
    "realtime.cpu realtime.fifo realtime.lock_memory",
)
def controller(
    network: "Configuration",
    settings: "Given[ControllerSettings]",
    track: str = options.TRACK_GIVEN,
    raceline: Path | None = options.value(
        "Racing line, as 'bayesrace raceline' writes it; not for --manual.", metavar="FILE"
    ),
    artefact: Path = options.value("Folder that 'bayesrace build' printed.", ..., metavar="DIR"),
    weights: Path | None = options.WEIGHTS,
    mpc: Path | None = options.MPC,
    store: Path | None = _STORE,
    endpoint: list[str] = _endpoint(
        "Zenoh endpoint of the plant, for a shadow of the controller, too; repeatable.",
        "as configured; tcp/127.0.0.1:7447",
    ),
    listen: list[str] = _endpoint(
        "Zenoh endpoint to listen on, for recorders and senders of weights; repeatable.",
        "as configured; tcp/127.0.0.1:7448",
    ),
    gate: Path | None = _GATE,
    pursuit: float | None = options.value(
        "Drive by pure pursuit instead, at this share of the line's speed: the first drive of a "
        "real car, and training data.",
        metavar="SHARE",
        min=0.05,
        max=2.0,
    ),
    manual: str | None = options.value(
        "Drive by hand instead, with a gamepad, as /dev/input/js0, or the keyboard (WASD, arrows).",
        metavar="DEVICE|keyboard",
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
    unused: dict[str, object] = {}
    if (pursuit, manual) != (None, None):
        unused = {"settings": mpc, "weights": weights, "store": store, "gate": gate}
    if manual is not None:
        unused |= {"raceline": raceline, "pursuit": pursuit}
    if given := [name for name, one in unused.items() if one is not None]:
        instead = "pursuit" if manual is None else "manual"
        raise InputError(f"--{instead} drives without --{given[0]}: leave out one of them")
    if manual is not None:
        from bayesrace.controller.manual import KEYBOARD, Gamepad, Keyboard, ManualDriver
        from bayesrace.controller.python_controller import PythonController
        from bayesrace.tracks import load_track

        identity = load_track(track, chosen.car.width_m).identity
        hands = Keyboard() if manual == KEYBOARD else Gamepad(manual)
        law = ManualDriver(chosen.car, hands, 1 / chosen.rate_hz)
        driver: Controller = PythonController(artefact, law, identity)
    elif raceline is None:
        raise InputError("no racing line: give --raceline FILE, as 'bayesrace raceline' writes it")
    elif pursuit is None:
        driver = predictive_controller(
            artefact, chosen.car, track, raceline, mpc, weights, store, chosen.gate
        )
    else:
        from bayesrace.operation.collect import pursuit_controller

        driver = pursuit_controller(
            artefact, chosen.car, track, raceline, pursuit, 1 / chosen.rate_hz
        )
    main = shadow.main if role == "shadow" else process.main
    raise typer.Exit(main(chosen, driver))


def bridge(
    network: "Configuration",
    link: str = options.argument(
        "LINK", "udp:ADDRESS:PORT or unix:PATH of the controller, or serial:DEVICE[:BAUD] to it."
    ),
    track: str = options.TRACK_GIVEN,
    car: str = options.CAR,
    name: str = _NAME,
    rate: float = options.value("The controller's own --rate [Hz].", 50.0, min=1.0, max=500.0),
    artefact: Path | None = options.value(
        "Folder of 'bayesrace build' that the controller is from: by it new weights are checked, "
        "and taken while it drives.",
        metavar="DIR",
        shown="it takes none",
    ),
    weights: Path | None = options.value(
        "GP weights that 'bayesrace export' has written for the controller.", shown="none"
    ),
    store: Path | None = _STORE,
    gate: Path | None = _GATE,
    key: Path | None = options.value(
        "File of the key that the controller has, too: docs/host.md.", metavar="FILE"
    ),
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
    updates = None
    if artefact is not None:
        updates = _updates(artefact, driven, weights, store, gate)
    elif given := [one for one in (weights, store, gate) if one is not None]:
        raise InputError(f"{given[0]} is for new weights, which need --artefact")
    called = name or driven.name
    raise typer.Exit(main(called, endpoints, link, identity, rate, updates, parent_pid, key))


def _updates(
    artefact: Path, car: "Car", weights: Path | None, store: Path | None, gate: Path | None
) -> "Updates":
    """By what new weights are taken for a controller that is elsewhere."""
    from bayesrace.codegen.build import checking_artefact
    from bayesrace.codegen.host_files import packed_weights_file
    from bayesrace.controller.assembly import opened_history, read_checked, read_settings
    from bayesrace.controller.bridge import Updates
    from bayesrace.controller.settings import GateSettings
    from bayesrace.controller.weights.adoption import WeightsPort
    from bayesrace.manifest import read_manifest

    thresholds, manifest = read_settings(gate, GateSettings), read_manifest(artefact)
    if manifest.weight_buffers == 1:
        raise InputError(
            f"{artefact} has one weight buffer: it takes no weights while it drives; leave out "
            "--artefact, or build one with --weight-buffers 3"
        )
    artefact = checking_artefact(artefact, car)
    loaded = None if weights is None else read_checked(weights, artefact, car, thresholds)
    history, folder = opened_history(loaded, store, manifest.discretisation)
    port = WeightsPort(artefact.resolve(), car, history, folder)
    return Updates(
        port,
        thresholds,
        partial(
            packed_weights_file,
            identity=manifest.discretisation,
            capacity=manifest.gp_capacity,
        ),
    )


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


def ros2(
    network: "Configuration",
    car: str = options.CAR,
    name: str = options.CAR_NAME,
    track: str = options.value(
        "Track whose edges are published: as of 'bayesrace drive'.", "", shown="none"
    ),
    topics: Path | None = options.value(
        "Topics, frames, rates and buttons (TOML): docs/ros2.md.", shown="the defaults"
    ),
    joy: bool = options.flag("--joy", "Let buttons of a joystick in the ROS network stop and go."),
    ros_endpoint: str = _ROS_ENDPOINT,
    endpoint: list[str] = options.ENDPOINT,
) -> None:
    """Show a car to a ROS 2 network of rmw_zenoh, until Ctrl-C: odometry, plan, track, commands.

    With --joy it is a director of the car, otherwise a viewer.
    """
    from bayesrace.operation.ros2 import bridge as show
    from bayesrace.ros2.settings import Ros2Settings
    from bayesrace.vehicles import get_car

    settings = Ros2Settings.chosen(topics, ros_endpoint, network.network.insecure)
    endpoints = network.endpoints("director" if joy else "viewer", connect=endpoint)
    show(endpoints, settings, get_car(car), name, track, joy)
