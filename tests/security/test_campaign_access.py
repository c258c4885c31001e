"""Who has no key runs no code on the scheduler and the workers of a campaign, which Dask would run
for any client; on one machine, and on several."""

import asyncio
import os
import pickle
import ssl
import tempfile
from collections.abc import Mapping
from http.client import HTTPConnection
from importlib import import_module
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from tests.programs import campaign_scheduler, finish, start

pytestmark = pytest.mark.check


def everywhere(client: Any) -> dict[str, str]:
    """Address of each process that listens, and the operation by which it runs a function."""
    client.wait_for_workers(1, timeout=60)
    found = {client.scheduler.address: "run_function"}
    for address, about in client.scheduler_info()["workers"].items():
        found |= {address: "run", about["nanny"]: "run"}
    assert len(found) == 3
    return found


def call(address: str, operation: str, security: Any, marker: Path) -> None:
    """Has the process make the marker; a CommClosedError if it gives no connection."""
    from distributed.core import rpc

    async def send() -> None:
        connection = security.get_connection_args("client")
        async with rpc(address, timeout=5, connection_args=connection) as process:
            await getattr(process, operation)(function=pickle.dumps(marker.touch))

    asyncio.run(asyncio.wait_for(send(), 30))


def check_access(processes: Mapping[str, str], security: Any, marker: Path) -> None:
    """The same call does nothing without TLS and with a certificate made for it, whose owner does
    not look at that of the other end; it makes the marker with the key."""
    from distributed import Security
    from distributed.comm import CommClosedError

    own = Security.temporary()
    connection: dict[str, Any] = own.get_connection_args("client")
    connection["ssl_context"].verify_mode = ssl.CERT_NONE

    class Intruder:
        def get_connection_args(self, _role: str) -> dict[str, Any]:
            return connection

    for address, operation in processes.items():
        plain = address.replace("tls://", "tcp://")
        without = Security(require_encryption=False)
        for where, who in ((plain, without), (address, own), (address, Intruder())):
            with pytest.raises(CommClosedError):
                call(where, operation, who, marker)
            assert not marker.exists()
        call(address, operation, security, marker)
        marker.unlink()


def descendants() -> list[Path]:
    """In /proc, this process and what it has started."""
    parents = {}
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            stat = (entry / "stat").read_text()
        except OSError:  # it has ended
            continue
        parents[int(entry.name)] = int(stat.rpartition(")")[2].split()[1])
    own = {os.getpid()}
    while more := {pid for pid, parent in parents.items() if parent in own} - own:
        own |= more
    return [Path("/proc") / str(pid) for pid in own]


@pytest.fixture
def shared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder for temporary files, of which another user has made Dask's own before."""
    folder = tmp_path / "shared"
    planted = folder / "dask-scratch-space"
    planted.mkdir(parents=True)
    planted.chmod(0o777)
    (planted / "planted.py").write_text("")
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return folder


def test_on_one_machine_only_the_campaign_reaches_its_workers(tmp_path: Path, shared: Path) -> None:
    from bayesrace.studies.campaign.cluster import connected

    with connected(None, 1) as client:
        check_access(everywhere(client), client.security, tmp_path / "marker")
        # The key is in nothing that others can read.
        for process in descendants():
            shown = (process / "cmdline").read_bytes() + (process / "environ").read_bytes()
            assert b"PRIVATE KEY" not in shown
        for file in filter(Path.is_file, shared.rglob("*")):
            assert b"PRIVATE KEY" not in file.read_bytes()
        # Modules that others have put where Dask has its files are not imported.
        for run in (client.run_on_scheduler, client.run):
            with pytest.raises(ModuleNotFoundError):
                run(import_module, "planted")


def test_pages_of_a_campaign_only_show(shared: Path) -> None:
    from bayesrace.studies.campaign.cluster import connected

    with connected(None, 1) as client:
        page = urlsplit(client.dashboard_link)

        def status(method: str, path: str, **headers: str) -> int:
            connection = HTTPConnection("127.0.0.1", page.port or 0, timeout=30)
            connection.request(method, path, headers=headers)
            try:
                return connection.getresponse().status
            finally:
                connection.close()

        assert status("GET", "/status") == status("GET", "/info/main/workers.html") == 200
        for method, path in (
            ("GET", "/proxy/1/127.0.0.1/"), ("POST", "/api/v1/retire_workers"), ("GET", "/metrics"),
        ):  # fmt: skip
            assert status(method, path) in (404, 405)
        upgrade = {
            "Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13",
            "Sec-WebSocket-Key": "MDEyMzQ1Njc4OTAxMjM0NQ==",
        }  # fmt: skip
        assert status("GET", "/status/ws", Origin="http://elsewhere:8787", **upgrade) == 403
        assert status("GET", "/status/ws", Origin=f"http://{page.netloc}", **upgrade) == 101


def test_on_several_machines_only_the_key_opens_scheduler_and_workers(tmp_path: Path) -> None:
    from distributed import Client

    from bayesrace.studies.campaign.cluster import Remote

    with campaign_scheduler(tmp_path) as (address, key):
        worker = start("campaign-worker", address, "--key", key, "--workers", "1")
        security = Remote.checked(address, key).security
        with Client(address, security=security, timeout=10) as client:
            check_access(everywhere(client), security, tmp_path / "marker")
    assert finish(worker).returncode == 0
