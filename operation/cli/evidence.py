"""``replay``: evidence about a controller before it drives, each with a verdict."""

from pathlib import Path
from typing import Literal

import typer

from bayesrace.operation.cli import options

__all__ = ["replay"]


def replay(
    logs: list[Path] = options.argument(
        "LOG...", "Logs (MCAP), run directories, or folders of either."
    ),
    controller: Path | None = options.value(
        "Folder of 'bayesrace build': answer by this controller.",
        metavar="ARTEFACT",
        shown="that of the race, or built for the car",
    ),
    weights: Path | None = options.value(
        "GP weights to answer with.", metavar="FILE", shown="those recorded"
    ),
    host: Literal["python", "c", "fmu"] = options.value(
        "What hosts the controller: python; c or fmu, for lockstep drives.", "python"
    ),
    tolerance: str = options.value(
        "Largest differences, as d=1e-9,delta_rate=1e-7.",
        "",
        metavar="TOLERANCE",
        shown="0 for the recorded controller, none for another",
    ),
    against: Path | None = options.value(
        "Compare with an earlier --out, or other recordings of these drives.", metavar="FOLDER"
    ),
    car: str = options.value("Car: built-in name or TOML file.", "", shown="the recorded one"),
    track: str = options.value(
        "Built-in name or CSV file.", "", shown="race.csv or track.csv beside the log"
    ),
    raceline: Path | None = options.value(
        "Racing line.", shown="race_raceline.csv or raceline.csv beside the log, or computed"
    ),
    mpc: Path | None = options.value(
        "OCP settings (JSON).", None, "--settings", shown="mpc.json beside the log"
    ),
    junit: Path | None = options.new_file("Write the verdict as JUnit XML to this file."),
    out: Path | None = options.out_folder("Folder for result, inputs and pictures."),
) -> None:
    """Feed a controller what another was told in recorded drives, and compare the inputs.

    By the recorded controller they are equal to the bit, in real time as well. Exit code 1 if a
    check fails; see docs/replay.md.
    """
    from bayesrace.operation.terminal.terminal import Terminal
    from bayesrace.studies.evidence.replay.comparison import tolerance as parsed
    from bayesrace.studies.evidence.replay.controller import Given
    from bayesrace.studies.evidence.replay.run import replay as replay_all

    allowed = parsed(tolerance) if tolerance else None
    given = Given(controller, weights, host, car, track, raceline, mpc)
    with options.stages_shown() as stages:
        verdict = replay_all(logs, given, stages, allowed, against, out)
    verdict.print(Terminal())
    if junit is not None:
        verdict.write_junit(junit)
    raise typer.Exit(verdict.exit_code)
