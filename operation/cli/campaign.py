"""``campaign``, ``campaign-report``, ``campaign-worker``, ``tune``: laps by the thousand."""

from pathlib import Path
from typing import Annotated

import typer

from bayesrace.defaults import DEFAULT_CAR
from operation.cli import options

__all__ = ["campaign", "campaign_report", "campaign_worker", "tune"]

_TUNED_ON = ("harbour", "random:21..24")
_JUDGED_ON = ("random:31..36",)

Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        show_default="embedded",
        help="Dask scheduler, as tcp://HOST:8786 or tls://HOST:8786.",
    ),
]
Workers = Annotated[
    int,
    typer.Option(min=0, max=1024, show_default="one a core", help="Processes on this machine."),
]


def campaign(
    plan: Path = options.argument("PLAN", "TOML file that says what varies: docs/campaigns.md."),
    out: Path | None = options.out_folder("Folder of results.", "runs/NAME-OF-PLAN"),
    scheduler: Scheduler = None,
    workers: Workers = 0,
    again: bool = options.flag("--again", "Compute cases that failed once more."),
) -> None:
    """Drive all cases of a plan, on this machine or on many; one row a lap in Parquet.

    What is there already is not computed again: the same command goes on after an interruption.
    Leaves laps.parquet and report.html.
    """
    from operation.terminal.terminal import Terminal
    from studies.campaign.campaign import run_campaign
    from studies.campaign.page import render_campaign
    from studies.campaign.plan import read_plan

    read = read_plan(plan)
    folder = out or Path("runs") / plan.stem
    console = Terminal()
    outcome = run_campaign(read, folder, console, scheduler, workers, again)
    console.print(f"{len(read.cases)} cases; computed now: {outcome}", highlight=False)
    console.print(f"{render_campaign(folder)}", highlight=False, soft_wrap=True)


def campaign_report(
    folder: Path = options.argument("DIR", "Folder of a campaign's results."),
) -> None:
    """Make the report of a campaign again from its Parquet files."""
    from studies.campaign.page import render_campaign

    typer.echo(str(render_campaign(folder)))


def campaign_worker(
    scheduler: str = options.argument("ADDRESS", "As tcp://HOST:8786."), workers: Workers = 0
) -> None:
    """Compute for a campaign elsewhere until its Dask scheduler ends."""
    from studies.campaign.campaign import run_worker

    run_worker(scheduler, workers)


def tune(
    track: list[str] = options.value(
        "Track to tune on: a name, random:SEED, random:FIRST..LAST; repeatable.",
        (),
        shown="harbour, random:21..24",
    ),
    held_out: list[str] = options.value(
        "Track that judges the result; repeatable.", (), metavar="TRACK", shown="random:31..36"
    ),
    trials: int = options.value("Trials, the defaults included.", 60, min=1, max=100_000),
    batch: int = options.value("Trials that are proposed at once.", 4, min=1, max=1000),
    out: options.OutFile = Path("tuned.toml"),
    study: Path | None = options.value(
        "SQLite of trials.", metavar="FILE", shown="beside --out", callback=options.writable
    ),
    car: options.Car = DEFAULT_CAR,
    seed: int = options.value("Seed of the search.", 0, min=0),
    scheduler: Scheduler = None,
    workers: Workers = 0,
) -> None:
    """Search weights of the OCP, margin, line friction and horizon that lap faster.

    Held-out tracks judge what is found. Leaves a car's file with it, which every command takes as
    --car; the same command goes on with the study after an interruption.
    """
    from bayesrace.vehicles import get_car
    from operation.terminal.terminal import Terminal
    from studies.campaign.plan import spread
    from studies.campaign.tune import TuneSettings, print_verdict
    from studies.campaign.tune import tune as search

    settings = TuneSettings(
        car=get_car(car),
        tracks=tuple(name for one in track or _TUNED_ON for name in spread(one)),
        held_out=tuple(name for one in held_out or _JUDGED_ON for name in spread(one)),
        trials=trials,
        batch=batch,
        seed=seed,
    )
    with options.stages_shown() as stages:
        storage = study or out.with_suffix(".sqlite")
        verdict = search(settings, out, storage, stages, scheduler, workers)
    print_verdict(verdict, Terminal())
    typer.echo(f"{out}")
