"""``raceline``: the racing line of a track, by either method."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Final

import typer

from bayesrace.defaults import DEFAULT_CAR
from bayesrace.errors import InputError
from operation.cli.options import Car, OutFile, writable

__all__ = ["raceline"]


class LineMethod(StrEnum):
    """How a racing line is found."""

    minimum_time = "minimum-time"
    bayesian = "bayesian"


class LapKind(StrEnum):
    """Lap time that the Bayesian optimisation minimises."""

    ideal = "ideal"
    driven = "driven"


_BAYESIAN: Final = (
    "objective", "nodes", "evaluations", "patience", "trials", "curve", "weights", "seed"
)  # fmt: skip
"""Options of the Bayesian optimisation alone."""


def raceline(
    context: typer.Context,
    track: Annotated[
        str,
        typer.Argument(
            metavar="TRACK", help="Built-in name, random:SEED, random10:SEED or CSV file."
        ),
    ],
    out: OutFile = Path("raceline.csv"),
    car: Car = DEFAULT_CAR,
    friction: Annotated[
        float | None,
        typer.Option(metavar="MU", show_default="the car's", help="Usable acceleration over g."),
    ] = None,
    margin: Annotated[
        float | None,
        typer.Option(
            metavar="M",
            show_default="by the car's width",
            help="Least distance of the centre of gravity from the track's edge [m].",
        ),
    ] = None,
    method: Annotated[
        LineMethod,
        typer.Option(metavar="METHOD", help="minimum-time, or bayesian (Jain and Morari 2020)."),
    ] = LineMethod.minimum_time,
    objective: Annotated[
        LapKind,
        typer.Option(metavar="LAP", help="bayesian: lap to minimise, ideal or driven."),
    ] = LapKind.ideal,
    nodes: Annotated[
        int, typer.Option(metavar="N", min=6, max=60, help="bayesian: nodes of the line.")
    ] = 21,
    evaluations: Annotated[
        int, typer.Option(metavar="N", min=11, max=2000, help="bayesian: laps, 10 random first.")
    ] = 110,
    patience: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=1,
            show_default="never",
            help="bayesian: end after as many laps without a gain of 0.1 %.",
        ),
    ] = None,
    trials: Annotated[
        int, typer.Option(metavar="N", min=1, max=100, help="bayesian: searches, seed by seed.")
    ] = 1,
    curve: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            callback=writable,
            help="bayesian: best lap against evaluations, beside random search (SVG, PNG, CSV).",
        ),
    ] = None,
    weights: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", show_default="trained", help="bayesian: weights for --objective driven."
        ),
    ] = None,
    seed: Annotated[
        int, typer.Option(min=0, max=2**32 - 1, metavar="N", help="bayesian: seed of the search.")
    ] = 0,
) -> None:
    """Compute a racing line of a track: of minimum time, or by Bayesian optimisation."""
    from bayesrace.raceline import RaceLineSettings, write_raceline
    from bayesrace.raceline.cached import racing_line
    from bayesrace.tracks import load_track
    from bayesrace.vehicles import get_car

    parameters = get_car(car)
    settings = RaceLineSettings(friction=friction, margin_m=margin)
    course = load_track(track, parameters.width_m)
    if method is LineMethod.minimum_time:
        for name in _BAYESIAN:
            source = context.get_parameter_source(name)
            if source is not None and source.name == "COMMANDLINE":
                raise InputError(f"--{name} needs --method bayesian")
        line = racing_line(course, parameters, settings)
        write_raceline(out, line)
        typer.echo(f"{line.length_m:.2f} m in {line.lap_time_s:.3f} s: {out}")
        return
    from learning.search import SearchSettings
    from operation.line_search import (
        BayesianSettings,
        Lap,
        check_curve,
        driven_lap,
        ideal_lap,
        search_lines,
        write_curve,
    )
    from operation.preparation import prepare
    from operation.settings import PreparationSettings
    from operation.terminal.progress import stages_on
    from operation.terminal.terminal import Terminal

    if curve is not None:
        check_curve(curve)
        if curve.with_suffix(".csv") == out:
            raise InputError(f"--curve {curve} writes {out}, too: give --out another name")
    if weights is not None and objective is not LapKind.driven:
        raise InputError("--weights needs --objective driven")
    how = BayesianSettings(
        **settings.model_dump(),
        nodes=nodes,
        objective=objective.value,
        search=SearchSettings(evaluations=evaluations, patience=patience, seed=seed),
    )
    with stages_on(Terminal()) as stages:
        lap: Lap = ideal_lap
        if objective is LapKind.driven:
            preparation = PreparationSettings(car=parameters, raceline=settings)
            parameters = preparation.driven_car
            made = prepare(preparation, (track,), stages, weights=weights)
            lap = driven_lap(made.artefacts[0], made.weights, course, parameters)
        direct_s = lap(racing_line(course, parameters, settings))
        found = search_lines(course, parameters, how, lap, stages, trials, curve is not None)
    write_raceline(out, found.line)
    if curve is not None:
        write_curve(curve, found, direct_s)
    typer.echo(
        f"{found.line.length_m:.2f} m in {found.lap_s:.3f} s ({objective.value} lap; along the "
        f"minimum-time line {direct_s:.3f} s): {out}"
    )
