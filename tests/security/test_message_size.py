"""How much of a process's memory the other end of a link can fill with messages.

Zenoh puts a message together before access control looks at it: hence also one that the sender may
not send, or of a sender who may send nothing.
"""

from contextlib import ExitStack
from pathlib import Path
from typing import Final

import pytest
import zenoh

from bayesrace.defaults import MAX_WEIGHTS_BYTES
from bayesrace.messages import ACTUATION, car_key
from bayesrace.transport import free_endpoint
from tests.network.cars import Program
from tests.programs import run, until
from tests.security.authority import CAR, Bundles, bundles, written
from tests.security.fragments import CHANNELS, FRAGMENT_BYTES, RawLink
from tests.security.intruder import bare_session

__all__ = ["bundles"]

pytestmark = pytest.mark.wall_clock

MESSAGE_BYTES: Final = 200_000_000
MOST_MB: Final = 60.0
LINKS: Final = 4
LARGEST_MB: Final = (MAX_WEIGHTS_BYTES + 4096) / 2**20
"""What is put together of one message at most."""


def peak_mb(program: Program) -> float:
    """Largest resident memory of the process so far."""
    status = Path(f"/proc/{program.process.pid}/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


@pytest.mark.parametrize("name", ["", "viewer", "revoked"])
def test_a_message_that_is_too_large_fills_no_memory(
    tmp_path: Path, bundles: Bundles, name: str
) -> None:
    """With that certificate, or none; the plant goes on."""
    where = free_endpoint("tls" if name else "tcp")
    config = written(tmp_path, bundles, where, free_endpoint("tls"))
    options = ("--config", config) if name else ("--endpoint", where)
    with Program(tmp_path / "plant.txt", "plant", *options) as plant:
        until(lambda: "plant of car" in plant.said(), "the plant")
        # A client sends what nobody has asked for.
        folder = bundles.path(name) if name else None
        with bare_session(where, folder, mode="client") as session:
            until(session.info.links, "a link")
            before_mb = peak_mb(plant)
            # It returns when all but what is in buffers has been received.
            block = zenoh.CongestionControl.BLOCK
            session.put(car_key(ACTUATION.key, CAR), bytes(MESSAGE_BYTES), congestion_control=block)
        done = run("status", "--json", *options)
        assert done.returncode == 0, done.stderr
        assert peak_mb(plant) - before_mb < MOST_MB
        plant.end()


def test_unfinished_messages_fill_what_a_link_may_hold(tmp_path: Path, bundles: Bundles) -> None:
    """A message for each priority, reliable and not, on each of several links; then they go on."""
    where = free_endpoint("tls")
    options = ("--config", written(tmp_path, bundles, where, free_endpoint("tls")))
    fit = MAX_WEIGHTS_BYTES // FRAGMENT_BYTES
    with Program(tmp_path / "plant.txt", "plant", *options) as plant, ExitStack() as stack:
        until(lambda: "plant of car" in plant.said(), "the plant")
        Path(f"/proc/{plant.process.pid}/clear_refs").write_text("5")  # the peak is as of now
        before_mb = peak_mb(plant)
        links = [stack.enter_context(RawLink(where, bundles.path("viewer"))) for _ in range(LINKS)]
        assert all(link.begin(*channel, fit) for link in links for channel in CHANNELS)
        most_mb = LINKS * len(CHANNELS) * LARGEST_MB
        until(lambda: peak_mb(plant) - before_mb > 0.8 * most_mb, "all fragments")
        for link in links:
            for channel in CHANNELS:
                link.begin(*channel, fit, first=fit)
        done = run("status", "--json", *options)
        assert done.returncode == 0, done.stderr
        assert peak_mb(plant) - before_mb < 1.2 * most_mb
        plant.end()
