"""Runs a campaign to its end: hands out what is not computed yet, keeps what comes back.

Workers are processes of this machine, or those that a scheduler elsewhere has. Dask pickles what it
sends, so the scheduler and its workers must be trusted. Our own tasks are plain data. TLS is
Dask's: an address ``tls://…`` and its configuration for the certificates.
"""

import logging
import os
import time
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any, Final

import dask
from distributed import Client, Future, as_completed
from distributed.scheduler import KilledWorker
from rich import progress
from rich.console import Console

from bayesrace.errors import InputError
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
from bayesrace.studies.campaign.plan import Campaign
from bayesrace.studies.campaign.results import writing
from bayesrace.vehicles import write_car

__all__ = ["run_campaign", "CampaignError", "computed", "connected", "rows_of", "run_worker"]

_LINE_S: Final = 10.0  # between two lines of progress where there is no terminal
_PENDING: Final = 1000  # cases that the scheduler has at once

_DASK: Final[dict[str, Any]] = {
    # A case that was on a worker when it died is not to blame, unless that happens often.
    "distributed.scheduler.allowed-failures": 5,
    "distributed.admin.tick.limit": "1h",  # a worker that computes in C is not stuck
    "distributed.diagnostics.nvml": False,
}


def run_campaign(
    campaign: Campaign, out: Path, console: Console, where: str | None, workers: int, again: bool
) -> str:
    """Computes the cases that ``out`` has no results of; ``again``: those that failed, too.

    ``where``: the scheduler. Returns how many laps were computed now, and how many cases failed.
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
        with connected(where, workers) as client, _bar(console) as bar:
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


class CampaignError(RuntimeError):
    """The workers cannot go on; the message says why. What was computed is kept."""


@contextmanager
def connected(scheduler: str | None, workers: int) -> Iterator[Client]:
    """A client of the scheduler, or of ``workers`` processes of this machine (0: one a core), on
    loopback, which end with this process, however it ends.

    Raises InputError if there is no scheduler, or no worker of it within a minute.
    """
    for name in ("distributed", "distributed.client", "bokeh"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    where: dict[str, Any] = {"address": scheduler, "timeout": 10}
    if scheduler is None:
        where = {
            "n_workers": workers or _cores(), "threads_per_worker": 1, "host": "127.0.0.1",
            "dashboard_address": "127.0.0.1:8787", "silence_logs": logging.CRITICAL,
        }  # fmt: skip
    with dask.config.set(_DASK), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Port 8787 is already in use")  # another one serves
        try:
            client = Client(**where)
        except (OSError, RuntimeError, TypeError, ValueError) as error:
            if scheduler is None:
                raise CampaignError(f"the workers could not be started: {error}") from None
            remedy = "start one by 'dask scheduler', and name its address as it prints it"
            raise InputError(f"no scheduler at {scheduler}: {error}; {remedy}") from None
        with client:
            try:
                client.wait_for_workers(1, timeout=60)
            except TimeoutError:
                remedy = f"start some by 'bayesrace campaign-worker {scheduler}'"
                raise InputError(f"the scheduler at {scheduler} has no worker; {remedy}") from None
            yield client


def _cores() -> int:
    return len(os.sched_getaffinity(0))


def run_worker(scheduler: str, workers: int) -> None:
    """Serves a scheduler with this many processes (0: one a core) until it ends."""
    from distributed.cli.dask_worker import main

    options = ["--nworkers", str(workers or _cores()), "--nthreads", "1", "--death-timeout", "60"]
    main([scheduler, *options], standalone_mode=False)


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
