"""Options that several subcommands share."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bayesrace.errors import InputError

if TYPE_CHECKING:
    from bayesrace.transport import Endpoints
    from bayesrace.vehicles import CarParameters
    from controller.path_table import PathTable

__all__ = [
    "Car",
    "CarName",
    "Endpoint",
    "FmuFile",
    "FmuMap",
    "LowLatency",
    "OutFile",
    "ParentPid",
    "RaceLineFile",
    "Seed",
    "TrackName",
    "connect_to",
    "path_on",
    "writable",
]

Car = Annotated[str, typer.Option(help="Car: built-in name or TOML file.")]
CarName = Annotated[
    str, typer.Option("--name", help="Name of the car in the network; the car's own without.")
]
Seed = Annotated[
    int, typer.Option(min=0, max=2**32 - 1, help="Of training drive and training alike.")
]
TrackName = Annotated[str, typer.Option(help="Track: built-in name, random:SEED or CSV file.")]
RaceLineFile = Annotated[
    Path, typer.Option("--raceline", help="Racing line file, as 'bayesrace raceline' writes it.")
]
Endpoint = Annotated[
    list[str] | None,
    typer.Option(
        help="Zenoh endpoint of a plant, a controller or a router; can be given several times "
        "[tcp/127.0.0.1:7447 and :7448, the plant's and the controller's own].",
        show_default=False,
    ),
]


def connect_to(given: list[str] | None) -> "Endpoints":
    """What to connect to: the endpoints given, or the plant's and the controller's own."""
    from bayesrace.transport import CONTROLLER_ENDPOINT, PLANT_ENDPOINT, Endpoints

    return Endpoints(connect=tuple(given or (PLANT_ENDPOINT, CONTROLLER_ENDPOINT)))


def path_on(track: str, raceline: Path | None, car: "CarParameters") -> "PathTable":
    """What the planner follows: the racing line of the file, or computed where there is none."""
    from bayesrace.raceline import read_raceline_for
    from bayesrace.raceline.cached import racing_line
    from bayesrace.tracks import load_track
    from controller.path_table import make_path_table

    course = load_track(track, car.width_m)
    line = (
        racing_line(course, car) if raceline is None else read_raceline_for(raceline, course, car)
    )
    return make_path_table(course, line, car.tuning.path.spacing_m)


def writable(path: Path | None) -> Path | None:
    """Callback of options that name a file to write: complains before the work, not after it."""
    if path is not None and not path.parent.is_dir():
        raise InputError(f"cannot write {path}: no folder {path.parent}; make it first")
    if path is not None and path.is_dir():
        raise InputError(f"cannot write {path}: it is a folder; name a file in it")
    return path


OutFile = Annotated[Path, typer.Option("--out", "-o", callback=writable, help="File to write.")]
FmuFile = Annotated[
    Path | None, typer.Option(help="Co-Simulation FMU (2.0, 3.0) that plays the car.")
]
FmuMap = Annotated[
    Path | None,
    typer.Option(
        "--map", help="What the FMU's variables mean (TOML); 'bayesrace fmu inspect' writes one."
    ),
]
LowLatency = Annotated[
    bool,
    typer.Option(
        help="Send in the calling thread. For lockstep, on plant and controller alike.",
    ),
]
ParentPid = Annotated[int | None, typer.Option(hidden=True, help="End when this parent ends.")]
