"""Connections that never finish their handshake, from hosts of the network: nobody needs a
certificate for them, and without help they keep everybody's new links out.

Two network namespaces stand for the board, where plant and controller listen, and for all others.
"""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Final

import pytest

from bayesrace.configuration import NetworkSettings
from bayesrace.operation.certificates import add, init
from bayesrace.operation.firewall import rules
from tests.network.cars import Course, Program
from tests.network.observer import Journey
from tests.programs import COMMAND, ROOT, environment, until
from tests.security.authority import CAR, Bundles, written
from tests.security.rig import attacking, course

__all__ = ["course"]

pytestmark = [
    pytest.mark.check,
    pytest.mark.wall_clock,
    pytest.mark.skipif(os.geteuid() != 0, reason="needs root: network namespaces, rules"),
    pytest.mark.skipif(shutil.which("ip") is None, reason="needs ip, see .ci/tools"),
]

BOARD: Final = "10.77.0.1"
DIRECTOR: Final = "10.77.0.2"
ATTACKERS: Final = tuple(f"10.77.0.{number}" for number in range(11, 16))
PLANT, CONTROLLER = f"tls/{BOARD}:7447", f"tls/{BOARD}:7448"
INSIDE: Final = ("tls/127.0.0.1:17447", "tls/127.0.0.1:17448")
"""Where they listen behind a proxy."""
LINK_S: Final = 2.0
"""So long a new link may take on a machine with other work; alone, it takes at most 1 s."""
APART_S: Final = 2.5
"""Rules and proxy let more than one link in two seconds wait."""


def needs(tool: str) -> None:
    if shutil.which(tool) is None:
        pytest.skip(f"needs {tool}, see .ci/tools")


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)


class Hosts:
    """The namespaces, joined by a cable; commands are run in one of them by a prefix."""

    def __init__(self) -> None:
        board, others = (f"bayesrace-{os.getpid()}-{name}" for name in ("board", "others"))
        self.names = board, others
        self.board, self.others = (("ip", "netns", "exec", one) for one in self.names)

    def join(self) -> None:
        board, others = self.names
        for name in self.names:
            ip("netns", "add", name)
            ip("-n", name, "link", "set", "dev", "lo", "up")
        veth = ("type", "veth", "peer", "name", "b", "netns", others)
        ip("-n", board, "link", "add", "name", "a", *veth)
        for name, end, addresses in (
            (board, "a", (BOARD, "fd77::1")),
            (others, "b", (DIRECTOR, *ATTACKERS, "fd77::2", "fd77::11")),
        ):
            for one in addresses:
                wide = [f"{one}/64", "nodad"] if ":" in one else [f"{one}/24"]
                ip("-n", name, "address", "add", *wide, "dev", end)
            ip("-n", name, "link", "set", "dev", end, "up")

    def load(self, *hosts: str) -> None:
        """The rules of plant and controller, with these other hosts let in."""
        for role, port in (("plant", 7447), ("controller", 7448)):
            network = NetworkSettings(plant=(PLANT,), hosts=hosts)
            text = rules(network, "plant", (f"tls/{BOARD}:{port}",))
            text = text.replace("bayesrace_plant", f"bayesrace_{role}")
            command = [*self.board, "nft", "-f", "-"]
            loaded = subprocess.run(command, input=text, capture_output=True, text=True)
            assert loaded.returncode == 0, loaded.stderr


@pytest.fixture
def hosts() -> Iterator[Hosts]:
    if subprocess.run(["unshare", "--net", "true"], capture_output=True).returncode != 0:
        pytest.skip("needs network namespaces")
    made = Hosts()
    try:
        made.join()
        yield made
    finally:
        for name in made.names:
            subprocess.run(["ip", "netns", "delete", name], capture_output=True)


@pytest.fixture
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """With certificates for the board; of all processes that the test starts."""
    folder = tmp_path / "certs"
    init(folder)
    for role in ("plant", "controller", "director"):
        add(folder, role, role, CAR, [BOARD])
    path = written(tmp_path, Bundles(folder), PLANT, CONTROLLER)
    monkeypatch.setenv("BAYESRACE_CONFIG", str(path))
    return path


