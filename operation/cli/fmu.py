"""``bayesrace fmu``: exports FMUs, exchanges their weights, lists the variables of any FMU."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from bayesrace.defaults import DEFAULT_CAR
from bayesrace.errors import InputError
from bayesrace.files import write_whole
from operation.cli.options import Car, OutFile, path_on, writable

if TYPE_CHECKING:
    from bayesrace.vehicles import CarParameters
    from codegen.fmu import FmuDefinition

__all__ = ["fmu"]


class Version(StrEnum):
    """Of the FMI standard."""

    two = "2"
    three = "3"


class Kind(StrEnum):
    """Of an FMU's interface."""

    cs = "cs"
    me = "me"


fmu = typer.Typer(
    name="fmu",
    help="Export the car or its controller as an FMU; inspect an FMU of another tool.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
)


@fmu.command()
def export(
    out: OutFile,
    car: Car = DEFAULT_CAR,
    version: Annotated[
        Version, typer.Option(metavar="FMI", help="Version of the FMI standard: 2 or 3.")
    ] = Version.three,
    kind: Annotated[
        Kind,
        typer.Option(
            metavar="KIND", help="cs: Co-Simulation; me: Model Exchange (the car, FMI 3.0)."
        ),
    ] = Kind.cs,
    platform: Annotated[
        list[str] | None,
        typer.Option(
            metavar="PLATFORM",
            show_default="this one",
            help="x86_64-linux, aarch64-linux or x86_64-windows; repeatable. Others than this one "
            "need ziglang.",
        ),
    ] = None,
    controller: Annotated[
        bool, typer.Option("--controller", help="Export the controller instead of the car.")
    ] = False,
    track: Annotated[
        str | None,
        typer.Option(metavar="TRACK", show_default="the car's", help="Controller: its track."),
    ] = None,
    raceline: Annotated[
        Path | None,
        typer.Option(metavar="FILE", show_default="computed", help="Controller: racing line."),
    ] = None,
    weights: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Controller: GP weights; without them, the uncorrected model."
        ),
    ] = None,
    settings: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Controller: OCP settings (JSON).")
    ] = None,
    artefact: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR", show_default="built", help="Controller: folder of 'bayesrace build'."
        ),
    ] = None,
) -> None:
    """Write the car, or the controller of a track, as an FMU, C sources inside."""
    from bayesrace.vehicles import get_car
    from codegen.fmu import car_fmu, pack

    parameters = get_car(car)
    number: Literal[2, 3] = 2 if version is Version.two else 3
    if not controller:
        _only_for_controllers(
            track=track, raceline=raceline, weights=weights, settings=settings, artefact=artefact,
        )  # fmt: skip
        definition = car_fmu(parameters, number, kind.value)
    elif kind is Kind.me:
        raise InputError("a controller is sampled, not continuous: export it with --kind cs")
    else:
        definition = _controller(
            parameters, track or parameters.race_track, raceline=raceline, weights=weights,
            settings=settings, artefact=artefact, version=number,
        )  # fmt: skip
    pack(definition, out, platform)
    typer.echo(f"{definition.name}, FMI {number}.0 {kind.value}: {out}")


def _only_for_controllers(**options: object) -> None:
    given = [f"--{name}" for name, value in options.items() if value is not None]
    if given:
        raise InputError(f"{', '.join(given)}: for a controller's FMU; add --controller")


def _controller(
    car: "CarParameters",
    track: str,
    *,
    raceline: Path | None,
    weights: Path | None,
    settings: Path | None,
    artefact: Path | None,
    version: Literal[2, 3],
) -> "FmuDefinition":
    from bayesrace.manifest import read_manifest
    from codegen.build import build
    from codegen.fmu import controller_fmu
    from codegen.settings import BuildSettings
    from controller.assembly import read_checked, read_settings
    from controller.cycle_settings import FallbackSettings
    from controller.settings import MpcSettings

    table = path_on(track, raceline, car)
    folder = artefact or build(BuildSettings(car=car))[0]
    problem = read_manifest(folder).problem.name
    return controller_fmu(
        folder,
        car,
        rows=table.rows,
        spacing_m=table.spacing_m,
        settings=read_settings(settings, MpcSettings).parameters(car, problem),
        fallback=FallbackSettings().model_dump() | {"brake_fade_mps": car.brake_fade_mps},
        weights=None if weights is None else read_checked(weights, folder, car),
        version=version,
    )


@fmu.command(name="weights")
def other_weights(
    controller: Annotated[Path, typer.Argument(metavar="FMU", help="FMU of a controller.")],
    weights: Annotated[Path, typer.Argument(metavar="WEIGHTS", help="New GP weights.")],
    out: OutFile,
) -> None:
    """Copy a controller's FMU with other weights, without compiling."""
    from bayesrace.gp.weights import read_weights
    from codegen.fmu import exchange_weights

    loaded = read_weights(weights)
    exchange_weights(controller, loaded, out)
    typer.echo(f"{loaded.version}: {out}")


@fmu.command()
def inspect(
    file: Annotated[Path, typer.Argument(metavar="FMU", help="FMU file.")],
    map_file: Annotated[
        Path | None,
        typer.Option(
            "--map", metavar="FILE", callback=writable, help="Write a map to fill in (TOML)."
        ),
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="Print local variables, too.")] = False,
) -> None:
    """Print an FMU's variables; write a map for 'bayesrace plant --fmu' to fill in."""
    from operation.terminal.fmu_table import FmuTable
    from operation.terminal.terminal import Terminal
    from plant.fmu.inspection import inspect as read
    from plant.fmu.inspection import platforms
    from plant.fmu.template import blank_map

    description = read(file)
    Terminal().print(FmuTable(description, platforms(file), all_=every))
    if map_file is not None:
        if map_file.exists():
            raise InputError(f"{map_file} exists already; choose another name or remove it")
        write_whole(map_file, blank_map(description))
        typer.echo(f"map to fill in: {map_file}")
