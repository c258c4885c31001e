"""An FMU in a process of its own: whatever it does there, the plant gets an answer or a reason."""

import contextlib
import math
import os
import tempfile
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from bayesrace.errors import InputError
from bayesrace.vehicles.parameters import get_car
from plant.fmu.faults import FmuFault
from plant.fmu.host import FmuHost
from plant.fmu.simulator import FmuSimulator, communication_step, open_fmu
from tests.faulty_fmu import STATES, Mode, faulty_fmu, faulty_library

Array = npt.NDArray[np.float64]

COMMANDS = ("d", "delta_rate")
CAR = get_car("orca")


@pytest.fixture(scope="module")
def libraries(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    folder = tmp_path_factory.mktemp("faulty")
    return {version: faulty_library(version, folder / f"{version}.so") for version in (2, 3)}


@pytest.fixture(scope="module")
def hosts(
    libraries: dict[int, Path], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[dict[int, FmuHost]]:
    folder, opened = tmp_path_factory.mktemp("fmu"), {}
    for version, library in libraries.items():
        path = faulty_fmu(library, folder / f"faulty{version}.fmu", version)
        opened[version] = FmuHost(path, COMMANDS, STATES, timeout_s=1.0, startup_s=4.0)
    yield opened
    for host in opened.values():
        host.close()


def worker_of(host: FmuHost) -> int:
    assert host._process is not None
    return host._process._popen.pid


def processes_of(session: int) -> list[str]:
    """What lives of a session: what an FMU has started, beside its own process (Linux)."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # gone meanwhile
            state, _, _, its_session = entry.read_text().rpartition(")")[2].split()[:4]
            if int(its_session) == session and state != "Z":
                found.append(entry.parent.name)
    return found


def assert_all_gone(session: int) -> None:
    """Killed processes end a moment later: those left behind are nobody's children to wait for."""
    deadline = time.monotonic() + 10.0
    while left := processes_of(session):
        assert time.monotonic() < deadline, f"still alive: {left}"
        time.sleep(0.01)


@pytest.mark.parametrize("version", [2, 3])
def test_it_drives_as_its_equations_say(version: int, hosts: dict[int, FmuHost]) -> None:
    host = hosts[version]
    begin = host.start({"x": 3.0, "vx": 2.0})
    assert begin == [3.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0]
    host.step((0.5, 1.0), 0.02)
    once = host.step((0.5, 1.0), 0.01, 2)
    assert host.time_s == pytest.approx(0.04, abs=1e-15)
    x, y, psi, vx, omega, delta = 3.0, 0.0, 0.0, 2.0, 0.0, 0.0
    for h in (0.02, 0.01, 0.01):
        x, y = x + h * vx * math.cos(psi), y + h * vx * math.sin(psi)
        omega = vx * delta / 0.062
        psi, vx, delta = psi + h * omega, vx + h * (3.5 - vx), delta + h
    assert once == pytest.approx([x, y, psi, vx, 0.0, omega, delta], abs=1e-15)


def test_a_row_of_inputs_for_each_step(hosts: dict[int, FmuHost]) -> None:
    host = hosts[2]
    host.start({})
    rows = host.step((0.0, 1.0, 0.0, 3.0), 0.01, 2)
    assert rows[6] == pytest.approx(0.04)


def test_time_does_not_drift(hosts: dict[int, FmuHost]) -> None:
    """The FMU refuses a step that does not begin where the last one ended (1e-12 s)."""
    host = hosts[2]
    host.start({})
    host.step((0.0, 0.0), 1e-3, 100_000)
    assert host.time_s == pytest.approx(100.0, abs=1e-13)


@pytest.mark.parametrize("version", [2, 3])
def test_types_go_in_and_out(version: int, libraries: dict[int, Path], tmp_path: Path) -> None:
    path = faulty_fmu(libraries[version], tmp_path / "f.fmu", version)
    inputs = (*COMMANDS, "gear", "light")
    outputs = ("vx", "gear_told", "light_told", "label_length", "instances")
    with FmuHost(path, inputs, outputs) as host:
        three = {"soft": 0.5, "small": 255, "rows": 7} if version == 3 else {}
        assert host.start({"label": "Zürich", "vx": 1, **three})[3] == len("Zürich".encode())
        low, high = (0, 255) if version == 3 else (-3, 300)
        for gear, told in ((3.4, 3.0), (-3.0, low), (300.0, high)):
            assert host.step((0.0, 0.0, gear, 1.0), 0.01)[1:3] == [told, 1.0]
        for name, value in (
            ("label", 3), ("vx", "fast"), ("vx", math.nan), ("gear", 2.5), ("gear", 2**70),
            ("light", 2), ("nothing", 1.0),
        ):  # fmt: skip
            with pytest.raises(InputError, match=name):
                host.start({name: value})


def test_instances_share_a_process_unless_the_fmu_cannot(
    libraries: dict[int, Path], tmp_path: Path
) -> None:
    for token, attributes in (("good", ""), ("once", 'canBeInstantiatedOnlyOncePerProcess="true"')):
        path = faulty_fmu(libraries[2], tmp_path / "f.fmu", guid=token, attributes=attributes)
        with FmuHost(path, COMMANDS, (*STATES, "instances")) as host:
            first = worker_of(host)
            told = [host.start({})[-1] for _ in range(2)]
            assert told == ([1.0, 2.0] if token == "good" else [1.0, 1.0])
            assert (worker_of(host) == first) == (token == "good")


FAULTS = {
    Mode.ABORT: r"crashed \(SIGABRT\); its last words: the engine is on fire",
    Mode.SEGFAULT: r"crashed \(SIGSEGV\)",
    Mode.EXIT: "ended its own process with exit code 3",
    Mode.SAY: "exit code 7; its last words: assertion failed: wheels == 4",
    Mode.HANG: "did not answer within 1 s",
    Mode.NOT_A_NUMBER: "gave vx = nan",
    Mode.FAIL: r"DoStep failed \(error\); its last words: a wheel came off",
    Mode.WORST: r"DoStep failed \(fatal\)",
    Mode.REFUSE: "discard",
    Mode.TERMINATE: "the FMU ended the simulation",
    Mode.CLOSE_ALL: "exit code|closed its connection",
    Mode.SCRIBBLE: "wrote to its process's connection|exit code",
    Mode.ORPHAN: r"crashed \(SIGABRT\)",
}


@pytest.mark.parametrize(
    ("version", "mode"),
    [(2, mode) for mode in FAULTS] + [(3, Mode.FAIL), (3, Mode.REFUSE), (3, Mode.TERMINATE)],
)
def test_a_fault_is_told_with_time_and_last_words(
    version: int, mode: Mode, hosts: dict[int, FmuHost]
) -> None:
    host = hosts[version]
    host.start({"mode": float(mode), "at_s": 0.04})
    host.step((0.1, 0.0), 0.02)
    worker = worker_of(host)
    with pytest.raises(FmuFault, match=FAULTS[mode]) as caught:
        host.step((0.1, 0.0), 0.02)
    assert "faulty" in str(caught.value)
    assert f"at t = {0.04 if mode is Mode.NOT_A_NUMBER else 0.02} s" in str(caught.value)
    assert not Path(f"/proc/{worker}").exists()
    assert_all_gone(session=worker)
    with pytest.raises(FmuFault, match="no new run"):
        host.step((0.1, 0.0), 0.02)
    host.start({})
    host.step((0.1, 0.0), 0.02)


@pytest.mark.parametrize(
    ("mode", "why"),
    [
        (Mode.INIT_FAILS, "this car has no wheels"),
        (Mode.INIT_HANGS, "did not answer"),
        (Mode.INIT_ABORTS, "SIGABRT"),
    ],
)
def test_a_failed_initialisation_is_told(mode: Mode, why: str, hosts: dict[int, FmuHost]) -> None:
    with pytest.raises(FmuFault, match=f"while it was initialised: .*{why}"):
        hosts[2].start({"mode": float(mode)})


@pytest.mark.parametrize("mode", [Mode.FLOOD_LOG, Mode.FLOOD_STDOUT])
def test_an_fmu_that_never_stops_talking_still_drives(
    mode: Mode, hosts: dict[int, FmuHost], capfd: pytest.CaptureFixture[str]
) -> None:
    host = hosts[2]
    host.timeout_s = 20.0
    host.start({"mode": float(mode), "at_s": 0.0})
    host.step((0.1, 0.0), 0.02)
    host.step((0.1, 0.0), 0.02)
    host.timeout_s = 1.0
    shown = capfd.readouterr().err
    assert "all is well" in shown
    assert len(shown) < 100_000
    assert "not shown" in shown


def test_a_step_that_returns_early_is_taken_up_again(hosts: dict[int, FmuHost]) -> None:
    host = hosts[3]
    host.start({"mode": float(Mode.EARLY), "vx": 1.0})
    host.step((0.0, 0.0), 0.02)
    assert host.time_s == pytest.approx(0.02)
    host.start({"mode": float(Mode.STUCK), "vx": 1.0})
    with pytest.raises(FmuFault, match="returned early"):
        host.step((0.0, 0.0), 0.02)


def test_a_worker_ended_from_outside_is_replaced(hosts: dict[int, FmuHost]) -> None:
    """Told to end, it takes the unpacked files with it."""
    host = hosts[2]
    host.start({})
    folder = host._folder
    os.kill(worker_of(host), 15)
    deadline = time.monotonic() + 10
    while folder.exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    with pytest.raises(FmuFault, match="exit code 143"):
        host.step((0.0, 0.0), 0.02)
    host.start({})
    host.step((0.0, 0.0), 0.02)


def test_nothing_is_left_after_closing(libraries: dict[int, Path], tmp_path: Path) -> None:
    host = FmuHost(faulty_fmu(libraries[2], tmp_path / "f.fmu"), COMMANDS, STATES)
    host.start({})
    worker, folder = worker_of(host), host._folder
    assert folder.is_dir()
    host.close()
    assert not folder.exists()
    assert not Path(f"/proc/{worker}").exists()


def rewritten(path: Path, out: Path, old: str, new: str) -> Path:
    """The FMU with a text of its description replaced."""
    with zipfile.ZipFile(path) as source, zipfile.ZipFile(out, "w") as target:
        for name in source.namelist():
            data = source.read(name)
            if name == "modelDescription.xml":
                assert old.encode() in data
                data = data.replace(old.encode(), new.encode())
            target.writestr(name, data)
    return out


def test_what_is_no_fmu_for_this_plant_is_refused(
    libraries: dict[int, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    good = faulty_fmu(libraries[2], tmp_path / "good.fmu")
    text = tmp_path / "text.fmu"
    text.write_text("no archive")
    data = bytearray(good.read_bytes())
    data[len(data) // 2] ^= 0xFF
    damaged, slipping, empty = (tmp_path / f"{n}.fmu" for n in ("damaged", "slipping", "empty"))
    damaged.write_bytes(data)
    slipping.write_bytes(good.read_bytes())
    with zipfile.ZipFile(slipping, "a") as archive:
        archive.writestr("../../evil.txt", "!")
    with zipfile.ZipFile(empty, "w") as archive:
        archive.writestr("readme", "")
    foreign = faulty_fmu(libraries[2], tmp_path / "foreign.fmu", platform="win64")
    exchange = rewritten(good, tmp_path / "me.fmu", "<CoSimulation", "<ModelExchange")
    old = rewritten(good, tmp_path / "old.fmu", 'fmiVersion="2.0"', 'fmiVersion="1.0"')
    torn = rewritten(good, tmp_path / "torn.fmu", "</ModelVariables>", "")
    lacking = faulty_fmu(text, tmp_path / "lacking.fmu")
    refusing = faulty_fmu(libraries[2], tmp_path / "refusing.fmu", guid="refuse")
    aborting = faulty_fmu(libraries[2], tmp_path / "aborting.fmu", guid="abort")
    for path, why in (
        (tmp_path / "none.fmu", "no FMU at"),
        (text, "no FMU, or a damaged one"),
        (damaged, "no FMU, or a damaged one"),
        (slipping, "leads out of its folder"),
        (empty, "without a modelDescription"),
        (foreign, "is for win64, not for this computer"),
        (exchange, "Model Exchange only"),
        (old, "FMI version 1.0"),
        (torn, "cannot be read"),
        (lacking, "while it was loaded"),
        (refusing, "gave no instance"),
        (aborting, "SIGABRT.*no licence"),
    ):
        with pytest.raises(InputError, match=why) as caught:
            FmuHost(path, COMMANDS, STATES)
        assert "\n" not in str(caught.value)
    assert not (tmp_path.parent / "evil.txt").exists()
    with pytest.raises(InputError, match="no variable 'throttle'"):
        FmuHost(good, ("throttle",), STATES)
    with pytest.raises(InputError, match="label is of type String"):
        FmuHost(good, ("label",), STATES)
    assert not list((tmp_path / "temporary").iterdir())


class OwnNames:
    """Wiring of an FMU with our own names, and a count of what it was asked."""

    inputs = COMMANDS
    outputs = STATES
    timeout_s = 1.0
    placed = False

    def __init__(self, *, angle: bool = False, step_s: float | None = None) -> None:
        self._angle = angle
        self.step_s = step_s

    def start_values(self, x0: list[float]) -> dict[str, float]:
        return dict(zip(STATES, x0, strict=True)) | {}

    def begin(self, outputs: list[float], x0: list[float]) -> Array:
        return np.array(outputs)

    def to_inputs(self, u: tuple[float, float], delta_rad: float, duration_s: float) -> list[float]:
        return [u[0], delta_rad + duration_s * u[1] if self._angle else u[1]]

    def state(self, outputs: list[float], u: object, duration_s: float) -> Array:
        return np.array(outputs)


def simulator(host: FmuHost, **settings: object) -> FmuSimulator:
    return FmuSimulator(CAR, host, OwnNames(**settings))  # type: ignore[arg-type]


def test_the_guard_stays_in_front_of_the_fmu(hosts: dict[int, FmuHost]) -> None:
    car = simulator(hosts[2])
    car.reset((0, 0, 0, 2.0, 0, 0, 0.3))
    car.step((5.0, 99.0))
    assert car.u_applied == pytest.approx((CAR.d_max, 0.05 / 0.02))
    car.step((math.nan, 0.0))
    assert car.u_applied == pytest.approx((CAR.d_min, 0.0), abs=0)
    assert car.guard.counters.as_dict() == {"rejected": 1, "clipped": 1, "braked": 1}
    assert (car.steps, car.time_s) == (2, 0.04)
    with pytest.raises(InputError, match="steering angle"):
        car.reset((0, 0, 0, 0, 0, 0, 0.5))


def test_a_command_that_changes_within_the_period_acts_from_there(
    hosts: dict[int, FmuHost],
) -> None:
    """One step of any size, steps of 1 ms, and steering angles that follow the rate."""
    deltas = []
    for settings in ({}, {"step_s": 1e-3}, {"angle": True}):
        car = simulator(hosts[2], **settings)
        car.reset((0, 0, 0, 1.0, 0, 0, 0.01))
        car.step_switched([(5, (0.5, 2.0)), (0, None), (15, None)])
        assert car.u_applied == pytest.approx(((5 * 0.5 + 15 * CAR.d_min) / 20, 0.5))
        deltas.append(car.x[6])
    assert deltas[:2] == pytest.approx([0.02, 0.02])
    # This FMU integrates its second input: the sum of the angles that it was told.
    first = [0.01 + 0.002 * k for k in range(1, 6)]
    held = 0.01 + 1e-3 * sum(first)
    assert deltas[2] == pytest.approx(held + 0.015 * held)
    with pytest.raises(ValueError, match="20 substeps"):
        car.step_switched([(7, None)])


def test_after_a_fault_the_last_sample_stands(hosts: dict[int, FmuHost]) -> None:
    car = simulator(hosts[2])
    car.reset((0, 0, 0, 1.0, 0, 0, 0))
    car.step((0.5, 1.0))
    before, applied = car.x.copy(), car.u_applied
    os.kill(worker_of(hosts[2]), 9)
    with pytest.raises(FmuFault, match="SIGKILL"):
        car.step_switched([(5, None), (15, (0.1, 0.0))])
    np.testing.assert_array_equal(car.x, before)
    assert (car.steps, car.u_applied) == (1, applied)
    car.reset((0, 0, 0, 1.0, 0, 0, 0))
    hosts[2].start({"mode": float(Mode.HUGE_VALUE), "at_s": 0.0})
    with pytest.raises(FmuFault, match=r"vx = 1e\+09"):
        car.step((0.5, 1.0))


def test_the_communication_step(libraries: dict[int, Path], tmp_path: Path) -> None:
    def step(attributes: str, wanted_s: float | None = None, version: int = 2) -> float:
        from plant.fmu.package import read_description

        path = faulty_fmu(libraries[2], tmp_path / "s.fmu", version, attributes=attributes)
        return communication_step(read_description(path), wanted_s, 0.02)

    any_size = 'canHandleVariableCommunicationStepSize="true"'
    assert step(any_size) == 1e-3
    assert step(any_size, 0.005) == 0.005
    assert step("") == 0.02
    assert step('fixedInternalStepSize="0.004"', version=3) == 0.004
    assert step('fixedInternalStepSize="0.003"', version=3) == 0.02
    assert step(any_size + ' fixedInternalStepSize="0.0025"', version=3) == 0.0025
    for wrong in (0.003, 0.04, 0.0, math.nan):
        with pytest.raises(InputError, match="does not divide the plant's period"):
            step("", wrong)


def test_our_own_names_need_no_map(libraries: dict[int, Path], tmp_path: Path) -> None:
    path = faulty_fmu(libraries[3], tmp_path / "own.fmu", 3)
    with open_fmu(CAR, path) as car:
        car.reset((1.0, 2.0, 0.5, 1.0, 0, 0, 0))
        np.testing.assert_array_equal(car.x, (1.0, 2.0, 0.5, 1.0, 0, 0, 0))
        car.step((0.5, 1.0))
        assert car.x[6] == pytest.approx(0.02)
