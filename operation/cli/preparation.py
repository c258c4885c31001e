"""``collect``, ``build``, ``export``: preparation of a drive, by files."""

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from bayesrace.defaults import DEFAULT_CAR
from operation.cli import options
from operation.cli.fields import Given, options_of

if TYPE_CHECKING:
    from codegen.settings import BuildSettings
    from operation.settings import PreparationSettings

__all__ = ["build", "collect", "export"]


@options_of(
    "operation.settings.PreparationSettings",
    "collect_s=--duration pursuit.style seed fmu fmu_map simulator car",
)
def collect(
    track: options.TrackName,
    raceline: options.RaceLineFile,
    settings: "Given[PreparationSettings]",
    out: options.OutFile = Path("collect.mcap"),
) -> None:
    """Drive a track by pure pursuit and log the drive as training data."""
    from bayesrace.raceline import read_raceline_for
    from bayesrace.tracks import load_track
    from codegen.build import build
    from codegen.compiler import compiled
    from codegen.settings import BuildSettings
    from operation.collect import collect as drive
    from operation.training_line import drive_length_s
    from plant.vehicle import open_vehicle

    chosen = settings()
    car = chosen.car
    course = load_track(track, car.width_m)
    line = read_raceline_for(raceline, course, car)
    pursuit = chosen.pursuit.model_copy(update={"seed": chosen.seed})
    vehicles = open_vehicle(
        car, chosen.fmu, chosen.fmu_map, compiled=compiled, simulator=chosen.simulator
    )
    with vehicles as vehicle:
        duration_s = chosen.collect_s or drive_length_s(car, line)
        artefact, _ = build(BuildSettings(car=car))
        driven = drive(course, line, car, artefact, out, duration_s, pursuit, vehicle=vehicle)
    off_track_m = course.project_path(driven.x[:, :2]).off_track_m
    typer.echo(
        f"{len(driven.u)} samples, {int((off_track_m > 0).sum())} of them off the track, "
        f"up to {float(driven.x[:, 3].max()):.2f} m/s: {out}"
    )


@options_of("codegen.settings.BuildSettings", "model problem horizon gp_capacity car")
def build(
    settings: "Given[BuildSettings]",
    out: Path | None = options.out_folder("Copy the artefact here."),
) -> None:
    """Generate and compile a controller, or take it from the cache; prints its folder."""
    from bayesrace.integrators import PERFECT
    from codegen.build import build as make

    chosen = settings()
    if chosen.model == "dynamic":
        chosen = settings(discretisation=PERFECT)
    folder, _ = make(chosen)
    if out is not None:
        shutil.copytree(folder, out, dirs_exist_ok=True, copy_function=_replace)
        folder = out
    typer.echo(f"{folder}")


def _replace(source: str, target: str) -> None:
    """Copies beside the target and renames: a running controller keeps the library it loaded."""
    beside = f"{target}.new"
    shutil.copy2(source, beside)
    Path(beside).replace(target)


def export(
    out: Path = options.argument("DIR", "Folder to write into."),
    track: options.TrackName = "",
    raceline: options.GivenLine = None,
    weights: options.Weights = None,
    mpc: options.MpcFile = None,
    artefact: Path | None = options.value(
        "Folder of 'bayesrace build'.", metavar="DIR", shown="built"
    ),
    car: options.Car = DEFAULT_CAR,
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
    table = options.path_on(track, raceline, parameters)
    folder = artefact or make(BuildSettings(car=parameters))[0]
    manifest = read_manifest(folder)
    manifest.check_car(parameters, folder)
    values = read_settings(mpc, MpcSettings).parameters(parameters, manifest.problem.name)
    cycle = process.fallback, process.compensation, process.stale_s, process.sensor_tolerance
    values |= cycle_values(parameters, *cycle)
    learned = None if weights is None else read_checked(weights, folder, parameters)
    write(out, manifest, table.rows, table.spacing_m, values, learned)
    typer.echo(f"{track}, {parameters.name}: {out}")
