"""The link emulator does to frames what it says, before anything is concluded from tests over it.

Bounds are generous where they are about time: nothing arrives early, and the rest is statistics.
"""

import select
import signal
import socket
import subprocess
import sys
import time

import pytest

from tests.network.hosts import CONTROLLER_IP, PLANT_IP, Network, network
from tests.programs import ROOT

pytestmark = pytest.mark.wall_clock

PORT = 5000


def namespaces_of(pid: int) -> list[str]:
    listed = subprocess.run(["ip", "netns", "list"], capture_output=True, text=True, check=True)
    return [name for name in listed.stdout.split() if name.startswith(f"bayesrace-{pid}-")]


class Pair:
    """A datagram socket on either host."""

    def __init__(self, net: Network) -> None:
        self.plant, self.controller = (
            host.socket(socket.SOCK_DGRAM) for host in (net.plant, net.controller)
        )
        self.plant.bind((PLANT_IP, PORT))
        self.controller.bind((CONTROLLER_IP, PORT))

    def __enter__(self) -> "Pair":
        return self

    def __exit__(self, *_: object) -> None:
        self.plant.close()
        self.controller.close()

    def flood(self, count: int) -> tuple[list[int], list[float]]:
        """Numbered datagrams to the controller: those that arrived, and how long each took [s]."""
        sent_s: list[float] = []
        numbers: list[int] = []
        took_s: list[float] = []

        def receive(timeout_s: float) -> bool:
            if not select.select([self.controller], [], [], timeout_s)[0]:
                return False
            number = int(self.controller.recv(100))
            numbers.append(number)
            took_s.append(time.monotonic() - sent_s[number])
            return True

        for number in range(count):
            sent_s.append(time.monotonic())
            self.plant.sendto(b"%d" % number, (CONTROLLER_IP, PORT))
            while receive(0.001):
                pass
        while receive(0.5):
            pass
        return numbers, took_s


def test_a_perfect_link_loses_nothing_and_a_cut_one_lets_nothing_through(net: Network) -> None:
    with Pair(net) as pair:
        assert pair.flood(200)[0] == list(range(200))
        perfect = {"forwarded": 200, "lost": 0, "cut": 0, "overflowed": 0}
        assert net.link.counts()["forth"] == perfect
        net.link.cut("forth")
        assert pair.flood(20)[0] == []
        pair.controller.sendto(b"fro", (PLANT_IP, PORT))
        assert pair.plant.recv(100) == b"fro"
        assert net.link.counts()["forth"]["cut"] == 20
        net.link.join()
        assert pair.flood(20)[0] == list(range(20))


def test_loss_and_delay_are_as_asked_for_and_losses_counted(net: Network) -> None:
    with Pair(net) as pair:
        net.link.set(delay=0.02, jitter=0.005)
        numbers, took_s = pair.flood(300)
        assert numbers == list(range(300))
        assert min(took_s) >= 0.015
        net.link.set(loss=0.2)
        numbers, _ = pair.flood(1000)
    counts = net.link.counts()["forth"]
    assert counts["forwarded"] == 300 + len(numbers)
    assert counts["lost"] == 1000 - len(numbers)
    # six standard deviations of a thousand draws
    assert 124 < counts["lost"] < 276


def test_what_a_killed_process_left_is_removed_by_the_next(namespaces: None) -> None:
    code = (
        "import sys, time; from tests.network.hosts import network\n"
        "with network():\n"
        "    print('up', flush=True); time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, cwd=ROOT) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == b"up\n"
        assert len(namespaces_of(child.pid)) == 3
        child.send_signal(signal.SIGKILL)
    with network():
        assert namespaces_of(child.pid) == []
