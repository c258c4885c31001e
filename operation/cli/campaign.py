"""``campaign``, ``campaign-report``, ``campaign-worker``, ``tune``: laps by the thousand."""

from pathlib import Path
from typing import TYPE_CHECKING, Final

import typer

from bayesrace.operation.cli import options
from bayesrace.operation.cli.declaration import Given, options_of

if TYPE_CHECKING:
    from bayesrace.studies.settings import TuneSettings

__all__ = ["campaign", "campaign_report", "campaign_worker", "tune"]

_SCHEDULER: Final = options.value(
    "Dask scheduler, as tcp://HOST:8786 or tls://HOST:8786.", metavar="ADDRESS", shown="embedded"
)
_WORKERS: Final = options.value(
    "Processes on this machine.", 0, min=0, max=1024, shown="one a core"
)


def campaign(
    plan: Path = options.argument("PLAN", "TOML file that says what varies: docs/campaigns.md."),
    out: Path | None = options.out_folder("Folder of results.", "runs/NAME-OF-PLAN"),
    scheduler: str | None = _SCHEDULER,
    workers: int = _WORKERS,
    again: bool = options.flag("--again", "Compute cases that failed once more."),
) -> None:
    """Drive all cases of a plan, on this machine or on many; one row a lap in Parquet.

    What is there already is not computed again: the same command goes on after an interruption.
    Leaves laps.parquet and report.html.
    """
    from bayesrace.operation.terminal.terminal import Terminal
    from bayesrace.studies.campaign.campaign import run_campaign
    from bayesrace.studies.campaign.page import render_campaign
    from bayesrace.studies.campaign.plan import read_plan

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
    from bayesrace.studies.campaign.page import render_campaign

    typer.echo(str(render_campaign(folder)))


def campaign_worker(
    scheduler: str = options.argument("ADDRESS", "As tcp://HOST:8786."), workers: int = _WORKERS
) -> None:
    """Compute for a campaign elsewhere until its Dask scheduler ends."""
    from bayesrace.studies.campaign.campaign import run_worker

    run_worker(scheduler, workers)


@options_of("bayesrace.studies.settings.TuneSettings", "track held_out trials batch car seed")
def tune(
    settings: "Given[TuneSettings]",
    out: Path = options.out_file(Path("tuned.toml")),
    study: Path | None = options.value(
        "SQLite of trials.", metavar="FILE", shown="beside --out", callback=options.writable
    ),
    scheduler: str | None = _SCHEDULER,
    workers: int = _WORKERS,
) -> None:
    """Search weights of the OCP, margin, line friction and horizon that lap faster.

    Held-out tracks judge what is found. Leaves a car's file with it, which every command takes as
    --car; the same command goes on with the study after an interruption.
    """
    from bayesrace.operation.terminal.terminal import Terminal
    from bayesrace.studies.campaign.tune import print_verdict
    from bayesrace.studies.campaign.tune import tune as search

    with options.stages_shown() as stages:
        storage = study or out.with_suffix(".sqlite")
        verdict = search(settings(), out, storage, stages, scheduler, workers)
    print_verdict(verdict, Terminal())
    typer.echo(f"{out}")
