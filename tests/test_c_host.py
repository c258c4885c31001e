"""A C program hosts the whole controller: to the bit as Python does, and over UDP."""

import contextlib
import itertools
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from bayesrace.codegen.build import HOST, build
from bayesrace.codegen.compiler import find_compiler
from bayesrace.codegen.daqp import VERSION
from bayesrace.codegen.host_files import SETTINGS_FILE, export
from bayesrace.codegen.platforms import get_platform
from bayesrace.codegen.settings import BuildSettings
from bayesrace.controller.assembly import PredictiveController
from bayesrace.controller.driver import Level
from bayesrace.controller.native_step import NativeStep
from bayesrace.controller.process_settings import ControllerSettings
from bayesrace.gp.weights import Weights
from bayesrace.log import LogReader, LogWriter
from bayesrace.manifest import LIBRARY, read_manifest
from bayesrace.messages import ACTUATION, QUANTITIES, STATE, TELEMETRY, State
from bayesrace.operation.closed_loop import ClosedLoop
from bayesrace.vehicles import Car
from tests import sample_messages as messages
from tests.conftest import SETTINGS, Circuit
from tests.instruments import odometry, reading
from tests.native_programs import SANITIZED, native_program
from tests.programs import ROOT
from tests.shared import shared_folder

SOURCE = ROOT / "examples" / "c_host"
LAPS = 1
INSTRUMENTS = ("pose", "wheel", "gyro")
"""By number."""


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory, kinematic_artefact: Path) -> Path:
    """Made as its user makes it."""
    if not shutil.which("make"):
        pytest.skip("make is not installed")
    folder = tmp_path_factory.mktemp("c_host")
    for name in ("main.c", "Makefile"):
        shutil.copy(SOURCE / name, folder)
    compiler = " ".join(find_compiler().command)
    line = ["make", "-C", str(folder), f"ARTEFACT={kinematic_artefact}", f"CC={compiler}"]
    subprocess.run(line, check=True, capture_output=True, timeout=120)
    return folder / "c_host"


@pytest.fixture(scope="module")
def data(
    tmp_path_factory: pytest.TempPathFactory,
    kinematic_artefact: Path,
    circuit: Circuit,
    car: Car,
    weights: Weights,
) -> Path:
    """Racing line, weights and settings."""
    folder = tmp_path_factory.mktemp("data")
    values = SETTINGS.parameters(car) | ControllerSettings().cycle_values(car)
    values |= car.tuning.estimation(nominal=False)
    table = circuit.table
    export(folder, read_manifest(kinematic_artefact), table.rows, table.spacing_m, values, weights)
    return folder


def line_of(state: State) -> str:
    """As the program reads it."""
    flags = int(state.lockstep), int(state.final)
    delays_s = state.actuation_delays[2::3]
    numbers = (state.epoch, state.run, state.seq, state.time_s, *flags, *state.x, *state.u_applied,
               *delays_s)  # fmt: skip
    line = " ".join(map(repr, numbers))
    for one in state.readings if state.estimated else ():
        values = ((QUANTITIES.index(name), *both) for name, both in one.values.items())
        head = INSTRUMENTS.index(one.instrument), one.time_s
        line += " ; " + " ".join(map(repr, itertools.chain(head, *values)))
    return line + (" ;" if state.estimated and not state.readings else "") + "\n"


def answers(program: Sequence[str | Path], data: Path, states: Iterable[State]) -> list[list[str]]:
    sent_lines = "".join(map(line_of, states))
    done = subprocess.run(
        [*program, data], input=sent_lines, capture_output=True, text=True, check=True, timeout=300
    )
    return [line.split() for line in done.stdout.splitlines()]


def test_a_recorded_drive_is_answered_to_the_bit(
    program: Path,
    data: Path,
    tmp_path: Path,
    native: NativeStep,
    circuit: Circuit,
    car: Car,
) -> None:
    log = LogWriter(tmp_path / "log.mcap")
    loop = ClosedLoop(car, circuit.track, circuit.line, PredictiveController(native), log=log)
    loop.drive(LAPS)
    log.close()
    reader = LogReader(tmp_path / "log.mcap")
    rows = answers([program], data, reader.select(STATE))
    actuations, telemetry = reader.select(ACTUATION), reader.select(TELEMETRY)
    assert len(rows) == len(actuations) > 100
    for row, sent, how in zip(rows, actuations, telemetry, strict=True):
        assert tuple(map(int, row[:3])) == (sent.epoch, sent.run, sent.state_seq)
        assert tuple(map(float, row[3:6])) == (sent.decided_at_s, *sent.u)
        assert tuple(map(int, row[6:])) == (sent.status, how.fallback)


