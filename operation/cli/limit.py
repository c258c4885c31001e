"""``limit``: the fastest lap that a car can drive on a track."""

from pathlib import Path
from typing import Annotated

import typer

from bayesrace.clock import die_with_parent
from bayesrace.defaults import DEFAULT_CAR
from bayesrace.errors import InputError
from operation.cli.options import Car, ParentPid, Tyres, writable

__all__ = ["limit"]


def limit(
    track: Annotated[
        str,
        typer.Argument(
            metavar="TRACK", help="Built-in name, random:SEED, random10:SEED or CSV file."
        ),
    ],
    car: Car = DEFAULT_CAR,
    tyres: Tyres = None,
    standing: Annotated[
        bool, typer.Option("--standing", help="From the start pose; flying without.")
    ] = False,
    margin: Annotated[
        float,
        typer.Option(
            metavar="M", min=0, help="Least distance of the centre of gravity from the edge [m]."
        ),
    ] = 0.0,
    body: Annotated[
        bool, typer.Option("--body", help="The car's outline keeps the margin.")
    ] = False,
    start_speed: Annotated[
        float | None,
        typer.Option(
            metavar="V",
            min=0,
            max=5,
            show_default="0.1",
            help="Speed at the start of a standing lap [m/s].",
        ),
    ] = None,
    lateral_speed: Annotated[
        float | None,
        typer.Option(
            metavar="V",
            min=0.001,
            max=100,
            show_default="any",
            help="Largest lateral speed of the car [m/s], for a lap without slides.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", metavar="FILE", callback=writable, help="Write the lap as CSV."
        ),
    ] = None,
    parent_pid: ParentPid = None,
) -> None:
    """Compute the fastest lap of the true car: minimum-time optimal control.

    The dynamic model with tyres and actuator limits as the plant has them. The lap is computed
    again with half the intervals; it may not change by 0.1 %.
    """
    die_with_parent(parent_pid)
    from bayesrace.limit import LimitSettings, write_limit
    from bayesrace.limit.cached import limit as cached_limit
    from bayesrace.tracks import load_track
    from bayesrace.vehicles import get_car

    if start_speed is not None and not standing:
        raise InputError("--start-speed is that of a standing lap: add --standing, or leave it out")
    parameters = get_car(car)
    if tyres is not None:
        parameters = parameters.on_tyres(tyres.value)
    speed = {} if start_speed is None else {"start_speed_mps": start_speed}
    settings = LimitSettings(
        standing=standing, margin_m=margin, body=body, lateral_speed_mps=lateral_speed, **speed
    )
    lap = cached_limit(load_track(track, parameters.width_m), parameters, settings)
    typer.echo(
        f"{'standing' if standing else 'flying'} lap {lap.lap_s:.3f} s, "
        f"{'outline' if body else 'centre of gravity'} on the track"
        + (f" less {margin:g} m" if margin else "")
        + (f", at most {lateral_speed:g} m/s sideways" if lateral_speed else "")
        + f"; {100 * lap.mesh_change:.3f} % from half the intervals to {lap.intervals}, "
        f"solved in {lap.solve_s:.1f} s" + ("" if out is None else f": {out}")
    )
    if parameters.tyres.model == "linear":
        typer.echo("a lap of the equations, not of a car: linear tyres have no limit")
    if out is not None:
        write_limit(out, lap)
