"""The bridge: a controller without Python is driven, stopped and watched as any other."""

import dataclasses
import itertools
import json
import os
import select
import signal
import socket
import subprocess
import termios
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from msgspec import structs

from bayesrace.controller.assembly import compiled_controller
from bayesrace.controller.driver import Phase
from bayesrace.controller.native_step import Status
from bayesrace.controller.remote import RemoteDriver, RemoteLink
from bayesrace.controller.settings import MpcSettings
from bayesrace.errors import InputError
from bayesrace.gp.weights import Weights, write_weights
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
from tests.network.cars import free_port, started_host
from tests.programs import finish, run, start, until
from tests.takeover.spoilt_weights import spoilt


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

    def publish(self, weights: Path) -> "subprocess.CompletedProcess[str]":
        """As often as it is told to try again: a check of low priority, on a busy machine."""
        for _ in range(5):
            said = run("publish", weights, *self.where)
            if "try again" not in said.stderr:
                break
        return said


@contextmanager
def serial_line() -> Iterator[tuple[str, str]]:
    """Both ends of a serial line, by their names."""
    ends = [os.openpty() for _ in range(2)]
    (one, _), (other, _) = ends
    done = threading.Event()

    def carry() -> None:
        while not done.is_set():
            for came in select.select((one, other), (), (), 0.1)[0]:
                data = os.read(came, 1 << 12)
                while data and not done.is_set():  # where nobody reads any more, to the end
                    try:
                        data = data[os.write(other if came == one else one, data) :]
                    except BlockingIOError:
                        done.wait(0.001)

    for master, slave in ends:
        tty.setraw(slave)  # and kept open, so that an end can be closed and opened again
        os.set_blocking(master, False)
    carrier = threading.Thread(target=carry)
    carrier.start()
    yield os.ttyname(ends[0][1]), os.ttyname(ends[1][1])
    done.set()
    carrier.join()
    for file in itertools.chain(*ends):
        os.close(file)


@pytest.fixture(params=["udp", "unix, with a key", "serial"])
def links(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[str, str, list[str]]]:
    """Of the program, of the bridge, and an option of both."""
    if request.param == "serial":
        with serial_line() as (one, other):
            yield f"serial:{one}", f"serial:{other}", []
    elif request.param == "udp":
        link = f"udp:127.0.0.1:{free_port()}"
        yield link, link, []
    else:
        link, key = f"unix:{tmp_path / 'host'}", tmp_path / "key"
        key.write_bytes(bytes(32))
        key.chmod(0o600)
        yield link, link, ["--key", str(key)]


@pytest.fixture
def bridged(
    kinematic_artefact: Path, circuit: Circuit, car: Car, weights: Weights, tmp_path: Path,
    links: tuple[str, str, list[str]],
) -> Iterator[Bridged]:  # fmt: skip
    link, link_of_bridge, key = links
    made = HostProgram.made(
        tmp_path, kinematic_artefact, car, circuit.track, circuit.line, weights, MpcSettings()
    )
    track = tmp_path / "track.csv"
    write_track(track, circuit.track)
    plant_at, bridge_at = free_endpoint(), free_endpoint()
    learned = tmp_path / "learned.bin"
    write_weights(learned, weights)
    where = ("--endpoint", plant_at, "--endpoint", bridge_at)
    with started_host(made, link, *key) as host:
        plant = start("plant", "--endpoint", plant_at)
        bridge = start(
            "bridge", link_of_bridge, "--track", track, "--endpoint", plant_at,
            "--listen", bridge_at, "--artefact", kinematic_artefact, "--weights", learned,
            "--store", tmp_path / "store", *key,
        )  # fmt: skip
        try:
            yield Bridged(host, bridge, where, track)
        finally:
            for one in (bridge, plant):
                one.terminate()
                one.communicate(timeout=60)


