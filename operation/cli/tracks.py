"""``tracks``: lists, checks, converts, smooths and draws tracks."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from bayesrace.errors import InputError
from operation.cli.options import writable

if TYPE_CHECKING:
    from bayesrace.tracks import Track
    from bayesrace.tracks.maps import RosMap

__all__ = ["tracks"]

_MAPS: Final = (".yaml", ".yml")


def tracks(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="TRACK",
            show_default="all built in",
            help="Built-in name, random:SEED, random10:SEED, CSV file or ROS map (YAML).",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", metavar="FILE", callback=writable, help="Write the track as CSV."
        ),
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option(metavar="FILE", callback=writable, help="Draw the track (SVG, PNG)."),
    ] = None,
    reverse: Annotated[bool, typer.Option("--reverse", help="Drive it the other way.")] = False,
    start: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y",
            show_default="as it is; of a map: 0,0",
            help="Start line at the node nearest to this point [m].",
        ),
    ] = None,
    smooth: Annotated[
        bool, typer.Option("--smooth", help="Take the noise off the points of a measured CSV file.")
    ] = False,
    recentre: Annotated[
        bool, typer.Option("--recentre", help="Make the first point of a CSV file the origin.")
    ] = False,
    car: Annotated[
        str, typer.Option(metavar="CAR", show_default="of any", help="Car whose scale to check.")
    ] = "",
) -> None:
    """List the built-in tracks, check a track, turn a ROS map into one, write or draw it."""
    from rich.table import Table

    from bayesrace.tracks import builtin_tracks, write_track
    from bayesrace.vehicles import get_car
    from operation.terminal.terminal import Terminal

    if name is None and (out or picture or start or reverse or smooth or recentre):
        options = "--out, --picture, --start, --reverse, --smooth and --recentre"
        raise InputError(f"{options} need the name of the track")
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
    from bayesrace.tracks import load_track

    is_map = Path(name).suffix in _MAPS
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
        return _smoothed(name, car_width_m)
    return _recentred(name, car_width_m) if recentre else (load_track(name, car_width_m), None, "")


def _smoothed(name: str, car_width_m: float | None) -> "tuple[Track, None, str]":
    """The smooth track in a file of measured points, and how far these are away from it."""
    import numpy as np

    from bayesrace.tracks import read_smoothed

    track, away_m = read_smoothed(name, car_width_m)
    rms_m, largest_m = float(np.sqrt(np.mean(away_m**2))), float(away_m.max())
    remark = f"{1e3 * rms_m:.1f} mm (RMS) and at most {1e3 * largest_m:.1f} mm away from the smooth"
    return track, None, f"{len(away_m)} points are {remark} centreline"


def _recentred(name: str, car_width_m: float | None) -> "tuple[Track, None, str]":
    """The track in a file, about its first point, and where that is in the file."""
    from bayesrace.tracks import read_recentred

    track, origin = read_recentred(name, car_width_m)
    return track, None, "the origin is at x = {}, y = {} of the file".format(*origin.tolist())


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
