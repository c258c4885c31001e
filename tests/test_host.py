"""The controller without Python (controller/host): to the bit as in Python, and over its links."""

import contextlib
import dataclasses
import math
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import pytest
from msgspec.structs import replace

from bayesrace import clock
from bayesrace.codegen.build import HOST, NATIVE, PROGRAM, build
from bayesrace.codegen.compiler import Compiler
from bayesrace.codegen.host_files import (
    HEAD,
    IDENTITY_BYTES,
    SETTINGS_FILE,
    WEIGHTS_FILE,
    weights_file,
)
from bayesrace.codegen.platforms import get_platform
from bayesrace.codegen.settings import BuildSettings
from bayesrace.controller import process
from bayesrace.controller.driver import Level
from bayesrace.controller.native_step import Status
from bayesrace.errors import InputError
from bayesrace.gp.weights import Weights
from bayesrace.manifest import read_manifest
from bayesrace.messages import (
    ACTUATION,
    BRAKING,
    COMMAND,
    STATE,
    TELEMETRY,
    Actuation,
    BrakingPlan,
    Command,
    FrameReader,
    Message,
    Seal,
    State,
    Topic,
    datagrams_in,
    framed,
    from_datagram,
    to_datagram,
    to_frame,
)
from bayesrace.operation.host import HostProgram, write_program
from bayesrace.transport import HEARTBEAT_S, NEWEST
from tests import sample_messages as messages
from tests.conftest import Circuit, Driven
from tests.exchanged import without_clocks
from tests.instruments import odometry, reading
from tests.native_programs import SANITIZED, native_program
from tests.network.cars import free_port, started_host
from tests.test_fmu_controller_native import signed

M = TypeVar("M", bound=Message)


@pytest.mark.parametrize(
    "given", [{}, {"sensors": odometry(), "max_time_s": 6.0}], ids=["states", "readings"]
)
def test_a_recorded_drive_is_answered_to_the_bit(
    host: HostProgram, driven: Driven, weights: Weights, given: dict[str, Any]
) -> None:
    """Actuations and telemetry, plan and tube included, are those of the controller in Python."""
    log = driven(**given)
    answers = host.answers(log.select(STATE))
    assert len(answers) > 100
    for (sent, how), *expected in zip(
        answers, log.select(ACTUATION), log.select(TELEMETRY), strict=True
    ):
        of_file = replace(expected[0], weights_version=weights.version)
        assert without_clocks(sent) == without_clocks(of_file)
        assert without_clocks(how) == without_clocks(expected[1])


@pytest.mark.check
@pytest.mark.timeout(1500)  # ziglang builds a C library per target the first time
@pytest.mark.parametrize(
    ("name", "emulator", "target"),
    [
        ("aarch64-linux", ("qemu-aarch64",), "aarch64-linux-musl"),
        ("aarch32-linux", ("qemu-arm",), "arm-linux-musleabihf"),
        ("riscv64-linux", ("qemu-riscv64",), "riscv64-linux-musl"),
    ],
)
def test_on_other_processors_a_recorded_drive_is_answered_alike(
    name: str, emulator: tuple[str, ...], target: str, host: HostProgram, driven: Driven,
    daqp: Path, tmp_path: Path, ziglang: None,
) -> None:  # fmt: skip
    if not shutil.which(emulator[0]):
        pytest.skip(f"not installed: {emulator[0]}")
    artefact, _ = build(BuildSettings(), platform=get_platform(name), daqp=daqp)
    line = (sys.executable, "-m", "ziglang", "cc", "-target", target, "-static")
    shutil.copytree(host.folder, tmp_path, dirs_exist_ok=True)
    write_program(artefact, tmp_path, Compiler(line, "ziglang"))
    states = driven().select(STATE)
    for (sent, how), (expected, as_expected) in zip(
        HostProgram(tmp_path).answers(states, emulator), host.answers(states), strict=True
    ):
        np.testing.assert_allclose(sent.u, expected.u, rtol=0, atol=1e-9)
        assert (sent.status, how.fallback) == (expected.status, as_expected.fallback)


Plant = tuple[socket.socket, "subprocess.Popen[str]"]


