"""Two hosts and a bad link between them: network namespaces, and the emulator in a third one.

    plant 10.77.0.1 ── left [emulator] right ── 10.77.0.2 controller

Names carry the number of the process that made them; what a killed one left behind is removed by
the next. Nothing of it is visible outside of the namespaces.
"""

import contextlib
import ctypes
import fcntl
import json
import os
import re
import shutil
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any, Final, TypeVar

from tests.network.emulator import Conditions

__all__ = ["CONTROLLER_IP", "PLANT_IP", "Host", "Link", "Network", "network", "why_not_here"]

T = TypeVar("T")

PLANT_IP: Final = "10.77.0.1"
CONTROLLER_IP: Final = "10.77.0.2"

_EMULATOR: Final = Path(__file__).with_name("emulator.py")
_NAME: Final = re.compile(r"bayesrace-(\d+)-\d+-\w+")
_NEW_NETWORK: Final = 0x40000000  # CLONE_NEWNET
_ETHTOOL: Final = 0x8946  # SIOCETHTOOL
# Transmit checksums, receive checksums, and the ways to handle several packets as one. With these
# on, a frame between two ends of a veth pair carries no checksum, as nothing can happen to it.
_OFFLOADS: Final = {"tx": 0x17, "rx": 0x15, "sg": 0x19, "tso": 0x1F, "gso": 0x24, "gro": 0x2C}

_numbers = count()


def _ip(*words: str) -> str:
    done = subprocess.run(["ip", *words], capture_output=True, text=True, check=False)
    if done.returncode:
        raise OSError(f"ip {' '.join(words)}: {done.stderr.strip()}")
    return done.stdout


def why_not_here() -> str:
    """Why this machine cannot have namespaces of ours; "" if it can."""
    if not sys.platform.startswith("linux"):
        return "network namespaces are Linux's"
    if os.geteuid() != 0:
        return "network namespaces need root"
    if shutil.which("ip") is None:
        return "network namespaces need the command 'ip' (iproute2)"
    name = f"bayesrace-{os.getpid()}-{next(_numbers)}-probe"
    try:
        _ip("netns", "add", name)
        _ip("-n", name, "link", "add", "left", "type", "veth", "peer", "name", "right")
    except OSError as error:
        return f"network namespaces are refused here: {error}"
    finally:
        with contextlib.suppress(OSError):
            _ip("netns", "del", name)
    return ""


class Host:
    """A network namespace."""

    def __init__(self, name: str) -> None:
        self.name = name

    def command(self, *words: str | Path) -> list[str]:
        """The command line that runs a program there, as a direct child of its starter."""
        return ["ip", "netns", "exec", self.name, *map(str, words)]

    def do(self, function: Callable[[], T]) -> T:
        """Calls the function there, in a thread of its own; a socket made there stays there."""
        outcome: list[Any] = []

        def enter() -> None:
            try:
                with Path("/run/netns", self.name).open() as file:
                    libc = ctypes.CDLL(None, use_errno=True)
                    if libc.setns(file.fileno(), _NEW_NETWORK):
                        raise OSError(ctypes.get_errno(), f"setns into {self.name}")
                outcome[:] = [function(), None]
            except BaseException as error:
                outcome[:] = [None, error]

        thread = threading.Thread(target=enter)
        thread.start()
        thread.join()
        result, error = outcome
        if error is not None:
            raise error
        return result  # type: ignore[no-any-return]

    def socket(self, kind: int) -> socket.socket:
        """An IPv4 socket of this host."""
        return self.do(lambda: socket.socket(socket.AF_INET, kind))

    def interface(self, name: str, address: str = "") -> None:
        """Brings an interface up, without offloading and without IPv6's own chatter."""
        self.do(lambda: _stop_offloading(name))
        _ip("-n", self.name, "link", "set", name, "addrgenmode", "none")
        if address:
            _ip("-n", self.name, "address", "add", f"{address}/24", "dev", name)
            _ip("-n", self.name, "link", "set", "lo", "up")
        _ip("-n", self.name, "link", "set", name, "up")

    def knows(self, neighbour: "Host", address: str) -> None:
        """A fixed neighbour: looking up addresses is not what gets lost in the tests."""
        mac = json.loads(_ip("-n", neighbour.name, "-json", "link", "show", "eth0"))[0]["address"]
        where = ("lladdr", mac, "dev", "eth0", "nud", "permanent")
        _ip("-n", self.name, "neighbour", "replace", address, *where)