@contextmanager
def flooding(hosts: Hosts, rate: int, words: str, sources: Sequence[str]) -> Iterator[list[int]]:
    """For the block, half-open connections at that rate to the plant and to the controller; at its
    end, how many were begun and accepted at the plant."""
    with ExitStack() as stack:
        said = [
            stack.enter_context(
                attacking(
                    "half_open", "opening", BOARD, port, rate, words, *sources, prefix=hosts.others
                )
            )
            for port in (7447, 7448)
        ]
        counts: list[int] = []
        yield counts
    counts += map(int, said[0])
    assert counts[0] > 10


@contextmanager
def newcomer(hosts: Hosts, endpoint: str) -> Iterator["subprocess.Popen[str]"]:
    """A director that links anew when asked to, see :func:`linked_s`."""
    command = [*hosts.others, sys.executable, "-m", "tests.security.newcomer", endpoint]
    pipe = subprocess.PIPE
    process = subprocess.Popen(command, cwd=ROOT, stdin=pipe, stdout=pipe, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        yield process
    finally:
        process.communicate()


def linked_s(process: "subprocess.Popen[str]") -> float:
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write("\n")
    process.stdin.flush()
    return float(process.stdout.readline())


def called(hosts: Hosts, *words: str) -> subprocess.CompletedProcess[str]:
    """A command of ``bayesrace`` on another host than the board."""
    command = [*hosts.others, *COMMAND, *words]
    return subprocess.run(command, cwd=ROOT, env=environment(), capture_output=True, text=True)


def test_without_rules_22_a_second_keep_a_director_out(
    hosts: Hosts, config: Path, tmp_path: Path
) -> None:
    """Otherwise the tests below would show nothing."""
    with (
        Program(tmp_path / "plant.txt", "plant", prefix=hosts.board),
        newcomer(hosts, PLANT) as director,
    ):
        assert linked_s(director) < LINK_S
        with flooding(hosts, 22, "silence", ATTACKERS[:1]):
            time.sleep(5.0)
            assert linked_s(director) > LINK_S


@pytest.mark.parametrize("sources", [1, 5])
@pytest.mark.parametrize("words", ["silence", "greeting"])
@pytest.mark.parametrize("guard", ["nft", "haproxy"])
def test_a_director_links_and_stops_the_car(
    hosts: Hosts, config: Path, tmp_path: Path, course: Course, guard: str, words: str,
    sources: int,
) -> None:  # fmt: skip
    """Though all attackers are hosts that are let in; and links that stand are not touched."""
    needs(guard)
    log = tmp_path / "run.mcap"
    drives = ("drive", "--track", course.track_file, "--mode", "realtime", "--log", log)
    with ExitStack() as stack:

        def start(name: str, where: Sequence[str], *words: str | Path) -> Program:
            program = Program(tmp_path / f"{name}.txt", name, *words, prefix=where)
            return stack.enter_context(program)

        given: tuple[tuple[str, ...], ...] = ((), ())
        if guard == "nft":
            hosts.load("10.77.0.0/24")
        else:
            stack.enter_context(passing_through(hosts))
            plant_at, controller_at = INSIDE
            given = (
                ("--endpoint", plant_at),
                ("--endpoint", plant_at, "--listen", controller_at),
            )
        start("plant", hosts.board, *given[0])
        start("controller", hosts.board, *course.arguments, *given[1])
        director = stack.enter_context(newcomer(hosts, PLANT))
        driving = start("drive", hosts.others, *drives[1:], "--laps", "999", "--max-time", "300")
        until(lambda: '"driving"' in called(hosts, "status", "--json").stdout, "driving", every_s=3)
        took_s = []
        for rate in (22, 1200):
            with flooding(hosts, rate, words, ATTACKERS[:sources]):
                for _ in range(3):
                    time.sleep(APART_S)
                    took_s.append(linked_s(director))
                time.sleep(APART_S)
                word = "stop" if rate == 22 else "go"
                commanded = called(hosts, word)
                assert commanded.returncode == 0, commanded.stderr
        assert max(took_s) < LINK_S, took_s
        ended = called(hosts, "stop", "--run")
        assert ended.returncode == 0, ended.stderr
        driving.process.wait()
    journey = Journey(log, course.track)
    assert journey.off_track_m() <= 0
    missing = journey.states[-1].seq - journey.states[0].seq + 1 - len(journey.states)
    assert missing <= 0.01 * len(journey.states)


@contextmanager
def passing_through(hosts: Hosts) -> Iterator[None]:
    """HAProxy with the configuration of the containers, before what listens on loopback."""
    plant, controller = (one.removeprefix("tls/") for one in INSIDE)
    process = subprocess.Popen(
        [*hosts.board, "haproxy", "-db", "-f", ROOT / "docker" / "haproxy.cfg"],
        env={**os.environ, "PLANT": plant, "CONTROLLER": controller},
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        yield
    finally:
        process.terminate()
        process.wait()


ANSWERER: Final = """
import socket
with socket.create_server(("127.0.0.1", 17447)) as listener:
    while True:
        listener.accept()[0].sendall(b"x")
"""
REACHING: Final = """
import socket, sys
from contextlib import suppress
from tests.security.half_open import client_hello
reached, (host, *sources) = 0, sys.argv[1:]
for source in sources:
    with suppress(OSError), socket.create_connection((host, 7447), 5.0, (source, 0)) as one:
        one.sendall(client_hello())
        reached += one.recv(1) == b"x"
print(reached)
"""


def test_the_proxy_counts_each_host_of_ipv4_and_each_64_of_ipv6(hosts: Hosts) -> None:
    """A host may take any address of its /64."""
    needs("haproxy")

    def reached(host: str, *sources: str) -> int:
        command = [*hosts.others, sys.executable, "-c", REACHING, host, *sources]
        return int(subprocess.run(command, cwd=ROOT, capture_output=True, check=True).stdout)

    answerer = subprocess.Popen([*hosts.board, sys.executable, "-c", ANSWERER])
    try:
        with passing_through(hosts):
            until(lambda: reached(BOARD, ATTACKERS[4]), "the proxy")
            assert reached(BOARD, *ATTACKERS[:3] * 4) == 6
            assert reached("fd77::1", *("fd77::2", "fd77::11") * 4) == 2
    finally:
        answerer.kill()
        answerer.wait()


LISTENER: Final = """
import socket
with socket.create_server(("", 7447), family=socket.AF_INET6, backlog=4096, dualstack_ipv6=True):
    print("ready", flush=True)
    input()
"""


def test_the_rules_let_in_who_is_named_and_each_user_of_the_board(hosts: Hosts) -> None:
    """By IPv4 and IPv6; each at a rate, which they are not asked for after that."""
    needs("nft")
    pipe, most = subprocess.PIPE, 20
    command = [*hosts.board, sys.executable, "-c", LISTENER]
    listener = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True)
    assert listener.stdout is not None
    assert listener.stdout.readline() == "ready\n"

    def accepted(where: Sequence[str], host: str, source: str) -> int:
        words = (host, 7447, 100, "silence", source)
        with attacking("half_open", "opening", *words, prefix=where) as said:
            time.sleep(2.0)
        return int(said[1])

    try:
        assert accepted(hosts.others, BOARD, ATTACKERS[0]) > most
        hosts.load(DIRECTOR, "fd77::2")
        hosts.load(DIRECTOR, "fd77::2")  # again, in place of the former
        assert accepted(hosts.others, BOARD, ATTACKERS[0]) == 0
        assert accepted(hosts.others, "fd77::1", "fd77::11") == 0
        assert 2 <= accepted(hosts.others, BOARD, DIRECTOR) < most
        assert 2 <= accepted(hosts.others, "fd77::1", "fd77::2") < most
        assert 2 <= accepted(hosts.board, "127.0.0.1", "127.0.0.1") < most
        other = [*hosts.board, "setpriv", "--reuid=65534", "--clear-groups"]
        connects = [*other, "bash", "-c", "exec 3<> /dev/tcp/127.0.0.1/7447"]
        assert subprocess.run(connects, capture_output=True).returncode == 0
        ip("netns", "exec", hosts.names[0], "nft", "delete", "table", "inet", "bayesrace_plant")
        assert accepted(hosts.others, BOARD, ATTACKERS[0]) > most
    finally:
        listener.communicate("\n")
