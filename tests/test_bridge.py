"""The bridge: a controller without Python is driven, stopped and watched as any other."""

import json
import signal
import socket
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from bayesrace.codegen.build import PROGRAM
from bayesrace.controller.assembly import compiled_controller
from bayesrace.controller.driver import Phase
from bayesrace.controller.native_step import Status
from bayesrace.controller.remote import RemoteDriver, RemoteLink
from bayesrace.controller.settings import MpcSettings
from bayesrace.errors import InputError
from bayesrace.gp.weights import Weights
from bayesrace.log import LogReader, LogWriter
from bayesrace.messages import (
    ACTUATION,
    COMMAND,
    EVENT,
    STATE,
    TELEMETRY,
    TRUTH,
    Actuation,
    Telemetry,
    encode,
    from_datagram,
    to_datagram,
)
from bayesrace.operation.closed_loop import ClosedLoop
from bayesrace.operation.host import HostProgram
from bayesrace.tracks import write_track
from bayesrace.transport import free_endpoint
from bayesrace.vehicles import Car
from tests import sample_messages as messages
from tests.conftest import Circuit
from tests.driven import blank
from tests.programs import finish, run, start, until


@dataclass
class Bridged:
    """A plant, a controller without Python, and the bridge between them."""

    host: "subprocess.Popen[str]"
    bridge: "subprocess.Popen[str]"
    where: tuple[str, ...]
    """Endpoints of plant and bridge, as options."""
    track: Path

    def drive(self, log: Path, *options: str) -> "subprocess.Popen[str]":
        return start("drive", "--track", self.track, *self.where, "--log", log, *options)

    def status(self) -> dict[str, Any]:
        """Of the controller; nothing while it is not there yet."""
        done = run("status", "--json", *self.where)
        cars = json.loads(done.stdout)["cars"] if done.returncode == 0 else {}
        found: dict[str, Any] = cars.get("orca", {}).get("controller") or {"phase": ""}
        return found


@pytest.fixture(params=["udp", "unix"])
def bridged(
    kinematic_artefact: Path, circuit: Circuit, car: Car, weights: Weights, tmp_path: Path,
    request: pytest.FixtureRequest,
) -> Iterator[Bridged]:  # fmt: skip
    made = HostProgram.made(
        tmp_path, kinematic_artefact, car, circuit.track, circuit.line, weights, MpcSettings()
    )
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        udp = f"udp:127.0.0.1:{free.getsockname()[1]}"
    link = udp if request.param == "udp" else f"unix:{tmp_path / 'host'}"
    track = tmp_path / "track.csv"
    write_track(track, circuit.track)
    plant_at, bridge_at = free_endpoint(), free_endpoint()
    words = [str(made.folder / PROGRAM), str(made.folder), link, "--telemetry"]
    host = subprocess.Popen(words, stderr=subprocess.PIPE, text=True)
    assert host.stderr is not None
    plant = start("plant", "--endpoint", plant_at)
    bridge = start("bridge", link, "--track", track, "--endpoint", plant_at, "--listen", bridge_at)
    try:
        assert "ready" in host.stderr.readline()
        yield Bridged(host, bridge, ("--endpoint", plant_at, "--endpoint", bridge_at), track)
    finally:
        for one in (bridge, plant, host):
            one.terminate()
            one.communicate(timeout=60)


@pytest.mark.check
def test_a_drive_in_lockstep_is_that_of_one_process_to_the_bit(
    bridged: Bridged, kinematic_artefact: Path, circuit: Circuit, car: Car, weights: Weights,
    tmp_path: Path,
) -> None:  # fmt: skip
    log = tmp_path / "drive.mcap"
    done = finish(bridged.drive(log, "--laps", "1"))
    assert "1 lap(s) done" in done.stdout, done.stderr
    controller = compiled_controller(kinematic_artefact, car, circuit.track, circuit.line, weights)
    alone = LogWriter(tmp_path / "alone.mcap")
    ClosedLoop(car, circuit.track, circuit.line, controller, log=alone).drive(1)
    alone.close()
    driven, expected = LogReader(log), LogReader(tmp_path / "alone.mcap")
    assert [one.x for one in driven.select(TRUTH)] == [one.x for one in expected.select(TRUTH)]
    sent = driven.select(ACTUATION)
    assert [one.seq for one in sent] == list(range(len(sent)))
    assert {one.weights_version for one in sent} == {weights.version}
    assert len(driven.select(TELEMETRY)) == len(sent) > 100


