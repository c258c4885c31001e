"""``shadow``: evidence about a controller before it drives, with a verdict."""

from pathlib import Path

import typer

from bayesrace.errors import InputError
from bayesrace.operation.cli import options

__all__ = ["shadow"]


def shadow(
    logs: list[Path] = options.argument("LOG...", "Logs (MCAP) of drives with shadows."),
    at_most: str = options.value(
        "Bounds on the differences of the inputs, p99, as d=0.1,delta_rate=1.",
        "",
        metavar="BOUNDS",
        shown="none",
    ),
    weights: Path | None = options.value(
        "The shadow's GP weights: judged by one-step errors with the inputs that acted."
    ),
    against: Path | None = options.value(
        "GP weights of the controller that drove, for --weights.", shown="no correction"
    ),
    car: str = options.value("TOML file of the weights' car if it is not built in.", ""),
    track: str | None = options.value("Track, for places along it: name or CSV file."),
    junit: Path | None = options.new_file("Write the verdict as JUnit XML to this file."),
    out: Path | None = options.out_folder("Folder for shadow.json and pictures."),
) -> None:
    """Judge shadows ('bayesrace controller --shadow') by the drives that they were beside.

    Where they would have done otherwise, what their plans promised and what came, how long they
    took. Exit code 1 if a check fails; see docs/shadow.md.
    """
    from bayesrace.gp.weights import read_weights
    from bayesrace.operation.terminal.terminal import Terminal
    from bayesrace.studies.evidence.shadow.judgement import bounds, judge_shadows
    from bayesrace.tracks import load_track
    from bayesrace.vehicles import get_car

    if against is not None and weights is None:
        raise InputError("--against is for --weights: give both, or leave it out")
    new, old = (None if one is None else read_weights(one) for one in (weights, against))
    course = None if track is None else load_track(track)
    console, parameters = Terminal(), get_car(car) if car else None
    verdict = judge_shadows(logs, bounds(at_most), new, old, parameters, course, out, console)
    verdict.print(console)
    if junit is not None:
        verdict.write_junit(junit)
    raise typer.Exit(verdict.exit_code)
