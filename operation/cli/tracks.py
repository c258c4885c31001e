"""``tracks``, ``cars``, ``raceline``, ``limit``: what there is to drive, and how fast it can be."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import typer

from bayesrace.errors import InputError
from bayesrace.operation.cli import options
from bayesrace.operation.cli.declaration import Given, options_of
from bayesrace.processes import die_with_parent

if TYPE_CHECKING:
    from bayesrace.limit import LimitSettings
    from bayesrace.operation.settings import BayesianSettings
    from bayesrace.tracks import Track

__all__ = ["cars", "limit", "raceline", "tracks"]


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

    from bayesrace.operation.terminal.terminal import Terminal
    from bayesrace.tracks import builtin_tracks, load_any, write_track
    from bayesrace.vehicles import get_car

    if name is None and (out or picture or start or reverse or smooth or recentre):
        those = "--out, --picture, --start, --reverse, --smooth and --recentre"
        raise InputError(f"{those} need the name of the track")
    if picture is not None:
        from bayesrace.operation.report.maps import check_picture, write_picture

        check_picture(picture)
    place = _point(start)
    car_width_m = get_car(car).width_m if car else None
    table = Table("track", "length m", "width m", "tightest radius m", "points")
    for one in [name] if name else builtin_tracks():
        track, grid, remark = load_any(one, car_width_m, smooth, recentre)
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
    tyres: options.Tyres = options.TYRES,
) -> None:
    """List the built-in cars, check a car's file, or write a car to a file with all its values."""
    from rich.table import Table

    from bayesrace.operation.terminal.terminal import Terminal
    from bayesrace.vehicles import builtin_cars, get_car, write_car

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
    "bayesrace.operation.settings.BayesianSettings",
    "friction margin_m objective nodes evaluations seed",
)
def raceline(
    settings: "Given[BayesianSettings]",
    track: str = options.COURSE,
    out: Path = options.out_file(Path("raceline.csv")),
    car: str = options.CAR,
    method: Literal["minimum-time", "bayesian"] = options.value(
        "minimum-time, or bayesian (Jain and Morari 2020).", "minimum-time"
    ),
    weights: Path | None = options.value("Weights for --objective driven.", shown="trained"),
) -> None:
    """Compute a racing line of a track: of minimum time, or by Bayesian optimisation.

    --friction and --margin are for both methods; the options from --objective to --seed and
    --weights are for the second.
    """
    from bayesrace.raceline import RaceLineSettings, racing_line, write_raceline
    from bayesrace.tracks import load_track
    from bayesrace.vehicles import get_car

    parameters, chosen = get_car(car), settings()
    if method == "minimum-time":
        given = {*settings.flags, *(["--weights"] if weights else [])}
        if wrong := sorted(given - {"--friction", "--margin"}):
            raise InputError(f"{wrong[0]} needs --method bayesian")
        plain = RaceLineSettings(friction=chosen.friction, margin_m=chosen.margin_m)
        line = racing_line(load_track(track, parameters.width_m), parameters, plain)
        write_raceline(out, line)
        typer.echo(f"{line.length_m:.2f} m in {line.lap_time_s:.3f} s: {out}")
        return
    from bayesrace.operation.line_search import searched_line

    if weights is not None and chosen.objective != "driven":
        raise InputError("--weights needs --objective driven")
    with options.stages_shown() as stages:
        found = searched_line(track, parameters, chosen, stages, weights)
    write_raceline(out, found.line)
    typer.echo(
        f"{found.line.length_m:.2f} m in {found.lap_s:.3f} s ({chosen.objective} lap; along the "
        f"minimum-time line {found.direct_s:.3f} s): {out}"
    )


@options_of(
    "bayesrace.limit.LimitSettings", "standing margin_m body start_speed_mps lateral_speed_mps"
)
def limit(
    settings: "Given[LimitSettings]",
    track: str = options.COURSE,
    car: str = options.CAR,
    tyres: options.Tyres = options.TYRES,
    out: Path | None = options.new_file("Write the lap as CSV.", "--out", "-o"),
    parent_pid: int | None = options.PARENT_PID,
) -> None:
    """Compute the fastest lap of the true car: minimum-time optimal control.

    The dynamic model with tyres and actuator limits as the plant has them. The lap is computed
    again with half the intervals; it may not change by 0.1 %.
    """
    die_with_parent(parent_pid)
    from bayesrace.limit import limit_lap, write_limit
    from bayesrace.tracks import load_track
    from bayesrace.vehicles import get_car

    chosen, parameters = settings(), get_car(car)
    sideways = chosen.lateral_speed_mps
    if "--start-speed" in settings.flags and not chosen.standing:
        raise InputError("--start-speed is that of a standing lap: add --standing, or leave it out")
    if tyres is not None:
        parameters = parameters.on_tyres(tyres)
    lap = limit_lap(load_track(track, parameters.width_m), parameters, chosen)
    typer.echo(
        f"{'standing' if chosen.standing else 'flying'} lap {lap.lap_s:.3f} s, "
        f"{'outline' if chosen.body else 'centre of gravity'} on the track"
        + (f" less {chosen.margin_m:g} m" if chosen.margin_m else "")
        + (f", at most {sideways:g} m/s sideways" if sideways else "")
        + f"; {100 * lap.mesh_change:.3f} % from half the intervals to {lap.intervals}, "
        f"solved in {lap.solve_s:.1f} s" + ("" if out is None else f": {out}")
    )
    if not parameters.has_limit:
        typer.echo("a lap of the equations, not of a car: linear tyres have no limit")
    if out is not None:
        write_limit(out, lap)