@pytest.fixture(params=["udp", "unix"])
def plant(host: HostProgram, tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Plant]:
    """A socket that is connected to the program, and that."""
    own: Any = ("127.0.0.1", 0)
    there: Any = ("127.0.0.1", free_port())
    family, link = socket.AF_INET, f"udp:127.0.0.1:{there[1]}"
    if request.param == "unix":
        own, there = str(tmp_path / "plant"), str(tmp_path / "host")
        family, link = socket.AF_UNIX, f"unix:{there}"
    with started_host(host, link) as process:
        with socket.socket(family, socket.SOCK_DGRAM) as one:
            one.settimeout(20.0)
            one.bind(own)
            one.connect(there)
            yield one, process
        process.terminate()
        process.wait(20)
    assert process.returncode == 0
    assert not (tmp_path / "host").exists()


@contextlib.contextmanager
def another(plant: socket.socket, folder: Path) -> Iterator[socket.socket]:
    """A second socket that is connected to the program."""
    with socket.socket(plant.family, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0) if plant.family == socket.AF_INET else str(folder / "other"))
        one.connect(plant.getpeername())
        one.settimeout(20.0)
        yield one


def received(plant: socket.socket, topic: Topic[M]) -> M:
    """The next message of a topic."""
    while True:
        found, message = from_datagram(plant.recv(1 << 16))
        if found is topic:
            return cast(M, message)


def at_start(circuit: Circuit, **changes: Any) -> State:
    x = tuple(map(float, circuit.start(v_mps=1.5)))
    return replace(messages.state(epoch=7, run=3, x=x), **changes)


def ended(process: "subprocess.Popen[str]") -> str:
    """What the program says at its end."""
    process.terminate()
    assert process.stderr is not None
    said = process.stderr.read()
    assert process.wait(20) == 0
    return said


@pytest.mark.wall_clock
def test_states_are_answered_and_silence_ends_at_the_fallback(
    plant: Plant, circuit: Circuit
) -> None:
    one, process = plant
    for no_state in (b"no state", b""):
        one.send(no_state)
    one.send(to_datagram(STATE, at_start(circuit)))
    sent, how = received(one, ACTUATION), received(one, TELEMETRY)
    assert (sent.epoch, sent.run, sent.state_seq) == (7, 3, 0)
    assert how.fallback == Level.SOLUTION
    one.settimeout(3.0)
    with contextlib.suppress(TimeoutError):  # one state, then nothing: it says no more after 1 s
        for _ in range(1000):
            how = received(one, TELEMETRY)
    assert how.fallback >= Level.BRAKE
    said = ended(process)
    assert "states 1," in said
    assert "datagrams refused 2," in said


@pytest.mark.wall_clock
def test_no_other_sender_ends_the_run_or_takes_its_answers(
    plant: Plant, circuit: Circuit, tmp_path: Path
) -> None:
    """However many states it sends, of another run or of this one."""
    one, process = plant
    state = at_start(circuit)
    one.send(to_datagram(STATE, state))
    received(one, ACTUATION)
    with another(one, tmp_path) as stranger:
        stranger.settimeout(0.2)
        foreign = replace(state, epoch=8, final=True)
        burst = [replace(foreign, seq=k, time_s=0.02 * k, final=False) for k in range(20)]
        for said in (foreign, *burst, replace(state, seq=1, time_s=0.02)):
            stranger.send(to_datagram(STATE, said))
        asked_ns = time.monotonic_ns()
        with pytest.raises(TimeoutError):
            stranger.recv(4096)
    while (answer := received(one, ACTUATION)).source_time_ns < asked_ns:
        pass  # the car that drives on without states still has inputs
    assert (answer.epoch, answer.state_seq) == (7, 0)
    one.send(to_datagram(STATE, replace(state, seq=1, time_s=0.3)))
    while received(one, ACTUATION).state_seq != 1:
        pass
    assert "from others 22," in ended(process)


