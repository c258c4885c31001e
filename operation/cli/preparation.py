"""``cars`` to ``export``: preparation of a drive, each command with files in and out."""

import shutil
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from bayesrace.defaults import DEFAULT_CAR
from bayesrace.errors import InputError
from operation.cli.options import (
    AllSamples,
    Car,
    CarName,
    ControlProblem,
    DriveTime,
    FmuFile,
    FmuMap,
    GivenLine,
    OutFile,
    ProblemChoice,
    RaceLineFile,
    Seed,
    Simulator,
    Style,
    TrackName,
    Tyres,
    path_on,
    writable,
)

__all__ = ["build", "cars", "collect", "export", "train"]


class PredictionModel(StrEnum):
    """Prediction model of the OCP."""

    e_kinematic = "e_kinematic"
    dynamic = "dynamic"


class KernelChoice(StrEnum):
    """Kernels by name, and the choice among them."""

    rbf = "rbf"
    matern05 = "matern05"
    matern15 = "matern15"
    matern25 = "matern25"
    auto = "auto"


def cars(
    car: Annotated[
        str | None,
        typer.Argument(
            metavar="CAR", show_default="all built in", help="Built-in name or TOML file."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="FILE",
            callback=writable,
            help="Write the car as TOML, tuning included.",
        ),
    ] = None,
    tyres: Tyres = None,
) -> None:
    """List the built-in cars, check a car's file, or write a car to a file with all its values."""
    from rich.table import Table

    from bayesrace.vehicles import builtin_cars, get_car, write_car
    from operation.terminal.terminal import Terminal

    if out is not None and car is None:
        raise InputError("--out needs the name of the car to write")
    table = Table("car", "wheelbase m", "width m", "mass kg", "friction", "identity")
    cars = [get_car(car)] if car is not None else builtin_cars().values()
    for one in cars if tyres is None else [one.on_tyres(tyres) for one in cars]:
        table.add_row(
            one.name, f"{one.wheelbase_m:.4g}", f"{one.width_m:.4g}", f"{one.mass_kg:.4g}",
            f"{one.friction:.4g}", one.identity,
        )  # fmt: skip
        if out is not None:
            write_car(out, one)
    Terminal().print(table)


def collect(
    track: TrackName,
    raceline: RaceLineFile,
    out: OutFile = Path("collect.mcap"),
    duration: DriveTime = None,
    style: Style = "limit",
    seed: Seed = 0,
    fmu: FmuFile = None,
    fmu_map: FmuMap = None,
    simulator: Simulator = "equations",
    car: Car = DEFAULT_CAR,
) -> None:
    """Drive a track by pure pursuit and log the drive as training data."""
    from bayesrace.raceline import read_raceline_for
    from bayesrace.tracks import load_track
    from bayesrace.vehicles import get_car
    from codegen.build import build
    from codegen.compiler import compiled
    from codegen.settings import BuildSettings
    from controller.pure_pursuit import PurePursuitSettings
    from operation.collect import collect as drive
    from operation.training_line import drive_length_s
    from plant.vehicle import open_vehicle

    settings = PurePursuitSettings(style=style, seed=seed)
    parameters = get_car(car)
    course = load_track(track, parameters.width_m)
    line = read_raceline_for(raceline, course, parameters)
    vehicles = open_vehicle(parameters, fmu, fmu_map, compiled=compiled, simulator=simulator)
    with vehicles as vehicle:
        duration_s = duration or drive_length_s(parameters, line)
        artefact, _ = build(BuildSettings(car=parameters))
        driven = drive(
            course, line, parameters, artefact, out, duration_s, settings, vehicle=vehicle
        )
    off_track_m = course.project_path(driven.x[:, :2]).off_track_m
    typer.echo(
        f"{len(driven.u)} samples, {int((off_track_m > 0).sum())} of them off the track, "
        f"up to {float(driven.x[:, 3].max()):.2f} m/s: {out}"
    )


