"""``size``, ``build``, ``export``, ``fmu``: the controller, and what others exchange with us."""

import shutil
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

import typer

from bayesrace.errors import InputError
from bayesrace.files import write_whole
from bayesrace.operation.cli import options
from bayesrace.operation.cli.declaration import Given, Group, options_of
from bayesrace.trusted_files import trusted

if TYPE_CHECKING:
    from bayesrace.codegen.settings import BuildSettings
    from bayesrace.controller.settings import MpcSettings
    from bayesrace.gp.weights import Weights
    from bayesrace.raceline import RaceLine
    from bayesrace.tracks import Track
    from bayesrace.vehicles import Car

__all__ = ["build", "export", "fmu", "size"]

_CHOICES: Final = "model problem horizon gp_capacity path_rows weight_buffers estimator car"


@options_of("bayesrace.codegen.settings.BuildSettings", _CHOICES)
def build(
    settings: "Given[BuildSettings]",
    out: Path | None = options.out_folder("Copy the artefact here."),
    platform: str | None = options.value(
        "What it is to run on: x86_64-linux, aarch64-linux, aarch32-linux (ARMv7) or "
        "riscv64-linux; others than this one need --daqp, and ziglang or CC. cortex-m7: here, with "
        "a static library for that processor beside it.",
        shown="this one",
    ),
    daqp: Path | None = options.value(
        "DAQP's source distribution, whose C is compiled in place of CasADi's library of it.",
        metavar="FILE",
    ),
    host: bool = options.flag("--host", "Add the controller without Python: a program."),
) -> None:
    """Generate and compile a controller, or take it from the cache; prints its folder."""
    from bayesrace.codegen.boards import BOARDS, add_library, board_compiler
    from bayesrace.codegen.build import artefact_compiler
    from bayesrace.codegen.build import build as make
    from bayesrace.codegen.compiler import find_compiler
    from bayesrace.codegen.daqp import HOW_TO_GET
    from bayesrace.codegen.platforms import get_platform
    from bayesrace.integrators import PERFECT
    from bayesrace.manifest import MANIFEST

    chosen = settings()
    if chosen.model == "dynamic":
        chosen = settings(discretisation=PERFECT)
    board = BOARDS.get(platform or "")
    if (host or board) and out is None:
        what = f"--platform {platform}: the library" if board else "--host: the program"
        raise InputError(f"{what} goes into the folder of --out; give one")
    if board and daqp is None:
        raise InputError(f"for {board.name}, DAQP's C is missing: {HOW_TO_GET}")
    if board and host:
        raise InputError(f"--host: {board.name} runs no programs; leave it out")
    cross = board_compiler(board) if board else None
    if out is not None:
        trusted(out, make=True)  # now, as its loader would refuse it after the work
        if any(out.iterdir()) and not (out / MANIFEST).exists():
            raise InputError(f"{out} holds other files: give --out a new folder, or delete it")
    target = None if platform is None or board else get_platform(platform)
    own = find_compiler(by_name=True) if board else None  # CC is that of the board
    folder, _ = make(chosen, platform=target, daqp=daqp, compiler=own)
    if out is not None:
        shutil.copytree(folder, out, dirs_exist_ok=True, copy_function=_replace)
        folder = out
    if host:
        from bayesrace.operation.host import write_program

        write_program(folder, folder, artefact_compiler(target, daqp))
    if board and cross:
        typer.echo(add_library(folder, board, cross))
    typer.echo(f"{folder}")


@options_of("bayesrace.codegen.settings.BuildSettings", _CHOICES)
def size(settings: "Given[BuildSettings]") -> None:
    """Print what a controller would take of memory, without building it."""
    from bayesrace.codegen.boards import WHOLE, planned_memory
    from bayesrace.operation.terminal.terminal import Terminal, plain_table

    memory = planned_memory(settings())
    table = plain_table("memory", "kB")
    for what, taken in memory.items():
        table.add_row(what if what in WHOLE else f"  {what}", f"{taken / 1000:.0f}")
    table.add_row("together", f"{sum(memory[what] for what in WHOLE) / 1000:.0f}")
    Terminal().print(table)


def _replace(source: str, target: str) -> None:
    """Copies beside the target and renames: a running controller keeps the library it loaded."""
    beside = f"{target}.new"
    Path(beside).touch(0o600)  # no other user can open it for writing meanwhile
    shutil.copy2(source, beside)
    Path(beside).replace(target)


def export(
    out: Path = options.argument("DIR", "Folder to write into."),
    track: str = options.TRACK,
    raceline: Path | None = options.GIVEN_LINE,
    weights: Path | None = options.WEIGHTS,
    mpc: Path | None = options.MPC,
    artefact: Path | None = options.ARTEFACT,
    car: str = options.CAR,
) -> None:
    """Write racing line, weights and settings for the controller without Python."""
    from bayesrace.manifest import read_manifest
    from bayesrace.operation.host import export_for
    from bayesrace.vehicles import get_car

    parameters = get_car(car)
    given = _controller(parameters, track, raceline, weights, mpc, artefact)
    read_manifest(given[0]).check_car(parameters, given[0])
    export_for(out, *given)
    typer.echo(f"{track or parameters.race_track}, {parameters.name}: {out}")


