"""``tracks``, ``cars``, ``collect``, ``build``, ``export``: preparation of a drive, by files."""

import math
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from bayesrace.defaults import DEFAULT_CAR
from bayesrace.errors import InputError
from operation.cli import options
from operation.cli.fields import Given, options_of

if TYPE_CHECKING:
    from bayesrace.tracks import Track
    from bayesrace.tracks.maps import RosMap
    from codegen.settings import BuildSettings
    from operation.settings import PreparationSettings

__all__ = ["build", "cars", "collect", "export", "tracks"]


def tracks(
    name: str | None = options.argument(
        "TRACK",
        "Built-in name, random:SEED, random10:SEED, CSV file or ROS map (YAML).",
        None,
        "all built in",
    ),
    out: Path | None = options.new_file("Write the track as CSV.", "--out", "-o"),
    picture: Path | None = options.new_file("Draw the track (SVG, PNG)."),
    reverse: bool = options.flag("--reverse", "Drive it the other way."),
    start: str | None = options.value(
        "Start line at the node nearest to this point [m].",
        metavar="X,Y",
        shown="as it is; of a map: 0,0",
    ),
    smooth: bool = options.flag(
        "--smooth", "Take the noise off the points of a measured CSV file."
    ),
    recentre: bool = options.flag("--recentre", "Make the first point of a CSV file the origin."),
    car: str = options.value("Car whose scale to check.", "", shown="of any"),
) -> None:
    """List the built-in tracks, check a track, turn a ROS map into one, write or draw it."""
    from rich.table import Table

    from bayesrace.tracks import builtin_tracks, write_track
    from bayesrace.vehicles import get_car
    from operation.terminal.terminal import Terminal

    if name is None and (out or picture or start or reverse or smooth or recentre):
        those = "--out, --picture, --start, --reverse, --smooth and --recentre"
        raise InputError(f"{those} need the name of the track")
    if picture is not None:
        from operation.report.track_picture import check_picture, write_picture

        check_picture(picture)
    place = _point(start)
    car_width_m = get_car(car).width_m if car else None
    table = Table("track", "length m", "width m", "tightest radius m", "points")
    for one in [name] if name else builtin_tracks():
        track, grid, remark = _loaded(one, car_width_m, smooth, recentre)
        if place is not None or reverse:
            track = track.driven_from(place, reverse)
        table.add_row(*_cells(track))
        if out is not None:
            write_track(out, track)
        if picture is not None:
            write_picture(picture, track, grid)
    Terminal().print(table)
    if remark:
        typer.echo(remark)


def _loaded(
    name: str, car_width_m: float | None, smooth: bool, recentre: bool
) -> "tuple[Track, RosMap | None, str]":
    """The track, the map that it was found in, and what was done to its points."""
    import numpy as np

    from bayesrace.tracks import load_track, read_recentred, read_smoothed

    is_map = Path(name).suffix in (".yaml", ".yml")
    if smooth and recentre:
        raise InputError("--recentre and --smooth are a step each: smooth the file of the first")
    if (smooth or recentre) and (is_map or not Path(name).is_file()):
        option = "--smooth" if smooth else "--recentre"
        raise InputError(f"{option} is for a CSV file of measured points, not for '{name}'")
    if is_map:
        from bayesrace.tracks.maps import read_map, track_of_map

        grid = read_map(name)
        return track_of_map(grid, car_width_m), grid, ""
    if smooth:
        track, away_m = read_smoothed(name, car_width_m)
        rms_mm, largest_mm = 1e3 * np.sqrt(np.mean(away_m**2)), 1e3 * away_m.max()
        away = f"{rms_mm:.1f} mm (RMS) and at most {largest_mm:.1f} mm away"
        return track, None, f"{len(away_m)} points are {away} from the smooth centreline"
    if recentre:
        track, origin = read_recentred(name, car_width_m)
        x, y = origin.tolist()
        return track, None, f"the origin is at x = {x}, y = {y} of the file"
    return load_track(name, car_width_m), None, ""


def _cells(track: "Track") -> tuple[str, ...]:
    """A track's row of the table."""
    import numpy as np

    width = track.width_left_m + track.width_right_m
    bend = np.abs(track.curvature(np.arange(0, track.length_m, 0.01))).max()
    return (
        track.name, f"{track.length_m:.2f}", f"{width.min():.2f}–{width.max():.2f}",
        f"{1 / bend:.2f}", str(len(track.s_m)),
    )  # fmt: skip


def _point(text: str | None) -> tuple[float, float] | None:
    """The two numbers of an option."""
    if text is None:
        return None
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        x = y = math.nan
    if not (math.isfinite(x) and math.isfinite(y)):
        raise InputError(f"--start {text}: give x and y in metres, as 1.5,-2")
    return x, y


def cars(
    car: str | None = options.argument("CAR", "Built-in name or TOML file.", None, "all built in"),
    out: Path | None = options.new_file("Write the car as TOML, tuning included.", "--out", "-o"),
    tyres: options.Tyres = None,
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
