"""``plant`` and ``controller``: the two processes, to be run side by side or on two machines."""

from pathlib import Path
from typing import Annotated

import typer

from bayesrace.clock import die_with_parent
from experiments.cli.options import Car, LowLatency, ParentPid, RaceLineFile, TrackName

__all__ = ["register"]

_PLANT = "tcp/127.0.0.1:7447"
_CONTROLLER = "tcp/127.0.0.1:7448"


def plant(
    car: Car = "orca",
    endpoint: Annotated[str, typer.Option(help="Zenoh endpoint to listen on.")] = _PLANT,
    connect: Annotated[
        list[str] | None, typer.Option(help="Further endpoints to connect to.")
    ] = None,
    low_latency: LowLatency = False,
    parent_pid: ParentPid = None,
) -> None:
    """Play the car: waits for a run to be asked for ('bayesrace drive'), until Ctrl-C."""
    die_with_parent(parent_pid)
    from bayesrace.transport import Endpoints
    from plant.process import PlantSettings, main

    endpoints = Endpoints(listen=(endpoint,), connect=tuple(connect or ()), low_latency=low_latency)
    settings = PlantSettings(car=car, endpoints=endpoints, parent_pid=parent_pid)
    raise typer.Exit(main(settings))


def controller(
    artefact: Annotated[Path, typer.Option(help="Folder that 'bayesrace build' printed.")],
    track: TrackName,
    raceline: RaceLineFile,
    weights: Annotated[
        Path | None, typer.Option(help="GP weights; none is the uncorrected model.")
    ] = None,
    settings: Annotated[
        Path | None, typer.Option(help="OCP settings (JSON), see 'controller/settings.py'.")
    ] = None,
    car: Car = "orca",
    endpoint: Annotated[
        list[str] | None, typer.Option(help=f"Zenoh endpoint of the plant [{_PLANT}].")
    ] = None,
    listen: Annotated[
        str, typer.Option(help="Zenoh endpoint to listen on, for who records or sends weights.")
    ] = _CONTROLLER,
    low_latency: LowLatency = False,
    parent_pid: ParentPid = None,
) -> None:
    """Drive the car of a plant process with the compiled controller, until Ctrl-C."""
    die_with_parent(parent_pid)
    from bayesrace.transport import Endpoints
    from bayesrace.vehicles import get_car
    from controller.assembly import predictive_controller
    from controller.process import ControllerSettings, main

    endpoints = Endpoints(
        listen=(listen,), connect=tuple(endpoint or (_PLANT,)), low_latency=low_latency
    )
    driver = predictive_controller(artefact, get_car(car), track, raceline, settings, weights)
    process = ControllerSettings(car=car, endpoints=endpoints, parent_pid=parent_pid)
    raise typer.Exit(main(process, driver))


def register(app: typer.Typer) -> None:
    """Adds this module's subcommands."""
    for command in (plant, controller):
        app.command()(command)
