"""``bayesrace fmu``: exports FMUs, exchanges their weights, lists the variables of any FMU."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from bayesrace.errors import InputError
from bayesrace.files import write_whole
from bayesrace.tracks import DEFAULT_RACE_TRACK
from bayesrace.vehicles import DEFAULT_CAR
from experiments.cli.options import Car, OutFile, path_on, writable

if TYPE_CHECKING:
    from bayesrace.vehicles import CarParameters
    from codegen.fmu import FmuDefinition

__all__ = ["register"]


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
    help="The car or its controller as an FMU; what an FMU of another tool needs to be the car.",
    no_args_is_help=True,
)


@fmu.command()
def export(
    out: OutFile,
    car: Car = DEFAULT_CAR,
    version: Annotated[Version, typer.Option(help="Of the FMI standard: 2 or 3.")] = Version.three,
    kind: Annotated[
        Kind, typer.Option(help="Co-Simulation, or Model Exchange (the car, FMI 3.0).")
    ] = Kind.cs,
    platform: Annotated[
        list[str] | None,
        typer.Option(
            help="Platform to build for, may be repeated [this one]: x86_64-linux, aarch64-linux, "
            "x86_64-windows. Others than this one need ziglang."
        ),
    ] = None,
    controller: Annotated[bool, typer.Option(help="The controller instead of the car.")] = False,
    track: Annotated[
        str | None, typer.Option(help=f"Controller: track, as everywhere [{DEFAULT_RACE_TRACK}].")
    ] = None,
    raceline: Annotated[
        Path | None, typer.Option(help="Controller: racing line file [computed].")
    ] = None,
    weights: Annotated[
        Path | None, typer.Option(help="Controller: GP weights; none is the uncorrected model.")
    ] = None,
    settings: Annotated[Path | None, typer.Option(help="Controller: OCP settings (JSON).")] = None,
    artefact: Annotated[
        Path | None, typer.Option(help="Controller: folder of 'bayesrace build' [built].")
    ] = None,
    cpu: Annotated[
        str,
        typer.Option(
            help="Controller: CPU to build for. 'portable' runs on any of this kind, 'native' is "
            "faster and runs on this one's like only; or a value for the compiler's -march."
        ),
    ] = "portable",
) -> None:
    """Write the car, or the controller of a track, as an FMU, C sources inside."""
    from bayesrace.vehicles import get_car
    from codegen.fmu import car_fmu, pack

    parameters = get_car(car)
    number: Literal[2, 3] = 2 if version is Version.two else 3
    if not controller:
        _only_for_controllers(
            track=track, raceline=raceline, weights=weights, settings=settings, artefact=artefact,
            cpu=None if cpu == "portable" else cpu,
        )  # fmt: skip
        definition = car_fmu(parameters, number, kind.value)
    elif kind is Kind.me:
        raise InputError("a controller is sampled, not continuous: export it with --kind cs")
    else:
        definition = _controller(
            parameters, track or DEFAULT_RACE_TRACK, raceline=raceline, weights=weights,
            settings=settings, artefact=artefact, version=number, cpu=cpu,
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
    cpu: str,
) -> "FmuDefinition":
    from bayesrace.gp.weights import read_weights
    from codegen.build import build
    from codegen.fmu import controller_fmu
    from codegen.settings import BuildSettings
    from controller.assembly import read_settings
    from controller.cycle_settings import FallbackSettings
    from controller.settings import MpcSettings

    table = path_on(track, raceline, car)
    return controller_fmu(
        artefact or build(BuildSettings(car=car))[0],
        car,
        rows=table.rows,
        spacing_m=table.spacing_m,
        settings=read_settings(settings, MpcSettings).parameters(car),
        fallback=FallbackSettings().model_dump() | {"brake_fade_mps": car.brake_fade_mps},
        weights=None if weights is None else read_weights(weights),
        version=version,
        cpu=cpu,
    )


@fmu.command(name="weights")
def other_weights(
    controller: Annotated[Path, typer.Argument(help="A controller's FMU.")],
    weights: Annotated[Path, typer.Argument(help="GP weights to put into it.")],
    out: OutFile,
) -> None:
    """Copy a controller's FMU with other weights: nothing is compiled."""
    from bayesrace.gp.weights import read_weights
    from codegen.fmu.weights import exchange_weights

    loaded = read_weights(weights)
    exchange_weights(controller, loaded, out)
    typer.echo(f"{loaded.version}: {out}")


@fmu.command()
def inspect(
    file: Annotated[Path, typer.Argument(help="FMU file.")],
    map_file: Annotated[
        Path | None,
        typer.Option("--map", callback=writable, help="Write a map to start from (TOML)."),
    ] = None,
    every: Annotated[bool, typer.Option("--all", help="Local variables, too.")] = False,
) -> None:
    """Print an FMU's variables; write a map for 'bayesrace plant --fmu' to start from."""

    from experiments.fmu_table import FmuTable
    from experiments.terminal import Terminal
    from plant.fmu.inspection import inspect as read
    from plant.fmu.proposal import starting_map

    description = read(file)
    Terminal().print(FmuTable(description, all_=every))
    if map_file is not None:
        if map_file.exists():
            raise InputError(f"{map_file} exists already; choose another name or remove it")
        write_whole(map_file, starting_map(description))
        typer.echo(f"map to start from: {map_file}")


def register(app: typer.Typer) -> None:
    """Adds the group."""
    app.add_typer(fmu)