def test_a_stop_is_obeyed_whoever_sends_it_and_a_go(
    plant: Plant, circuit: Circuit, tmp_path: Path
) -> None:
    one, process = plant
    state = at_start(circuit, lockstep=True)
    with another(one, tmp_path) as other:
        statuses = []
        for k, said in enumerate(("", "stop", "", "go", "")):
            if said:
                command = Command(seq=k, source_time_ns=0, command=said, text="test")
                other.send(to_datagram(COMMAND, command))
                time.sleep(0.2)  # it has come before the next state
            sent = replace(state, seq=k, time_s=0.02 * k, x=(*state.x[:3], 0.0, *state.x[4:]))
            one.send(to_datagram(STATE, sent))
            statuses.append((received(one, ACTUATION).status, received(one, TELEMETRY).fallback))
    assert [level for _, level in statuses[1:3]] == [Level.STOP, Level.STOP]
    assert statuses[1][0] == statuses[2][0] == Status.HALTED
    assert statuses[0][0] == statuses[3][0] == 0
    assert "commands 2," in ended(process)


def test_another_plant_is_answered_once_the_first_is_silent(
    plant: Plant, circuit: Circuit, tmp_path: Path
) -> None:
    """In lockstep it sends one state and waits: the answer comes to it."""
    one, _ = plant
    state = at_start(circuit, lockstep=True)
    one.send(to_datagram(STATE, state))
    received(one, ACTUATION)
    with another(one, tmp_path) as other:
        time.sleep(1.1)
        other.send(to_datagram(STATE, replace(state, epoch=8)))
        assert received(other, ACTUATION).epoch == 8


@pytest.mark.parametrize("plant", ["udp"], indirect=True)
def test_after_a_stall_the_newest_state_is_there(plant: Plant, circuit: Circuit) -> None:
    """Of 0.6 s at 500 Hz; the system's default has room for half of them."""
    one, process = plant
    state = at_start(circuit)
    one.send(to_datagram(STATE, state))
    received(one, ACTUATION)
    process.send_signal(signal.SIGSTOP)
    for k in range(1, 300):
        one.send(to_datagram(STATE, replace(state, seq=k, time_s=0.002 * k)))
    process.send_signal(signal.SIGCONT)
    while received(one, ACTUATION).state_seq != 299:
        pass


@pytest.mark.wall_clock
def test_in_real_time_each_state_is_answered_and_a_braking_plan_sent_ahead(
    plant: Plant, driven: Driven
) -> None:
    """Half a second as it was driven in lockstep; then the run is over, and another one begins."""
    one, _ = plant
    recorded = driven(max_time_s=0.6).select(STATE)[:25]
    for run in (3, 4):
        begin, plan, usable = time.monotonic(), None, 0
        for k, state in enumerate(recorded):
            clock.sleep_until_ns(round((begin + 0.02 * k) * 1e9))
            seq, final = k + 25 * run, k == 24
            sent = replace(state, run=run, seq=seq, lockstep=False, final=final)
            one.send(to_datagram(STATE, sent))
            while not final:
                topic, found = from_datagram(one.recv(1 << 16))
                plan = found if topic is BRAKING else plan
                if isinstance(found, Actuation) and (found.run, found.state_seq) == (run, seq):
                    usable += found.status == 0
                    break
        assert usable > 12  # on a loaded machine some come too late
        assert isinstance(plan, BrakingPlan)
        assert plan.run == run
        assert len(plan.d) == len(plan.delta) > 10
        assert min(plan.d) < 0
        time.sleep(0.1)


def test_states_that_are_hardly_apart_do_not_hold_it_up(
    host: HostProgram, circuit: Circuit
) -> None:
    """Bug guarded: it estimated over each lost period, of which there were 10^14 then."""
    start = at_start(circuit, lockstep=True, estimated=True)
    states = []
    for seq, time_s in ((0, 0.5), (1, math.nextafter(0.5, 1.0)), (3, 0.52), (4, 0.54)):
        pose = reading("pose", time_s, x=start.x[0], y=start.x[1], psi=start.x[2],
                       deviation=(0.001, 0.001, 0.01))  # fmt: skip
        states.append(replace(start, seq=seq, time_s=time_s, readings=(pose,)))
    assert len(host.answers(states)) == 4