@pytest.mark.check
def test_a_drive_in_lockstep_is_that_of_one_process_to_the_bit(
    bridged: Bridged, kinematic_artefact: Path, circuit: Circuit, car: Car, weights: Weights,
    tmp_path: Path,
) -> None:  # fmt: skip
    """Though the program stalls for 2 s; the plant waits 5 s."""
    log = tmp_path / "drive.mcap"
    drive = bridged.drive(log, "--laps", "10")
    until(lambda: log.exists() and log.stat().st_size > 20_000, "a run in progress", every_s=0.001)
    bridged.host.send_signal(signal.SIGSTOP)
    time.sleep(2.0)
    bridged.host.send_signal(signal.SIGCONT)
    done = finish(drive)
    assert "10 lap(s) done" in done.stdout, done.stderr
    controller = compiled_controller(kinematic_artefact, car, circuit.track, circuit.line, weights)
    alone = LogWriter(tmp_path / "alone.mcap")
    ClosedLoop(car, circuit.track, circuit.line, controller, log=alone).drive(10)
    alone.close()
    driven, expected = LogReader(log), LogReader(tmp_path / "alone.mcap")
    assert [one.x for one in driven.select(TRUTH)] == [one.x for one in expected.select(TRUTH)]
    sent = driven.select(ACTUATION)
    assert [one.seq for one in sent] == list(range(len(sent)))
    assert {one.weights_version for one in sent} == {weights.version}
    assert len(driven.select(TELEMETRY)) == len(sent) > 1000
    assert max(b.source_time_ns - a.source_time_ns for a, b in pairwise(sent)) > 1.9e9


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


@pytest.mark.check
@pytest.mark.wall_clock
@pytest.mark.parametrize("links", ["unix, with a key", "serial"], indirect=True)
def test_new_weights_are_checked_adopted_kept_and_rolled_back(
    bridged: Bridged, weights: Weights, tmp_path: Path
) -> None:
    again = dataclasses.replace(weights, version="again")
    files = {"again": again, "spoilt": spoilt(again, "scale 3")}
    for name, one in files.items():
        write_weights(tmp_path / name, one)
    log = tmp_path / "drive.mcap"
    drive = bridged.drive(log, "--mode", "realtime", "--laps", "10000", "--max-time", "3600")
    until(lambda: bridged.status()["phase"] == "driving", "driving", every_s=0.2)

    def drives_by(version: str) -> bool:
        return bool(bridged.status()["weights_version"] == version)

    said = bridged.publish(tmp_path / "again")
    assert said.returncode == 0, said.stderr
    until(lambda: drives_by("again"), "new weights")
    said = bridged.publish(tmp_path / "spoilt")
    assert said.returncode == 1
    assert "worse" in said.stderr
    kept = json.loads((tmp_path / "store" / "index.json").read_text())
    assert [one["version"] for one in kept["entries"]] == ["again"]
    said = run("rollback", *bridged.where)
    assert said.returncode == 0, said.stderr
    until(lambda: drives_by(weights.version), "the weights before")
    assert run("stop", "--run", *bridged.where).returncode == 0
    finish(drive)
    kinds = [one.kind for one in LogReader(log).select(EVENT)]
    # Those that have held for long before the return may have been called proven, and the first
    # attempts refused for the time being.
    said_of = [one for one in kinds if one.startswith("weights_") and one != "weights_proven"]
    assert [kind for kind, _ in itertools.groupby(said_of)][-3:] == [
        "weights_accepted", "weights_refused", "weights_rolled_back"
    ]  # fmt: skip


