"""Options that several subcommands share."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

import typer

from bayesrace.errors import InputError, faults_in

if TYPE_CHECKING:
    from pydantic import BaseModel

    from bayesrace.vehicles import CarParameters
    from controller.path_table import PathTable
    from plant.sensors import SensorNoise

__all__ = [
    "AllSamples",
    "Car",
    "Caution",
    "CarName",
    "Delay",
    "Endpoint",
    "FmuFile",
    "FmuMap",
    "GivenLine",
    "LowLatency",
    "Noise",
    "OutFile",
    "ParentPid",
    "RaceLineFile",
    "ControlProblem",
    "DriveTime",
    "ProblemChoice",
    "Seed",
    "SettingsFile",
    "Simulator",
    "Style",
    "TrackName",
    "Tyres",
    "path_on",
    "sensor_noise",
    "settings_of",
    "writable",
]


class TyreModel(StrEnum):
    """Models of tyres that a car can be put on."""

    pacejka = "pacejka"
    linear = "linear"


Car = Annotated[str, typer.Option(metavar="CAR", help="Car: built-in name or TOML file.")]
CarName = Annotated[
    str,
    typer.Option(
        "--name",
        metavar="NAME",
        show_default="the car's own",
        help="Name of the car in the network.",
    ),
]
Tyres = Annotated[
    TyreModel | None,
    typer.Option(
        metavar="TYRES",
        show_default="the car's",
        help="pacejka: of the same stiffness as the car's linear tyres, saturating.",
    ),
]
AllSamples = Annotated[
    bool,
    typer.Option(
        "--all-samples",
        help="Keep samples beyond the car's limits, as the paper's published drives have them.",
    ),
]


DriveTime = Annotated[
    float | None,
    typer.Option(
        metavar="S",
        min=1,
        max=3600,
        show_default="the car's, and a lap at least",
        help="Length of the training drive [s].",
    ),
]


class ProblemChoice(StrEnum):
    """Control problem."""

    tracking = "tracking"
    progress = "progress"


ControlProblem = Annotated[
    ProblemChoice,
    typer.Option(
        metavar="PROBLEM", help="tracking: follow the line in its speed; progress: be fast."
    ),
]

Caution = Annotated[
    float | None,
    typer.Option(
        metavar="P",
        min=0,
        max=0.9999999,
        show_default="0.95",
        help="Probability with which the plan stays on the track in spite of the model's "
        "uncertainty, from 0.5 on; 0: none, as in the paper.",
    ),
]

Seed = Annotated[
    int,
    typer.Option(
        min=0, max=2**32 - 1, metavar="N", help="Seed of the training drive and of the training."
    ),
]
TrackName = Annotated[
    str,
    typer.Option(
        metavar="TRACK",
        show_default="the car's",
        help="Built-in name, random:SEED, random10:SEED or CSV file.",
    ),
]
RaceLineFile = Annotated[
    Path,
    typer.Option(
        "--raceline", metavar="FILE", help="Racing line, as 'bayesrace raceline' writes it."
    ),
]
GivenLine = Annotated[
    Path | None,
    typer.Option(
        "--raceline",
        metavar="FILE",
        show_default="computed",
        help="Racing line to drive, as 'bayesrace raceline' writes it.",
    ),
]
Endpoint = Annotated[
    list[str] | None,
    typer.Option(
        metavar="ENDPOINT",
        help="Zenoh endpoint of a plant, a controller or a router; repeatable.",
        show_default="as configured; tcp/127.0.0.1:7447 and :7448",
    ),
]


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
    """Callback of options that name a file to write: InputError before the work, not after it."""
    if path is not None and not path.parent.is_dir():
        raise InputError(f"cannot write {path}: no folder {path.parent}; make it first")
    if path is not None and path.is_dir():
        raise InputError(f"cannot write {path}: it is a folder; name a file in it")
    return path


SettingsFile = Annotated[
    Path | None,
    typer.Option(
        "--settings",
        metavar="FILE",
        help="Settings of an earlier run (its settings.json); options that are given override it.",
    ),
]
S = TypeVar("S", bound="BaseModel")


def settings_of(
    kind: type[S], options: typer.Context, file: Path | None, values: dict[str, dict[str, Any]]
) -> S:
    """Settings of the file, overridden by options on the command line; of all options without one.

    ``values``: option, by the name of its parameter, to the fields that it sets.
    """
    from pydantic import ValidationError

    from bayesrace.files import read_text

    content: dict[str, Any] = {}
    if file is not None:
        text = read_text(file, "settings", "give the settings.json of a run")
        try:
            content = kind.model_validate_json(text).model_dump()
        except ValidationError as error:
            raise InputError(f"{file}: {faults_in(error, 'the file', kind)}") from None
    for option, fields in values.items():
        source = options.get_parameter_source(option)
        if file is None or (source is not None and source.name == "COMMANDLINE"):
            _update(content, fields)
    return kind.model_validate(content)


def _update(content: dict[str, Any], fields: dict[str, Any]) -> None:
    for name, value in fields.items():
        if isinstance(value, dict):
            _update(content.setdefault(name, {}), value)
        else:
            content[name] = value


OutFile = Annotated[
    Path,
    typer.Option("--out", "-o", metavar="FILE", callback=writable, help="File to write."),
]
Noise = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=STD",
        show_default="exact",
        help="Standard deviation of a sensor: position_m, heading_rad, speed_mps, yaw_rate_radps, "
        "steering_rad; repeatable.",
    ),
]
Delay = Annotated[
    float,
    typer.Option(
        metavar="MS", min=0, max=1000, help="Delay of states and of actuations each [ms]."
    ),
]


def sensor_noise(given: list[str] | None) -> "SensorNoise":
    """The noise of the options ``NAME=STD``; InputError naming one that cannot be."""
    from pydantic import ValidationError

    from plant.sensors import SensorNoise

    pairs = dict(one.partition("=")[::2] for one in given or ())
    try:
        return SensorNoise.model_validate(pairs)
    except ValidationError as error:
        faults = faults_in(error, "the noise", SensorNoise)
        raise InputError(f"--noise: {faults}; give NAME=STD") from None


FmuFile = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Co-Simulation FMU (2.0, 3.0) that simulates the car."),
]
FmuMap = Annotated[
    Path | None,
    typer.Option(
        "--map",
        metavar="FILE",
        help="Meaning of the FMU's variables (TOML); 'bayesrace fmu inspect' writes one to edit.",
    ),
]
Simulator = Annotated[
    Literal["equations", "slipx"],
    typer.Option(metavar="NAME", help="equations, or slipx, whose reference car is --car slipx."),
]
Style = Annotated[
    Literal["limit", "calm", "weave"],
    typer.Option(
        metavar="STYLE",
        help="Of the training drive: limit (it slides), calm, weave (in waves about the line).",
    ),
]
LowLatency = Annotated[
    bool,
    typer.Option(
        "--low-latency",
        help="Send in the calling thread: in lockstep only, on both plant and controller.",
    ),
]
ParentPid = Annotated[int | None, typer.Option(hidden=True, help="End when this parent ends.")]