def test_a_stream_ends_with_a_signal_or_its_reader_and_the_counts_are_said(
    host: HostProgram, circuit: Circuit
) -> None:
    """Also in the middle of a datagram."""
    line = [str(host.folder / PROGRAM), str(host.folder), "stdio"]
    pipe = subprocess.PIPE
    for closes in (False, True):
        with subprocess.Popen(line, stdin=pipe, stdout=pipe, stderr=pipe) as process:
            assert process.stdin is not None
            assert process.stdout is not None
            assert process.stderr is not None
            assert b"ready" in process.stderr.readline()
            data = framed(to_datagram(STATE, at_start(circuit, lockstep=True)))
            if closes:
                process.stdout.close()
                process.stdin.write(2 * data)
            else:
                process.stdin.write(data[:-1])
            process.stdin.flush()
            if not closes:
                time.sleep(0.3)
                process.terminate()
            said = process.stderr.read()
            assert process.wait(20) == 0
        assert (b"unsent 1" if closes else b"states 0,") in said


def test_with_a_key_the_same_is_answered_and_nothing_without_it(
    host: HostProgram, circuit: Circuit, tmp_path: Path
) -> None:
    key, state = tmp_path / "key", at_start(circuit, lockstep=True)
    key.write_bytes(bytes(32))
    key.chmod(0o600)
    line = [str(host.folder / PROGRAM), str(host.folder), "stdio", "--key", str(key)]
    pipe = subprocess.PIPE
    with subprocess.Popen(line, stdin=pipe, stdout=pipe, stderr=pipe) as process:
        assert process.stderr is not None
        assert b"ready" in process.stderr.readline()
        seal, sent = Seal.read(key), to_datagram(STATE, state)
        answers, said = process.communicate(framed(sent) + framed(seal.sealed(sent)), timeout=60)
    (answer,) = map(seal.opened, datagrams_in(answers))
    assert answer is not None
    ((expected, _),) = host.answers([state])
    assert without_clocks(from_datagram(answer)[1]) == without_clocks(expected)
    assert b"states 1," in said
    assert b"forged 1, replayed 0" in said