@pytest.fixture
def now_ns(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """What the monotonic clock says, to be moved on."""
    now = [10**10]
    monkeypatch.setattr("bayesrace.clock.monotonic_ns", lambda: now[0])
    return now


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


def test_what_the_controller_does_is_known_by_its_answers(now_ns: list[int]) -> None:
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
    estimated = structs.replace(report, estimate=(1.0,) * 9, deviation=(0.5,) * 9, fallback=2)
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
    driver.go()
    for status, phase, sent in (
        (Status.HALTED, Phase.STOPPED, 4),  # it was lost
        (Status.CONVERGED, Phase.FALLBACK, 4),
        (Status.HALTED, Phase.STOPPED, 4),  # somebody else has stopped the car
    ):
        driver.take(state)
        driver.note(answered(status=status))
        now_ns[0] += 2 * 10**8
        driver.repeat()
        assert (phase_of(driver), len(link.sent)) == (phase, sent)
    driver.note(answered(status=Status.CONVERGED))
    driver.go()  # to a car that rolls
    for sent in (6, 7, 8, 9, 10, 10, 10):
        driver.take(state)
        now_ns[0] += 2 * 10**8
        driver.repeat()
        assert len(link.sent) == sent
    with pytest.raises(InputError):
        driver.note(b"\x92\xa5state" + b"\x91" * 5000)
    link.close()


def test_a_serial_line_that_cannot_have_its_rate_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An adapter takes the rest of the settings, and the system calls that success."""
    _, line = os.openpty()
    other = [0, 0, 0, 0, termios.B9600, termios.B9600, []]
    monkeypatch.setattr(termios, "tcgetattr", lambda _: other)
    with pytest.raises(InputError, match="cannot have a rate of 921600"):
        RemoteLink(f"serial:{os.ttyname(line)}")


def test_between_runs_it_waits_whatever_the_last_answer_was(now_ns: list[int]) -> None:
    """Else the end of a held run would be taken for a missing director."""
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


def test_states_of_other_runs_are_counted_and_say_nothing_of_the_one_that_is_driven(
    now_ns: list[int],
) -> None:
    """Which one is driven the controller decides: else a forged state would end the hold of a run
    whose director is missing."""
    driver, state = RemoteDriver(Sink(), "track"), messages.state(seq=3)
    assert driver.take(state)
    driver.note(answered(state_seq=3))
    for odd in ({"seq": 1003}, {"seq": 1003, "final": True}, {"run": 2}, {"epoch": 2}):
        assert not driver.take(structs.replace(state, **({"seq": 4} | odd)))
    assert (driver.newest, driver.foreign, phase_of(driver)) == (state, 4, Phase.DRIVING)
    assert driver.take(structs.replace(state, seq=6))
    assert (driver.numbering.lost, driver.foreign) == (2, 4)
    driver.note(answered(epoch=2, state_seq=9))
    assert driver.take(structs.replace(state, epoch=2, seq=10))
    assert not driver.take(structs.replace(state, epoch=3, seq=0))
    now_ns[0] += 11 * 10**8
    assert driver.take(structs.replace(state, epoch=3, seq=0))  # after silence, whichever comes
    assert (driver.numbering.lost, driver.foreign) == (2, 5)


def test_time_in_which_the_bridge_did_not_run_is_no_silence_of_its_controller(
    now_ns: list[int],
) -> None:
    driver = RemoteDriver(Sink(), "track")
    driver.take(messages.state())
    now_ns[0] += 9 * 10**9
    assert driver.unanswered_s == 9
    driver.excuse()
    assert driver.unanswered_s == 0
    driver.take(messages.state(seq=1))
    now_ns[0] += 10**9
    assert driver.unanswered_s == 1


def test_a_link_never_waits_to_send_and_hears_the_controller_alone(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as held_up:
        held_up.bind(str(tmp_path / "host"))
        link = RemoteLink(f"unix:{tmp_path / 'host'}", str(tmp_path / "own"))
        for _ in range(5000):
            link.send(bytes(1000))
        assert link.unsent > 0
        assert not link.refused
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
    refused = [link.refused]
    for _ in range(3):  # nobody is there any more
        link.send(b"state")
        assert link.receive(0.1) is None
    assert link.unsent > 0
    assert [*refused, link.refused] == [False, True]
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
        assert "both with the same --key" in done.stderr
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
