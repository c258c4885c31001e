"""``bayesrace fmu``: exports FMUs, exchanges their weights, lists the variables of any FMU."""

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import typer

from bayesrace.defaults import DEFAULT_CAR
from bayesrace.errors import InputError
from bayesrace.files import write_whole
from operation.cli import options

if TYPE_CHECKING:
    from bayesrace.vehicles import CarParameters
    from codegen.fmu import FmuDefinition

__all__ = ["fmu"]


fmu = typer.Typer(
    name="fmu",
    help="Export the car or its controller as an FMU; inspect an FMU of another tool.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
)


@fmu.command()
def export(
    out: options.OutFile,
    car: options.Car = DEFAULT_CAR,
    version: Literal["2", "3"] = options.value(
        "Version of the FMI standard: 2 or 3.", "3", metavar="FMI"
    ),
    kind: Literal["cs", "me"] = options.value(
        "cs: Co-Simulation; me: Model Exchange (the car, FMI 3.0).", "cs"
    ),
    platform: list[str] = options.value(
        "x86_64-linux, aarch64-linux or x86_64-windows; repeatable. Others than this one need "
        "ziglang.",
        (),
        shown="this one",
    ),
    controller: bool = options.flag("--controller", "Export the controller instead of the car."),
    track: str | None = options.value("Controller: its track.", shown="the car's"),
    raceline: Path | None = options.value("Controller: racing line.", shown="computed"),
    weights: Path | None = options.value(
        "Controller: GP weights; without them, the uncorrected model."
    ),
    settings: Path | None = options.value("Controller: OCP settings (JSON)."),
    artefact: Path | None = options.value(
        "Controller: folder of 'bayesrace build'.", metavar="DIR", shown="built"
    ),
) -> None:
    """Write the car, or the controller of a track, as an FMU, C sources inside."""
    from bayesrace.vehicles import get_car
    from codegen.fmu import car_fmu, pack

    parameters = get_car(car)
    number: Literal[2, 3] = 2 if version == "2" else 3
    if not controller:
        _only_for_controllers(
            track=track, raceline=raceline, weights=weights, settings=settings, artefact=artefact,
        )  # fmt: skip
        definition = car_fmu(parameters, number, kind)
    elif kind == "me":
        raise InputError("a controller is sampled, not continuous: export it with --kind cs")
    else:
        definition = _controller(
            parameters, track or parameters.race_track, raceline=raceline, weights=weights,
            settings=settings, artefact=artefact, version=number,
        )  # fmt: skip
    pack(definition, out, platform or None)
    typer.echo(f"{definition.name}, FMI {number}.0 {kind}: {out}")


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

    table = options.path_on(track, raceline, car)
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
    out: options.OutFile,
    controller: Path = options.argument("FMU", "FMU of a controller."),
    weights: Path = options.argument("WEIGHTS", "New GP weights."),
) -> None:
    """Copy a controller's FMU with other weights, without compiling."""
    from bayesrace.gp.weights import read_weights
    from codegen.fmu import exchange_weights

    loaded = read_weights(weights)
    exchange_weights(controller, loaded, out)
    typer.echo(f"{loaded.version}: {out}")


@fmu.command()
def inspect(
    file: Path = options.argument("FMU", "FMU file."),
    map_file: Path | None = options.new_file("Write a map to fill in (TOML).", "--map"),
    every: bool = options.flag("--all", "Print local variables, too."),
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
