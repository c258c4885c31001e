"""Workers: processes of this machine, or those that a scheduler elsewhere has.

Dask pickles what it sends, so the scheduler and its workers must be trusted. Our own tasks are
plain data. TLS is Dask's: an address ``tls://…`` and its configuration for the certificates.
"""

import logging
import os
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from typing import Any, Final

import dask
from distributed import Client, Future, as_completed
from distributed.scheduler import KilledWorker

from bayesrace.errors import InputError
from studies.campaign.case import Case, Files, software_identity
from studies.campaign.execute import FAILED, Row, run_case

__all__ = ["CampaignError", "computed", "connected", "rows_of", "run_worker"]

_PENDING: Final = 1000  # cases that the scheduler has at once

_DASK: Final[dict[str, Any]] = {
    # A case that was on a worker when it died is not to blame, unless that happens often.
    "distributed.scheduler.allowed-failures": 5,
    "distributed.admin.tick.limit": "1h",  # a worker that computes in C is not stuck
    "distributed.diagnostics.nvml": False,
}


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