def _plain_congestion_control() -> None:
    """The one that every kernel has and allows: with losses it makes a difference which it is."""
    Path("/proc/sys/net/ipv4/tcp_congestion_control").write_text("reno")


def _stop_offloading(interface: str) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        for command in _OFFLOADS.values():
            value = ctypes.create_string_buffer(struct.pack("II", command, 0))
            request = struct.pack("16sP", interface.encode(), ctypes.addressof(value))
            with contextlib.suppress(OSError):  # a veth has not all of them
                fcntl.ioctl(sock.fileno(), _ETHTOOL, request)


class Link:
    """The emulator at work; ``forth`` is from the plant to the controller."""

    def __init__(self, host: Host, seed: int) -> None:
        self._process = subprocess.Popen(
            host.command(sys.executable, _EMULATOR, "left", "right", str(seed)),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
            start_new_session=True,  # Ctrl-C is for the tests, which end it in order
        )
        self._conditions = {name: Conditions() for name in ("forth", "back")}
        self._answer()

    def set(self, delay: float = 0.0, jitter: float = 0.0, loss: float = 0.0) -> None:
        """Conditions of both directions; a partition is over with it."""
        self._change("", delay=delay, jitter=jitter, loss=loss, cut=False)

    def cut(self, direction: str = "") -> None:
        """Nothing gets through any more."""
        self._change(direction, cut=True)

    def join(self, direction: str = "") -> None:
        """The end of a partition."""
        self._change(direction, cut=False)

    def counts(self) -> dict[str, dict[str, int]]:
        """Frames by direction, see :class:`tests.network.emulator.Counts`."""
        return self._send({})

    def _change(self, direction: str, **given: Any) -> None:
        for name in [direction] if direction else self._conditions:
            self._conditions[name] = replace(self._conditions[name], **given)
        self._send({name: asdict(one) for name, one in self._conditions.items()})

    def _send(self, conditions: dict[str, dict[str, Any]]) -> dict[str, dict[str, int]]:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{json.dumps(conditions)}\n")
        return self._answer()

    def _answer(self) -> dict[str, dict[str, int]]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise OSError(f"the emulator ended with code {self._process.wait()}")
        answer: dict[str, dict[str, int]] = json.loads(line)
        return answer

    def close(self) -> None:
        """Ends the program."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()


@dataclass(frozen=True)
class Network:
    """Two hosts and what is between them."""

    plant: Host
    controller: Host
    link: Link


def _remove_stale() -> None:
    for name in _ip("netns", "list").split():
        match = _NAME.fullmatch(name)
        if match and not Path("/proc", match[1]).exists():
            with contextlib.suppress(OSError):  # another one may be at it
                _ip("netns", "del", name)


@contextlib.contextmanager
def network(seed: int = 0) -> Iterator[Network]:
    """A network that is gone after the block, with a perfect link until it is changed."""
    _remove_stale()
    prefix = f"bayesrace-{os.getpid()}-{next(_numbers)}"
    hosts = {role: Host(f"{prefix}-{role}") for role in ("plant", "controller", "between")}
    with contextlib.ExitStack() as cleanup:
        for host in hosts.values():
            _ip("netns", "add", host.name)
            cleanup.callback(_ip, "netns", "del", host.name)
        plant, controller, between = hosts.values()
        for host, end in ((plant, "left"), (controller, "right")):
            veth = ("link", "add", "eth0", "type", "veth", "peer", "name", end)
            _ip("-n", host.name, *veth, "netns", between.name)
            between.interface(end)
        plant.interface("eth0", PLANT_IP)
        controller.interface("eth0", CONTROLLER_IP)
        for host in (plant, controller):
            host.do(_plain_congestion_control)
        plant.knows(controller, CONTROLLER_IP)
        controller.knows(plant, PLANT_IP)
        link = Link(between, seed)
        cleanup.callback(link.close)
        yield Network(plant, controller, link)