@pytest.mark.check
@pytest.mark.wall_clock
def test_in_real_time_it_is_stopped_goes_on_and_its_end_is_seen(
    bridged: Bridged, weights: Weights, tmp_path: Path
) -> None:
    log = tmp_path / "drive.mcap"
    drive = bridged.drive(log, "--mode", "realtime", "--laps", "10000", "--max-time", "3600")
    until(lambda: bridged.status()["phase"] == "driving", "driving", every_s=0.2)
    assert run("stop", *bridged.where).returncode == 0
    until(lambda: bridged.status()["phase"] == "stopped", "a stop", every_s=0.2)
    assert run("go", *bridged.where).returncode == 0
    until(lambda: bridged.status()["phase"] == "driving", "driving on", every_s=0.2)
    said = bridged.status()
    assert said["weights_version"] == weights.version
    assert said["counters"]["actuations_sent"] > 50
    bridged.host.send_signal(signal.SIGKILL)
    done = finish(drive)
    assert done.returncode == 2
    events = {one.kind: one.data for one in LogReader(log).select(EVENT)}
    assert events["run_ended"]["reason"] in ("controller_lost", "stopped")
    assert "controller" in done.stderr
    assert {"stop", "go"} <= set(events)
    said_last = finish(bridged.bridge)
    assert said_last.returncode == 75
    assert "does not answer" in said_last.stderr


class Sink(RemoteLink):
    """A link that keeps what is sent."""

    def __init__(self) -> None:
        super().__init__("udp:127.0.0.1:9")
        self.sent: list[bytes] = []

    def send(self, data: bytes) -> None:
        self.sent.append(data)


def answered(**changes: Any) -> bytes:
    values = {"epoch": 1, "run": 1, "u": (0.0, 0.0)}
    return to_datagram(ACTUATION, blank(Actuation, **(values | changes)))


def phase_of(driver: RemoteDriver) -> Phase:
    """Read anew: mypy takes it for a constant."""
    return driver.phase


def test_what_the_controller_does_is_known_by_its_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns = [10**10]
    monkeypatch.setattr("bayesrace.clock.monotonic_ns", lambda: now_ns[0])
    link = Sink()
    driver, state = RemoteDriver(link, "track"), messages.state(seq=3)
    assert phase_of(driver) is Phase.WAITING
    driver.take(state)
    driver.forward(encode(state))
    assert from_datagram(link.sent.pop()) == (STATE, state)
    now_ns[0] += 3 * 10**8
    driver.take(state)
    now_ns[0] += 10**8
    assert driver.unanswered_s == 0.4
    driver.note(answered(weights_version="one"))
    report = blank(Telemetry, seq=8, sensor_fault="frozen", missed=True)
    driver.note(to_datagram(TELEMETRY, report))
    assert (phase_of(driver), driver.ticks, driver.fault) == (Phase.DRIVING, 9, "frozen")
    assert (driver.controller.weights_version, driver.faults["frozen"]) == ("one", 1)
    assert (driver.levels, driver.misses, driver.unanswered_s) == ([1, 0, 0, 0], 1, 0)
    estimated = replace(report, estimate=(1.0,) * 9, deviation=(0.5,) * 9, fallback=2)
    driver.note(to_datagram(TELEMETRY, estimated))
    assert driver.belief is not None
    assert driver.belief.covariance[2, 2] == 0.25
    assert phase_of(driver) is Phase.FALLBACK
    driver.stop()
    driver.repeat()  # too soon
    now_ns[0] += 2 * 10**8
    driver.repeat()
    assert [from_datagram(one)[0] for one in link.sent] == [COMMAND, COMMAND]
    driver.note(answered(status=Status.HALTED))
    now_ns[0] += 2 * 10**8
    driver.repeat()  # it has had its effect
    assert len(link.sent) == 2
    assert phase_of(driver) is Phase.STOPPED
    with pytest.raises(InputError):
        driver.note(b"\x92\xa5state" + b"\x91" * 5000)
    link.close()


