"""Workers: an embedded cluster of this machine, or one that a scheduler elsewhere has.

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
from distributed import Client, Future, LocalCluster, as_completed
from distributed.scheduler import KilledWorker

from bayesrace.errors import InputError
from studies.campaign.case import Case, Files, software_identity
from studies.campaign.execute import FAILED, Row, run_case

__all__ = ["CampaignError", "computed", "connected", "rows_of", "run_worker"]

_PENDING: Final = 1000
"""Cases that the scheduler has at once."""

_PATIENCE_S: Final = 60.0
"""For a first worker."""

_QUIET: Final[dict[str, Any]] = {
    # A case that was on a worker when it died is not to blame, unless that happens often.
    "distributed.scheduler.allowed-failures": 5,
    "distributed.admin.tick.limit": "1h",  # a worker that computes in C is not stuck
    "distributed.diagnostics.nvml": False,
}


class CampaignError(RuntimeError):
    """The workers cannot go on; the message says why. What was computed is kept."""


@contextmanager
def connected(scheduler: str | None, workers: int) -> Iterator[Client]:
    """A client of the scheduler, or of ``workers`` processes of this machine (0: one a core).

    Raises InputError if there is no scheduler, or no worker of it within a minute.
    """
    for name in ("distributed", "distributed.client", "bokeh"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with dask.config.set(_QUIET):
        if scheduler is None:
            count = workers or len(os.sched_getaffinity(0))
            with _local(count) as cluster, Client(cluster) as client:
                yield client
            return
        try:
            client = Client(scheduler, timeout=10)
        except (OSError, ValueError, TypeError) as error:
            raise InputError(
                f"no scheduler at {scheduler}: {error}; start one by 'dask scheduler', and name "
                "its address as it prints it"
            ) from None
        with client:
            try:
                client.wait_for_workers(1, timeout=_PATIENCE_S)
            except TimeoutError:
                raise InputError(
                    f"the scheduler at {scheduler} has no worker; start some by "
                    f"'bayesrace campaign-worker {scheduler}'"
                ) from None
            yield client


@contextmanager
def _local(count: int) -> Iterator[LocalCluster]:
    """Processes of one thread each, on loopback; they end with this process, however it ends."""
    options = {
        "n_workers": count,
        "threads_per_worker": 1,
        "host": "127.0.0.1",
        "silence_logs": logging.CRITICAL,
    }
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Port 8787 is already in use")  # another one serves
            cluster = LocalCluster(dashboard_address="127.0.0.1:8787", **options)
    except (OSError, RuntimeError) as error:
        raise CampaignError(f"the workers could not be started: {error}") from None
    with cluster:
        yield cluster


def run_worker(scheduler: str, workers: int) -> None:
    """Serves a scheduler with this many processes (0: one a core) until it ends."""
    from distributed.cli.dask_worker import main

    count = workers or len(os.sched_getaffinity(0))
    options = ["--nworkers", str(count), "--nthreads", "1", "--death-timeout", "60"]
    main([scheduler, *options], standalone_mode=False)


def computed(
    client: Client, cases: Iterable[tuple[str, Case]], files: Files
) -> Iterator[list[tuple[str, list[Row]]]]:
    """Key and rows of each case as it is computed, as many at once as are there.

    A case whose workers died again and again has a row with that reason. Raises CampaignError if
    the scheduler is lost, or a worker has another version of the software.
    """
    # A task that returns the files, in place of files in every task: sent once to each worker.
    shared = client.submit(dict, files, pure=False)
    source = iter(cases)

    def submitted(most: int) -> list[Future]:
        return [
            client.submit(run_case, case.task(), shared, key=f"case-{key}", pure=False)
            for key, case in islice(source, most)
        ]

    results = as_completed(submitted(_PENDING), with_results=True, raise_errors=False)
    for batch in results.batches():
        rows = [(future.key.removeprefix("case-"), rows_of(future, one)) for future, one in batch]
        results.update(submitted(len(batch)))
        yield rows


def rows_of(future: Future, result: Any) -> list[Row]:
    """The rows of a case that is over; CampaignError if no worker can compute."""
    if future.status == "finished":
        rows: list[Row] = result
        return rows
    if future.status != "error":
        raise CampaignError("the scheduler was lost; start the same campaign again to go on")
    error = future.exception()
    if isinstance(error, KilledWorker):
        reason = f"{type(error).__name__}: each worker that computed this case has died"
        return [{"software": software_identity(), "ended": FAILED, "reason": reason}]
    raise CampaignError(f"a worker cannot compute: {type(error).__name__}: {error}")