def _controller(
    car: "Car",
    track: str,
    raceline: Path | None,
    weights: Path | None,
    mpc: Path | None,
    artefact: Path | None,
) -> "tuple[Path, Car, Track, RaceLine, Weights | None, MpcSettings]":
    """A controller's artefact and what it drives by."""
    from bayesrace.codegen.build import build as make
    from bayesrace.codegen.build import checking_artefact
    from bayesrace.codegen.settings import BuildSettings
    from bayesrace.controller.assembly import read_checked, read_settings
    from bayesrace.controller.settings import MpcSettings
    from bayesrace.raceline import racing_line, read_raceline_for
    from bayesrace.tracks import load_track

    course = load_track(track or car.race_track, car.width_m)
    line = read_raceline_for(raceline, course, car) if raceline else racing_line(course, car)
    folder = artefact or make(BuildSettings(car=car))[0]
    learned = None
    if weights is not None:
        learned = read_checked(weights, checking_artefact(folder, car), car)
    return folder, car, course, line, learned, read_settings(mpc, MpcSettings)


def export_fmu(
    out: Path = options.out_file(...),
    car: str = options.CAR,
    version: Literal["2", "3"] | None = options.value(
        "Version of the FMI standard: 2 or 3.", metavar="FMI", shown="3; with --ssp 2"
    ),
    kind: Literal["cs", "me"] = options.value(
        "cs: Co-Simulation; me: Model Exchange (the car, FMI 3.0).", "cs"
    ),
    platform: list[str] = options.value(
        "x86_64-linux, aarch64-linux, aarch32-linux, riscv64-linux or x86_64-windows; repeatable. "
        "Others than this one need ziglang.",
        (),
        shown="this one",
    ),
    controller: bool = options.flag("--controller", "Export the controller instead of the car."),
    ssp: bool = options.flag("--ssp", "Export both, connected, in one file: an SSP 1.0."),
    track: str = options.TRACK,
    raceline: Path | None = options.GIVEN_LINE,
    weights: Path | None = options.WEIGHTS,
    mpc: Path | None = options.MPC,
    artefact: Path | None = options.ARTEFACT,
) -> None:
    """Write the car, or the controller of a track, as an FMU, C sources inside; or both (--ssp).

    The options below --ssp are for the controller.
    """
    from bayesrace.codegen.fmu import car_fmu, controller_fmu, pack, pack_loop
    from bayesrace.controller.settings import FallbackSettings
    from bayesrace.vehicles import get_car

    parameters = get_car(car)
    number: Literal[2, 3] = 2 if ssp or version == "2" else 3
    own = {
        "--track": track, "--raceline": raceline, "--weights": weights, "--settings": mpc,
        "--artefact": artefact,
    }  # fmt: skip
    if ssp and (controller or version == "3"):
        raise InputError(
            "an SSP holds car and controller, in FMI 2.0: leave out --controller and --version 3"
        )
    if not (controller or ssp):
        if given := [flag for flag, value in own.items() if value]:
            raise InputError(f"{', '.join(given)}: for a controller's FMU; add --controller, --ssp")
        definition = car_fmu(parameters, number, kind)
    elif kind == "me":
        raise InputError("a controller is sampled, not continuous: export it with --kind cs")
    else:
        from bayesrace.operation.host import drives_by
        from bayesrace.operation.run_plan import RunPlan

        chosen = _controller(parameters, track, raceline, weights, mpc, artefact)
        fallback = FallbackSettings().model_dump() | {"brake_fade_mps": parameters.brake_fade_mps}
        definition = controller_fmu(
            chosen[0], parameters, **drives_by(*chosen), fallback=fallback, version=number
        )
        if ssp:
            course, line = chosen[2:4]
            pack_loop(
                car_fmu(parameters, number), definition, out,
                x0=(*course.start_pose(), RunPlan.start_speed_mps, 0.0, 0.0, 0.0),
                stop_s=ceil(2 * line.lap_time_s) + 2, platforms=platform or None,
            )  # fmt: skip
            typer.echo(f"{parameters.name} and its controller, SSP 1.0: {out}")
            return
    pack(definition, out, platform or None)
    typer.echo(f"{definition.name}, FMI {number}.0 {kind}: {out}")


def exchange_weights(
    out: Path = options.out_file(...),
    controller: Path = options.argument("FMU", "FMU of a controller."),
    weights: Path = options.argument("WEIGHTS", "New GP weights."),
) -> None:
    """Copy a controller's FMU with other weights, without compiling."""
    from bayesrace.codegen.fmu import exchange_weights as exchange
    from bayesrace.gp.weights import read_weights

    loaded = read_weights(weights)
    exchange(controller, loaded, out)
    typer.echo(f"{loaded.version}: {out}")


def inspect(
    file: Path = options.argument("FMU", "FMU file."),
    map_file: Path | None = options.new_file("Write a map to fill in (TOML).", "--map"),
    every: bool = options.flag("--all", "Print local variables, too."),
) -> None:
    """Print an FMU's variables; write a map for 'bayesrace plant --fmu' to fill in."""
    from bayesrace.operation.terminal.fmu_table import fmu_table
    from bayesrace.operation.terminal.terminal import Terminal
    from bayesrace.plant.fmu.inspection import blank_map, platforms
    from bayesrace.plant.fmu.inspection import inspect as read

    description = read(file)
    Terminal().print(fmu_table(description, platforms(file), all_=every))
    if map_file is not None:
        if map_file.exists():
            raise InputError(f"{map_file} exists already; choose another name or remove it")
        write_whole(map_file, blank_map(description))
        typer.echo(f"map to fill in: {map_file}")


fmu = Group(
    "Export the car or its controller as an FMU; inspect an FMU of another tool.",
    {"export": export_fmu, "weights": exchange_weights, "inspect": inspect},
)