def test_between_runs_it_waits_whatever_the_last_answer_was(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Else the end of a held run would be taken for a missing director."""
    now_ns = [10**10]
    monkeypatch.setattr("bayesrace.clock.monotonic_ns", lambda: now_ns[0])
    driver = RemoteDriver(Sink(), "track")
    driver.take(messages.state())
    driver.note(answered())
    assert phase_of(driver) is Phase.DRIVING
    driver.take(messages.state(seq=1))
    driver.take(messages.state(seq=2, final=True))
    now_ns[0] += 9 * 10**8
    assert (phase_of(driver), driver.unanswered_s) == (Phase.WAITING, 0)
    driver.take(messages.state(seq=3, run=2))
    assert phase_of(driver) is Phase.WAITING  # no answer yet
    driver.note(answered(run=2))
    assert phase_of(driver) is Phase.DRIVING
    now_ns[0] += 11 * 10**8
    assert phase_of(driver) is Phase.WAITING  # no states any more


def test_a_link_never_waits_to_send_and_hears_the_controller_alone(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as held_up:
        held_up.bind(str(tmp_path / "host"))
        link = RemoteLink(f"unix:{tmp_path / 'host'}", str(tmp_path / "own"))
        for _ in range(5000):
            link.send(bytes(1000))
        assert link.unsent > 0
        held_up.sendto(b"answer", str(tmp_path / "own"))
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as stranger:
            stranger.bind(str(tmp_path / "stranger"))
            stranger.sendto(b"lie", str(tmp_path / "own"))
        assert [link.receive(0.1) for _ in range(3)] == [b"answer", None, None]
        link.close()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as host:
        host.bind(("127.0.0.1", 0))
        link = RemoteLink(f"udp:127.0.0.1:{host.getsockname()[1]}")
        link.send(b"state")
        _, bridge = host.recvfrom(100)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.sendto(b"lie", bridge)
        host.sendto(b"answer", bridge)
        assert [link.receive(0.1) for _ in range(2)] == [b"answer", None]
    for _ in range(3):  # nobody is there any more
        link.send(b"state")
        assert link.receive(0.1) is None
    assert link.unsent > 0
    link.close()


@pytest.mark.check
@pytest.mark.wall_clock
def test_without_a_controller_the_bridge_ends_and_the_run_with_it(
    circuit: Circuit, tmp_path: Path
) -> None:
    track = tmp_path / "track.csv"
    write_track(track, circuit.track)
    plant_at, bridge_at = free_endpoint(), free_endpoint()
    where = ("--endpoint", plant_at, "--endpoint", bridge_at)
    plant = start("plant", "--endpoint", plant_at)
    bridge = start("bridge", "udp:127.0.0.1:9", "--track", track, "--endpoint", plant_at,
                   "--listen", bridge_at)  # fmt: skip
    try:
        log = tmp_path / "drive.mcap"
        drive = start("drive", "--track", track, *where, "--log", log, "--mode", "realtime")
        assert finish(drive).returncode == 2
        done = finish(bridge)
        assert done.returncode == 75
        assert "udp:127.0.0.1:9 does not answer: start it first" in done.stderr
    finally:
        for one in (plant, bridge):
            one.terminate()
            finish(one)


@pytest.mark.parametrize(
    "name",
    [
        *("", "udp:", "udp:7450", "udp:here:port", "udp:127.0.0.1:99999", "tcp:127.0.0.1:1", "x"),
        "unix:" + 108 * "x",
    ],
)
def test_a_link_that_is_none_is_named(name: str) -> None:
    with pytest.raises(InputError, match="is no link: use udp:ADDRESS:PORT"):
        RemoteLink(name)
