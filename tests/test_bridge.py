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
    assert "ready" in host.stderr.readline()
    plant = start("plant", "--endpoint", plant_at)
    bridge = start("bridge", link, "--track", track, "--endpoint", plant_at, "--listen", bridge_at)
    yield Bridged(host, bridge, ("--endpoint", plant_at, "--endpoint", bridge_at), track)
    alive = bridge.poll() is None
    for one in (bridge, plant, host):
        one.terminate()
    if alive:
        assert finish(bridge).returncode == 0
    finish(plant)
    host.communicate(timeout=60)


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
    assert "does not answer any more" in said_last.stderr


class Sink(RemoteLink):
    """A link that keeps what is sent."""

    def __init__(self) -> None:
        super().__init__("udp:127.0.0.1:9")
        self.sent: list[bytes] = []

    def send(self, data: bytes) -> None:
        self.sent.append(data)


def test_what_the_controller_does_is_known_by_its_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns = [10**9]
    monkeypatch.setattr("bayesrace.clock.monotonic_ns", lambda: now_ns[0])
    link = Sink()
    driver = RemoteDriver(link, "track")
    state = messages.state(seq=3)
    assert driver.phase is Phase.WAITING
    driver.forward(state, encode(state))
    assert from_datagram(link.sent.pop()) == (STATE, state)
    now_ns[0] += 10**10
    assert driver.unanswered_s == 0  # it may not have been started yet
    driver.note(to_datagram(ACTUATION, blank(Actuation, u=(0.0, 0.0), weights_version="one")))
    driver.note(to_datagram(TELEMETRY, blank(Telemetry, seq=8, sensor_fault="frozen")))
    assert (driver.phase, driver.ticks, driver.fault) == (Phase.DRIVING, 9, "frozen")
    assert (driver.controller.weights_version, driver.faults["frozen"]) == ("one", 1)
    assert driver.levels == [1, 0, 0, 0]
    driver.forward(state, encode(state))
    now_ns[0] += 3 * 10**9
    driver.forward(state, encode(state))
    assert driver.unanswered_s == 3.0
    driver.stop()
    driver.repeat()  # too soon
    now_ns[0] += 2 * 10**8
    driver.repeat()
    said = [from_datagram(one)[0] for one in link.sent]
    assert said.count(COMMAND) == 2
    halted = blank(Actuation, u=(0.0, 0.0), status=Status.HALTED)
    driver.note(to_datagram(ACTUATION, halted))
    now_ns[0] += 2 * 10**8
    driver.repeat()  # it has had its effect
    assert len(link.sent) == len(said)
    assert (driver.phase, driver.unanswered_s) == (Phase.STOPPED, 0)
    final = messages.state(final=True)
    driver.forward(final, encode(final))
    now_ns[0] += 10**10
    assert driver.unanswered_s == 0  # there is no answer to it
    with pytest.raises(InputError):
        driver.note(b"nothing")
    link.close()


@pytest.mark.parametrize("name", ["", "udp:", "udp:7450", "udp:here:port", "tcp:127.0.0.1:1", "x"])
def test_a_link_that_is_none_is_named(name: str) -> None:
    with pytest.raises(InputError, match="use udp:ADDRESS:PORT or unix:PATH"):
        RemoteLink(name)