@pytest.fixture(scope="module")
def daqp() -> Path:
    """Its source distribution, of the package index."""
    wanted = f"daqp=={VERSION}"

    def download(folder: Path) -> None:
        line = [sys.executable, "-m", "pip", "download", "-q", "--no-deps", "--no-binary", "daqp"]
        subprocess.run([*line, wanted, "-d", folder], check=True, timeout=600)

    try:
        return next(shared_folder("daqp", [wanted], download).glob("daqp-*.tar.gz"))
    except (subprocess.SubprocessError, StopIteration) as error:
        pytest.skip(f"{wanted} cannot be downloaded: {error}")


@pytest.mark.check
@pytest.mark.timeout(1500)  # ziglang builds a C library per target the first time
@pytest.mark.parametrize(
    ("name", "emulator", "of_sources"),
    [
        ("aarch64-linux", ("qemu-aarch64", "-L", "/usr/aarch64-linux-gnu"), False),
        ("aarch32-linux", ("qemu-arm",), True),
    ],
)
def test_on_other_processors_a_recorded_drive_is_answered_alike(
    name: str, emulator: tuple[str, ...], of_sources: bool, program: Path, data: Path,
    daqp: Path, circuit: Circuit, car: Car, native: NativeStep, tmp_path: Path, ziglang: None,
) -> None:  # fmt: skip
    """By the library that is built for them, or a program of the artefact's sources."""
    if not shutil.which(emulator[0]) or not all(Path(one).exists() for one in emulator[2:]):
        pytest.skip(f"not installed: {' '.join(emulator)}")
    platform = get_platform(name)
    artefact, _ = build(BuildSettings(), platform=platform, daqp=daqp)
    target = platform.zig
    code: list[str | Path] = [artefact / LIBRARY, f"-Wl,-rpath,{artefact}"]
    if of_sources:
        target = target.replace("gnu", "musl").split(".")[0]
        code = ["-static", *artefact.glob("*.c"), *artefact.glob("daqp/*.c")]
    host = artefact / HOST
    line: list[str | Path] = [sys.executable, "-m", "ziglang", "cc", "-target", target, "-O2"]
    line += [SOURCE / "main.c", host / "br_files.c", *code, f"-I{artefact}", f"-I{host}", "-lm"]
    subprocess.run([*line, "-o", tmp_path / "c_host"], check=True, timeout=600)
    log = LogWriter(tmp_path / "log.mcap")
    loop = ClosedLoop(car, circuit.track, circuit.line, PredictiveController(native), log=log)
    loop.drive(LAPS)
    log.close()
    states = LogReader(tmp_path / "log.mcap").select(STATE)
    expected = np.array(answers([program], data, states), dtype=float)
    rows = np.array(answers([*emulator, tmp_path / "c_host"], data, states), dtype=float)
    np.testing.assert_allclose(rows[:, 4:6], expected[:, 4:6], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(rows[:, 6:], expected[:, 6:])


def test_a_drive_by_readings_is_answered_to_the_bit(
    program: Path, data: Path, tmp_path: Path, native: NativeStep, circuit: Circuit,
    car: Car, weights: Weights, kinematic_artefact: Path,
) -> None:  # fmt: skip
    log = LogWriter(tmp_path / "log.mcap")
    loop = ClosedLoop(
        car, circuit.track, circuit.line, PredictiveController(native), log=log, sensors=odometry()
    )
    loop.drive(LAPS, max_time_s=6.0)
    log.close()
    reader = LogReader(tmp_path / "log.mcap")
    rows, sent = answers([program], data, reader.select(STATE)), reader.select(ACTUATION)
    assert len(rows) == len(sent) > 100
    for row, one in zip(rows, sent, strict=True):
        assert tuple(map(float, row[3:6])) == (one.decided_at_s, *one.u)


@pytest.fixture
def plant(program: Path, data: Path) -> Iterator[socket.socket]:
    """A socket that is connected to the program."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    line = [str(program), str(data), "--udp", str(port)]
    with subprocess.Popen(line, stderr=subprocess.PIPE, text=True) as host:
        assert host.stderr is not None
        assert "listening" in host.stderr.readline()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
            one.settimeout(20.0)
            one.connect(("127.0.0.1", port))
            yield one
        host.terminate()


def test_over_udp_states_are_answered_and_silence_ends_at_the_fallback(
    plant: socket.socket, circuit: Circuit
) -> None:
    x = tuple(map(float, circuit.start(v_mps=1.5)))
    state = messages.state(epoch=7, run=3, x=x)
    plant.send(b"no state")
    plant.send(line_of(state).encode())
    rows = [plant.recv(4096).split()]
    plant.settimeout(3.0)
    with contextlib.suppress(
        TimeoutError
    ):  # one state, then nothing: after a second it says no more
        while len(rows) < 1000:
            rows.append(plant.recv(4096).split())
    levels = [int(row[7]) for row in rows]
    assert {tuple(map(int, row[:3])) for row in rows} == {(7, 3, 0)}
    assert levels[0] == Level.SOLUTION
    assert levels == sorted(levels)
    assert levels[-1] >= Level.BRAKE
    assert len(rows) < 100


def test_over_udp_no_other_sender_ends_the_run_or_takes_its_answers(
    plant: socket.socket, circuit: Circuit
) -> None:
    x = tuple(map(float, circuit.start(v_mps=1.5)))
    state = messages.state(epoch=7, run=3, x=x)
    plant.send(line_of(state).encode())
    plant.recv(4096)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.connect(plant.getpeername())
        stranger.settimeout(0.2)
        for said in ("hello", line_of(replace(state, epoch=8, seq=1, final=True))):
            stranger.send(said.encode())
        with pytest.raises(TimeoutError):
            stranger.recv(4096)
    for _ in range(3):  # the inputs of the car that drives on blind come to it
        plant.recv(4096)
    plant.send(line_of(replace(state, seq=1, time_s=0.3)).encode())
    while plant.recv(4096).split()[2] != b"1":
        pass


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
    program: Path, data: Path, tmp_path: Path, change: tuple[str, str], fault: str
) -> None:
    shutil.copytree(data, tmp_path, dirs_exist_ok=True)
    file = tmp_path / SETTINGS_FILE
    file.write_text(file.read_text().replace(*change))
    done = subprocess.run(
        [program, tmp_path], input="", capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 1
    assert fault in done.stderr


@pytest.mark.check
def test_no_sanitizer_finds_anything_whatever_the_states_say(
    kinematic_artefact: Path, data: Path, circuit: Circuit, tmp_path: Path
) -> None:
    """Runs, plants, numbers and times in disorder, and numbers that are none; lockstep and not."""
    host = kinematic_artefact / HOST
    also = (f"-I{host}", str(host / "br_files.c"))
    source = SOURCE / "main.c"
    program = native_program(kinematic_artefact, source, tmp_path / "host", *SANITIZED, also=also)
    random, lines = np.random.default_rng(4), []
    odd = ("nan", "inf", "-inf", "1e300", "-1", "0", "9223372036854775807", "-9223372036854775808")
    x = tuple(map(float, circuit.start(v_mps=1.5)))
    readings = (
        reading("pose", 0.0, x=x[0], y=x[1], psi=x[2], deviation=(0.001, 0.001, 0.01)),
        reading("gyro", 0.02, omega=0.0, deviation=(0.02,)),
    )
    for k in range(300):
        delays = (0.0, 0.0, 0.02) * int(random.integers(0, 64))
        lockstep = bool(k // 100 % 2)
        sent = messages.state(
            k, time_s=0.02 * k, x=x, lockstep=lockstep, actuation_delays=delays, final=k % 90 == 89
        )
        if k % 2:
            sent = replace(sent, estimated=True, readings=readings * int(random.integers(0, 9)))
        words = line_of(sent).split()
        for _ in range(int(random.integers(0, 3)) if k % 3 == 0 else 0):
            at = int(random.choice([i for i, one in enumerate(words) if one != ";"]))
            if at > 15 and "." not in words[at]:
                continue  # a state or instrument that is none ends the program
            words[at] = str(random.choice(odd[4:] if at < 3 else odd))  # epoch, run, seq: whole
        lines.append(" ".join(words))
    done = subprocess.run(
        [program, data], input="\n".join(lines), capture_output=True, text=True, check=False,
        timeout=200,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-4000:]
    inputs = np.array([line.split()[4:6] for line in done.stdout.splitlines()], dtype=float)
    assert len(inputs) > 150
    assert np.isfinite(inputs).all()
