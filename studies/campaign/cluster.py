"""Scheduler and workers of a campaign (Dask): processes of this machine, or of several.

Dask runs what a client sends. So each connection is TLS with one key at both ends: a process
without it gets none. On one machine the key is in the memory of the campaign and of its workers,
which get it through a pipe. Several machines share a file that ``campaign-scheduler`` makes.
"""

import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, Final, NamedTuple, Self
from urllib.parse import urlsplit

import dask
from distributed import Client, Security

from bayesrace.errors import InputError
from bayesrace.files import check_private, read_whole, temporary_folder, write_whole

__all__ = ["CampaignError", "Remote", "connected", "run_scheduler", "run_worker"]

_DASHBOARD: Final = "127.0.0.1:8787"

_DASK: Final[dict[str, Any]] = {
    # A case that was on a worker when it died is not to blame, unless that happens often.
    "distributed.scheduler.allowed-failures": 5,
    "distributed.admin.tick.limit": "1h",  # a worker that computes in C is not stuck
    "distributed.diagnostics.nvml": False,
    "distributed.comm.require-encryption": True,
    # Pages that show. By default there are some that fetch others' pages, too.
    "distributed.scheduler.http.routes": [
        "distributed.http.scheduler.info", "distributed.http.statics"
    ],
    "distributed.worker.http.routes": [],
    # And not to web pages of other origins: none but http://localhost with its port.
    "distributed.scheduler.dashboard.bokeh-application.allow_websocket_origin": [],
    "distributed.dashboard.link": "{scheme}://localhost:{port}/status",
}  # fmt: skip


class CampaignError(RuntimeError):
    """The workers cannot go on; the message says why. What was computed is kept."""


class Remote(NamedTuple):
    """A scheduler on several machines, and the file of the key that all its connections need."""

    address: str
    key: Path

    @classmethod
    def checked(cls, address: str, key: Path | None) -> Self:
        """InputError without TLS, or without a key that only this user can read."""
        try:
            url = urlsplit(address)
            secured = url.scheme == "tls" and bool(url.hostname) and url.port is not None
        except ValueError:  # a port beyond 65535
            secured = False
        if not secured or key is None:
            raise InputError(
                f"{address}: without TLS and a key, anybody could run code on the workers; name "
                "it as tls://HOST:8786, with the --key that 'bayesrace campaign-scheduler' makes"
            )
        remedy = "copy the one that 'bayesrace campaign-scheduler' has made"
        read_whole(key, "key", remedy=remedy)
        check_private(key)
        checked = cls(address, key)
        try:
            checked.security.get_connection_args("client")
        except OSError as error:  # OpenSSL's
            raise InputError(f"{key} holds no key: {error.strerror}; {remedy}") from None
        return checked

    @property
    def security(self) -> Security:
        """Of a client."""
        own = str(self.key)
        return Security(
            require_encryption=True, tls_ca_file=own, tls_client_cert=own, tls_client_key=own
        )

    @property
    def options(self) -> list[str]:
        """The same for Dask's own programs."""
        own = str(self.key)
        return ["--tls-ca-file", own, "--tls-cert", own, "--tls-key", own]


@contextmanager
def _configured() -> Iterator[None]:
    """Dask's settings for the block. It imports modules from its temporary folder, so others must
    not be able to make that folder before it does."""
    with (
        temporary_folder() as folder,
        dask.config.set({**_DASK, "temporary-directory": str(folder)}),
    ):
        yield


@contextmanager
def connected(remote: Remote | None, workers: int) -> Iterator[Client]:
    """A client of the scheduler, or of ``workers`` processes of this machine (0: one a core), on
    loopback, which end with this process, however it ends.

    Raises InputError if there is no scheduler, or no worker of it within a minute.
    """
    for name in ("distributed", "distributed.client", "bokeh"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    if remote is None:
        import_module("cryptography")  # which Dask needs, and would name without the extra
        where: dict[str, Any] = {
            "n_workers": workers or _cores(), "threads_per_worker": 1, "host": "127.0.0.1",
            "dashboard_address": _DASHBOARD, "silence_logs": logging.CRITICAL,
            "security": True,  # a new key, in memory
        }  # fmt: skip
    else:
        where = {"address": remote.address, "security": remote.security, "timeout": 10}
    with _configured(), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Port 8787 is already in use")  # another one serves
        try:
            client = Client(**where)
        except (OSError, RuntimeError, TypeError, ValueError) as error:
            if remote is None:
                raise CampaignError(f"the workers could not be started: {error}") from None
            remedy = "start one by 'bayesrace campaign-scheduler' with the same key"
            raise InputError(f"no scheduler at {remote.address}: {error}; {remedy}") from None
        with client:
            try:
                client.wait_for_workers(1, timeout=60)
            except TimeoutError:
                if remote is None:
                    raise CampaignError("no worker has started within a minute") from None
                remedy = f"start some by 'bayesrace campaign-worker {remote.address}'"
                raise InputError(
                    f"the scheduler at {remote.address} has no worker; {remedy}"
                ) from None
            yield client


def run_scheduler(address: str, key: Path) -> None:
    """Serves campaigns and workers that have the key until SIGINT or SIGTERM.

    Makes the file of the key if it is not there. Raises InputError if the address or the key
    cannot be used.
    """
    from distributed.cli.dask_scheduler import main

    if not key.exists():
        import_module("cryptography")  # as above
        made = Security.temporary()
        write_whole(key, made.tls_client_key + made.tls_client_cert, private=True)
    options = Remote.checked(address, key).options
    with _configured():
        try:
            main(
                ["--host", address, "--dashboard-address", _DASHBOARD, *options],
                standalone_mode=False,
            )
        except (OSError, RuntimeError) as error:
            reason = error.__cause__ or error
            raise InputError(f"cannot listen at {address}: {reason}; give another one") from None


def run_worker(scheduler: Remote, workers: int) -> None:
    """Serves a scheduler with this many processes (0: one a core) until it ends."""
    from distributed.cli.dask_worker import main

    options = ["--nworkers", str(workers or _cores()), "--nthreads", "1", "--death-timeout", "60"]
    pages = ["--no-dashboard", "--dashboard-address", "127.0.0.1:0"]
    with _configured():
        main([scheduler.address, *options, *pages, *scheduler.options], standalone_mode=False)


def _cores() -> int:
    return len(os.sched_getaffinity(0))
