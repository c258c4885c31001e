"""Runs a campaign to its end: hands out what is not computed yet, keeps what comes back."""

import time
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, Final

from distributed import Client, Future, as_completed
from distributed.scheduler import KilledWorker
from rich import progress
from rich.console import Console

from bayesrace.files import write_whole
from bayesrace.processes import raise_if_interrupted
from bayesrace.studies.campaign.case import (
    FAILED,
    Case,
    Files,
    Row,
    car_identity,
    run_case,
    software_identity,
)
from bayesrace.studies.campaign.cluster import CampaignError, Remote, connected
from bayesrace.studies.campaign.plan import Campaign
from bayesrace.studies.campaign.results import writing
from bayesrace.vehicles import write_car

__all__ = ["run_campaign", "computed", "rows_of"]

_LINE_S: Final = 10.0  # between two lines of progress where there is no terminal
_PENDING: Final = 1000  # cases that the scheduler has at once


def run_campaign(
    campaign: Campaign,
    out: Path,
    console: Console,
    remote: Remote | None,
    workers: int,
    again: bool,
) -> str:
    """Computes the cases that ``out`` has no results of; ``again``: those that failed, too.

    ``remote``: the scheduler. Returns how many laps were computed now, and how many cases failed.
    Raises InputError if there is no scheduler, CampaignError if the workers are lost, and
    KeyboardInterrupt on Ctrl-C; what was computed is kept in every case.
    """
    with writing(out) as results:
        write_whole(out / "plan.toml", campaign.text)
        (out / "cars").mkdir(exist_ok=True)
        for car in campaign.cars:
            write_car(out / "cars" / f"{car_identity(car)}.toml", car)
        done = results.done(again)
        # By key, and so in no order: neighbours rarely wait for the same line or weights.
        left = {key: case for key, case in sorted(campaign.cases.items()) if key not in done}
        if known := len(campaign.cases) - len(left):
            console.print(f"{known} of {len(campaign.cases)} cases are there already")
        if not left:
            return "0 laps"
        cases = laps = failed = 0
        begun_s, said_s = time.monotonic(), 0.0
        with connected(remote, workers) as client, _bar(console) as bar:
            if remote is None:  # another machine's can be reached there alone
                console.print(f"live: {client.dashboard_link}", highlight=False, soft_wrap=True)
            task = bar.add_task("", total=len(left), note="")
            for batch in computed(client, left.items(), campaign.files):
                results.add([left[key].columns | row for key, own in batch for row in own])
                cases += len(batch)
                laps += sum(one.get("lap_time_s") is not None for _, own in batch for one in own)
                failed += sum(any(one["ended"] == FAILED for one in own) for _, own in batch)
                note = f"{laps} laps" + (f", {failed} failed" if failed else "")
                bar.update(task, completed=cases, note=note)
                took_s = time.monotonic() - begun_s
                if bar.disable and (took_s > said_s + _LINE_S or cases == len(left)):
                    left_s, said_s = took_s * (len(left) / cases - 1), took_s
                    text = f"{cases} of {len(left)} cases, {note}, {left_s:.0f} s left"
                    console.print(text, highlight=False)
                raise_if_interrupted()
        return note


def _bar(console: Console) -> progress.Progress:
    """How far it is, and how long it will take, on a terminal."""
    return progress.Progress(
        progress.BarColumn(bar_width=24), progress.MofNCompleteColumn(),
        progress.TimeElapsedColumn(), "[dim]left", progress.TimeRemainingColumn(),
        "[dim]{task.fields[note]}", console=console, speed_estimate_period=300,
        disable=not console.is_terminal,
    )  # fmt: skip


def computed(
    client: Client, cases: Iterable[tuple[str, Case]], files: Files
) -> Iterator[list[tuple[str, list[Row]]]]:
    """Key and rows of each case as it is computed, as many at once as are there.

    A case whose workers died again and again has a row with that reason. Raises CampaignError if
    the scheduler is lost, or a worker has another version of the software.
    """
    # A task that returns the files, in place of files in every task: sent once to each worker.
    shared = client.submit(dict, dict(files), pure=False)
    futures = (
        client.submit(run_case, case.task(), shared, key=f"case-{key}", pure=False)
        for key, case in cases
    )
    results = as_completed(islice(futures, _PENDING), with_results=True, raise_errors=False)
    for batch in results.batches():
        rows = [(future.key.removeprefix("case-"), rows_of(future, one)) for future, one in batch]
        results.update(list(islice(futures, len(batch))))
        yield rows


def rows_of(future: Future, result: Any) -> list[Row]:
    """The rows of a case that is over; CampaignError if no worker can compute."""
    if future.status == "finished":
        rows: list[Row] = result
        return rows
    if future.status != "error":
        raise CampaignError("the scheduler was lost; start the same campaign again to go on")
    error = future.exception()
    if not isinstance(error, KilledWorker):
        raise CampaignError(f"a worker cannot compute: {type(error).__name__}: {error}")
    reason = "KilledWorker: each worker that computed this case has died"
    return [{"software": software_identity(), "ended": FAILED, "reason": reason}]