def train(
    logs: Annotated[
        list[Path] | None, typer.Argument(metavar="LOG", help="Run logs (MCAP).")
    ] = None,
    data: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILE", help="Samples in plain arrays (.npz); repeatable."),
    ] = None,
    kernel: Annotated[
        KernelChoice,
        typer.Option(
            metavar="KERNEL", help="rbf, matern05, matern15, matern25; auto: the best per output."
        ),
    ] = KernelChoice.auto,
    out: OutFile = Path("weights.bin"),
    points: Annotated[
        int, typer.Option(metavar="N", min=20, max=20000, help="Points per output.")
    ] = 400,
    restarts: Annotated[
        int,
        typer.Option(
            metavar="N", min=0, max=100, help="Further starts of the optimiser per kernel."
        ),
    ] = 2,
    plot: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            callback=writable,
            help="Draw the error against the kernel's smoothness (PNG).",
        ),
    ] = None,
    artefact: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            show_default="the default one",
            help="Built controller to learn for.",
        ),
    ] = None,
    seed: Seed = 0,
    car: Annotated[
        str,
        typer.Option(metavar="CAR", show_default="named by the files", help="Car that drove."),
    ] = "",
    name: CarName = "",
    all_samples: AllSamples = False,
) -> None:
    """Train the three GPs on the residual in run logs or plain arrays.

    Of more samples than --points, those with the largest predictive variance are chosen one by one.
    """

    from bayesrace.gp.weights import write_weights
    from bayesrace.manifest import read_manifest
    from bayesrace.vehicles import get_car
    from learning.dataset import left_out
    from learning.residual import discretisation_of
    from learning.settings import TrainingSettings
    from learning.sources import read_samples
    from learning.training import fit
    from operation.terminal.learning_table import print_beyond_limits, print_kernels
    from operation.terminal.progress import stages_on
    from operation.terminal.terminal import Terminal

    wanted, parameters = None, get_car(car) if car else None
    if artefact is not None:
        manifest = read_manifest(artefact)
        parameters = parameters or get_car(manifest.car)
        wanted = discretisation_of(manifest.discretisation, parameters)
        manifest.check_points(points)
    files = [*(logs or []), *(data or [])]
    samples = read_samples(files, parameters, name, wanted, limits=not all_samples)
    console = Terminal()
    every = tuple(one.value for one in KernelChoice if one is not KernelChoice.auto)
    settings = TrainingSettings(
        kernels=every if kernel is KernelChoice.auto else (kernel.value,),
        capacity=points,
        restarts=restarts,
        seed=seed,
    )
    with stages_on(console) as stages, stages.stage("train the residual") as stage:
        training = fit(samples.dataset, samples.discretisation, settings, progress=stage.update)
    weights = training.weights
    write_weights(out, weights)
    print_kernels(training.kernels, console)
    if plot is not None:
        from operation.report.canvas import write_png
        from operation.report.gp import kernel_figure
        from operation.report.style import figure_style

        with figure_style():
            write_png(kernel_figure(training.kernels), plot)
    console.print(
        f"{weights.version}: {len(samples.dataset)} samples "
        f"(left out: {left_out(samples.dataset.dropped)}), "
        f"kernels {', '.join(weights.kernels)}: {out}",
        highlight=False,
        soft_wrap=True,
    )
    print_beyond_limits(samples.dataset.dropped, len(samples.dataset), console)


def build(
    model: Annotated[
        PredictionModel,
        typer.Option(metavar="MODEL", help="Prediction model: e_kinematic or dynamic."),
    ] = PredictionModel.e_kinematic,
    problem: ControlProblem = ProblemChoice.tracking,
    horizon: Annotated[
        int | None,
        typer.Option(
            metavar="N", min=2, max=100, show_default="the car's", help="Stages of the horizon."
        ),
    ] = None,
    gp_capacity: Annotated[
        int, typer.Option(metavar="N", min=8, max=16384, help="Most points per output.")
    ] = 1024,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="DIR", help="Copy the artefact here.")
    ] = None,
    car: Car = DEFAULT_CAR,
) -> None:
    """Generate and compile a controller, or take it from the cache; prints its folder."""
    from bayesrace.integrators import PERFECT, PREDICTION
    from bayesrace.vehicles import get_car
    from codegen.build import build as make
    from codegen.settings import BuildSettings

    settings = BuildSettings(
        car=get_car(car),
        model=model.value,
        problem=problem.value,
        discretisation=PERFECT if model is PredictionModel.dynamic else PREDICTION,
        horizon=horizon,
        gp_capacity=gp_capacity,
    )
    folder, _ = make(settings)
    if out is not None:
        shutil.copytree(folder, out, dirs_exist_ok=True, copy_function=_replace)
        folder = out
    typer.echo(str(folder))


def export(
    out: Annotated[Path, typer.Argument(metavar="DIR", help="Folder to write into.")],
    track: TrackName = "",
    raceline: GivenLine = None,
    weights: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="GP weights; without them, the uncorrected model."),
    ] = None,
    settings: Annotated[
        Path | None, typer.Option(metavar="FILE", help="OCP settings (JSON).")
    ] = None,
    artefact: Annotated[
        Path | None,
        typer.Option(metavar="DIR", show_default="built", help="Folder of 'bayesrace build'."),
    ] = None,
    car: Car = DEFAULT_CAR,
) -> None:
    """Write racing line, weights and settings for a C program (examples/c_host)."""
    from bayesrace.manifest import read_manifest
    from bayesrace.vehicles import get_car
    from codegen.build import build as make
    from codegen.host_files import export as write
    from codegen.settings import BuildSettings
    from controller.assembly import read_checked, read_settings
    from controller.cycle_settings import cycle_values
    from controller.process_settings import ControllerSettings
    from controller.settings import MpcSettings

    parameters, process = get_car(car), ControllerSettings()
    track = track or parameters.race_track
    table = path_on(track, raceline, parameters)
    folder = artefact or make(BuildSettings(car=parameters))[0]
    manifest = read_manifest(folder)
    manifest.check_car(parameters, folder)
    mpc = read_settings(settings, MpcSettings).parameters(parameters, manifest.problem.name)
    cycle = process.fallback, process.compensation, process.stale_s, process.sensor_tolerance
    values = mpc | cycle_values(parameters, *cycle)
    learned = None if weights is None else read_checked(weights, folder, parameters)
    write(out, manifest, table.rows, table.spacing_m, values, learned)
    typer.echo(f"{track}, {parameters.name}: {out}")


def _replace(source: str, target: str) -> None:
    """Copies beside the target and renames: a running controller keeps the library it loaded."""
    beside = f"{target}.new"
    shutil.copy2(source, beside)
    Path(beside).replace(target)