def test_over_a_serial_line_a_drive_is_answered_as_over_a_stream(
    host: HostProgram, driven: Driven
) -> None:
    """Datagrams are no longer than docs/host.md says, nor is the time that they take."""
    *states, _ = driven(max_time_s=1.2).select(STATE)  # the last one ends the run
    master, slave = os.openpty()
    line = [str(host.folder / PROGRAM), str(host.folder), f"serial:{os.ttyname(slave)}"]
    reader, came, longest = FrameReader(), list[bytes](), Counter[str]()

    def next_of(topic: Topic[M]) -> M:
        while True:
            while not came:
                came.extend(reader.take(os.read(master, 1 << 16)))
            frame = to_frame(came[0])
            found, message = from_datagram(came.pop(0))
            longest[found.name] = max(longest[found.name], len(frame))
            if found is topic:
                return cast(M, message)

    with subprocess.Popen([*line, "--telemetry"], stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert "ready" in process.stderr.readline()
        os.close(slave)
        try:
            for state, expected in zip(states, host.answers(states), strict=True):
                frame = to_frame(to_datagram(STATE, state))
                longest["state"] = max(longest["state"], len(frame))
                os.write(master, b"noise" * (state.seq % 3) + frame)
                answered = next_of(ACTUATION), next_of(TELEMETRY)
                assert list(map(without_clocks, answered)) == list(map(without_clocks, expected))
        finally:
            os.close(master)  # which ends it
        said = process.stderr.read()
        assert process.wait(20) == 0
    assert len(states) >= 60
    assert "unsent 0, bad frames 40," in said
    for name, size in (("state", 240), ("actuation", 170), ("telemetry", 2500)):
        assert 0.9 * size < longest[name] <= size


def test_what_the_system_refuses_is_reported_and_the_program_goes_on(
    host: HostProgram, circuit: Circuit
) -> None:
    line = [str(host.folder / PROGRAM), str(host.folder), "stdio", "--cpu", "1023"]
    given = framed(to_datagram(STATE, at_start(circuit, lockstep=True)))
    done = subprocess.run(line, input=given, capture_output=True, check=True, timeout=60)
    assert b"--cpu: Invalid argument" in done.stderr
    (answer,) = datagrams_in(done.stdout)
    assert from_datagram(answer)[0] is ACTUATION


def test_a_unix_socket_in_use_is_left_alone_and_one_that_was_left_is_taken(
    host: HostProgram, tmp_path: Path
) -> None:
    path = tmp_path / "socket"
    line = [str(host.folder / PROGRAM), str(host.folder), f"unix:{path}"]
    with subprocess.Popen(line, stderr=subprocess.PIPE, text=True) as first:
        assert first.stderr is not None
        assert "ready" in first.stderr.readline()
        second = subprocess.run(line, capture_output=True, text=True, check=False, timeout=60)
        assert second.returncode == 1
        assert f"{path}: Address already in use" in second.stderr
        assert path.exists()
        first.kill()
    assert path.exists()
    with subprocess.Popen(line, stderr=subprocess.PIPE, text=True) as third:
        assert third.stderr is not None
        assert "ready" in third.stderr.readline()
        ended(third)
    assert not path.exists()


def test_the_loop_in_c_has_the_same_times_as_the_one_in_python() -> None:
    text = (NATIVE.parent / "host" / "br_host.c").read_text()
    found = {name: float(value) for name, value in re.findall(r"#define (\w+) ([\d.]+)", text)}
    assert found.pop("IDLE_NS") == HEARTBEAT_S * 1e9
    assert found.pop("NEWEST") == NEWEST
    assert found.pop("SILENT_NS") == process._SILENT_S * 1e9
    assert found == {name: getattr(process, f"_{name}") for name in found}
    assert len(found) == 8


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ((), "usage"),
        (("stdio",), "usage"),
        (("DATA", "tcp:127.0.0.1:7450"), "no link; use udp:ADDRESS:PORT, unix:PATH, serial:"),
        (("DATA", "udp:here"), "no address and port"),
        (("DATA", "udp:127.0.0.1:port"), "127.0.0.1:port: "),
        (("DATA", "unix:/nowhere/socket"), "/nowhere/socket: No such file"),
        (("DATA", "stdio", "--rate", "0"), "--rate: HZ"),
        (("DATA", "stdio", "--rate"), "--rate: HZ"),
        (("DATA", "stdio", "--fifo", "80.5"), "--fifo: PRIORITY"),
        (("DATA", "stdio", "--fast"), "--fast: no such option"),
        (("DATA", "stdio", "--key", "/nowhere"), "--key: /nowhere: No such file"),
        (("DATA", "stdio", "--key"), "--key: FILE"),
        (("/nowhere", "stdio"), "/nowhere: path.bin is missing"),
    ],
)
def test_a_bad_start_is_named(host: HostProgram, line: tuple[str, ...], says: str) -> None:
    words = [str(host.folder) if word == "DATA" else word for word in line]
    done = subprocess.run(
        [host.folder / PROGRAM, *words], input="", capture_output=True, text=True, check=False,
        timeout=60,
    )  # fmt: skip
    assert done.returncode in (1, 2)
    assert says in done.stderr


def test_the_longest_version_of_weights_is_sent_and_one_that_is_no_text_is_refused(
    host: HostProgram, circuit: Circuit, weights: Weights, kinematic_artefact: Path, tmp_path: Path
) -> None:
    shutil.copytree(host.folder, tmp_path, dirs_exist_ok=True)
    file = tmp_path / WEIGHTS_FILE
    named = dataclasses.replace(weights, version="ü" * 200)
    capacity = read_manifest(kinematic_artefact).gp_capacity
    whole = weights_file(named, weights.discretisation, capacity)
    file.write_bytes(whole)
    state = at_start(circuit, lockstep=True)
    ((sent, _),) = HostProgram(tmp_path).answers([state])
    assert sent.weights_version == named.version
    body = bytearray(whole[HEAD.size :])
    for text, says in ((b"\xff\0", "a version that is no text"), (b"x" * 801, "without end")):
        body[IDENTITY_BYTES : IDENTITY_BYTES + len(text)] = text
        file.write_bytes(signed(whole[: HEAD.size] + bytes(body)))
        with pytest.raises(InputError, match=says):
            HostProgram(tmp_path).answers([state])


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (("margin_m", "margin"), "settings.txt has an unknown name: margin"),
        (("stale_s ", "stale_s 1 "), "settings.txt has more than a number: stale_s"),
        (("iterations ", "iterations 1."), "settings.txt has no whole number from 0 to 1000000"),
        (("stale_s", "# " + 600 * "x"), "settings.txt has a line that is too long"),
        (("r_duty ", "r_duty x"), "settings.txt lacks a number: r_duty"),
        (("stale_s", "# stale_s"), "settings.txt lacks a line: stale_s"),
        (("stale_s ", "stale_s -"), "out of its range"),
        (("gate ", "# "), "settings.txt lacks a line: gate"),
        (("drift 0.0 ", "drift "), "settings.txt lacks a number: drift"),
    ],
)
def test_unusable_settings_are_named(
    host: HostProgram, tmp_path: Path, change: tuple[str, str], fault: str
) -> None:
    shutil.copytree(host.folder, tmp_path, dirs_exist_ok=True)
    file = tmp_path / SETTINGS_FILE
    file.write_text(file.read_text().replace(*change))
    with pytest.raises(InputError, match=re.escape(fault)):
        HostProgram(tmp_path).answers([])


def test_settings_that_are_cut_off_are_named(host: HostProgram, tmp_path: Path) -> None:
    """Within the last number, which is one then, too."""
    shutil.copytree(host.folder, tmp_path, dirs_exist_ok=True)
    file = tmp_path / SETTINGS_FILE
    file.write_text(file.read_text()[:-2])
    with pytest.raises(InputError, match="is cut off in its last line: export it again"):
        HostProgram(tmp_path).answers([])


@pytest.mark.check
def test_no_sanitizer_finds_anything_whatever_the_states_say(
    kinematic_artefact: Path, host: HostProgram, circuit: Circuit, tmp_path: Path
) -> None:
    """Runs, plants, numbers and times in disorder; readings of too many; lockstep and not."""
    own = kinematic_artefact / HOST
    source, *others = sorted(own.glob("*.c"), key=lambda one: one.name != "main.c")
    also = (f"-I{own}", *map(str, others))
    program = native_program(kinematic_artefact, source, tmp_path / PROGRAM, *SANITIZED, also=also)
    shutil.copytree(host.folder, tmp_path, dirs_exist_ok=True, ignore=lambda *_: [PROGRAM])
    random = np.random.default_rng(4)
    odd = (-1e6, 1e6, 0.0, 1e-300, -0.0)
    start = at_start(circuit)
    pose = reading("pose", 0.0, x=start.x[0], y=start.x[1], psi=start.x[2],
                   deviation=(0.001, 0.001, 0.01))  # fmt: skip
    readings = [pose, *(reading(f"gyro{i}", 0.02, omega=0.0, deviation=(0.02,)) for i in range(9))]
    states = []
    for k in range(300):
        delays = (0.0, 0.0, 0.02) * int(random.integers(0, 64))
        sent = replace(
            start, seq=k, time_s=0.02 * k, lockstep=k < 200, actuation_delays=delays,
            final=k % 90 == 89,
        )  # fmt: skip
        if k % 2:
            some = random.choice(len(readings), int(random.integers(0, 9)))
            sent = replace(sent, estimated=True, readings=tuple(readings[i] for i in some))
        if k % 5 == 1:
            x = list(sent.x)
            x[int(random.integers(0, 7))] = float(random.choice(odd))
            sent = replace(sent, x=tuple(x))
        if k % 11 == 5:
            epoch = random.choice([7, 0, 2**63 - 1])
            seq = random.choice([k, 0, k + 5] if epoch == 7 else [2**63 - 1, 0])
            sent = replace(sent, seq=int(seq), epoch=int(epoch))
        states.append(sent)
    answers = HostProgram(tmp_path).answers(states)
    assert program.name == PROGRAM
    assert len(answers) > 100
    assert np.isfinite([sent.u for sent, _ in answers]).all()
