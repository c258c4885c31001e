"""An FMU in a process of its own: whatever it does there, the plant gets an answer or a reason."""

import contextlib
import errno
import gc
import math
import os
import re
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from bayesrace.errors import InputError
from bayesrace.plant.fmu.host import FmuHost
from bayesrace.plant.fmu.simulator import open_fmu
from bayesrace.plant.vehicle import FmuFault
from bayesrace.vehicles import get_car
from tests.faulty_fmu import (
    PATIENCE_S,
    STATES,
    Mode,
    faulty_fmu,
    faulty_host,
    faulty_library,
    folder_of,
    process_of,
)
from tests.programs import until

pytestmark = pytest.mark.wall_clock


@pytest.fixture(scope="module")
def libraries() -> dict[int, Path]:
    return {version: faulty_library(version) for version in (2, 3)}


@pytest.fixture(scope="module")
def hosts(
    libraries: dict[int, Path], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[dict[int, FmuHost]]:
    folder, opened = tmp_path_factory.mktemp("fmu"), {}
    for version, library in libraries.items():
        path = faulty_fmu(library, folder / f"faulty{version}.fmu", version)
        opened[version] = faulty_host(path)
    yield opened
    for host in opened.values():
        host.close()


def processes_of(session: int) -> list[str]:
    """What lives of a session: what an FMU has started, beside its own process (Linux)."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError, ValueError):  # gone meanwhile
            state, _, _, its_session = entry.read_text().rpartition(")")[2].split()[:4]
            if int(its_session) == session and state != "Z":
                found.append(entry.parent.name)
    return found


def assert_all_gone(session: int) -> None:
    """Killed processes end a moment later, and those left behind are not ours to wait for."""
    until(lambda: not processes_of(session), f"the end of session {session}", PATIENCE_S)


def test_a_process_that_does_not_start_is_a_fault_and_leaves_nothing_open(
    libraries: dict[int, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = faulty_fmu(libraries[3], tmp_path / "faulty.fmu", 3)

    def fail(*_: object, **__: object) -> None:
        raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr("bayesrace.plant.fmu.host.Popen", fail)
    descriptors = Path("/proc/self/fd")
    before = set(descriptors.iterdir())
    with pytest.raises(InputError, match="its process does not start: Resource temporarily"):
        faulty_host(path)
    gc.collect()
    until(lambda: set(descriptors.iterdir()) == before, "all is closed", PATIENCE_S)
    assert list(tmp_path.iterdir()) == [path]


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


def test_more_inputs_than_a_message_holds_are_a_fault(hosts: dict[int, FmuHost]) -> None:
    host = hosts[2]
    host.start({})
    with pytest.raises(FmuFault, match="a longer step_s"):
        host.step((0.0, 1.0) * 10_000, 1e-6, 10_000)


def test_time_does_not_drift(hosts: dict[int, FmuHost]) -> None:
    """The FMU refuses a step that does not begin where the last one ended (1e-12 s)."""
    host = hosts[2]
    host.start({})
    host.step((0.0, 0.0), 1e-3, 100_000)
    assert host.time_s == pytest.approx(100.0, abs=1e-13)


@pytest.mark.parametrize("version", [2, 3])
def test_values_of_any_type_are_set_before_the_start(
    version: int, libraries: dict[int, Path], tmp_path: Path
) -> None:
    path = faulty_fmu(libraries[version], tmp_path / "f.fmu", version)
    with closing(faulty_host(path, ("vx", "gear_read", "light_read", "label_length"))) as host:
        three = {"soft": 0.5, "small": 255} if version == 3 else {}
        host.start({"label": "Zürich", "vx": 1, "gear": 3, "light": True, **three})
        assert host.step((0.0, 0.0), 0.01)[1:] == [3.0, 1.0, len("Zürich".encode())]


def test_instances_share_a_process_unless_the_fmu_cannot(
    libraries: dict[int, Path], tmp_path: Path
) -> None:
    for token, attributes in (("good", ""), ("once", 'canBeInstantiatedOnlyOncePerProcess="true"')):
        path = faulty_fmu(libraries[2], tmp_path / "f.fmu", guid=token, attributes=attributes)
        with closing(faulty_host(path, (*STATES, "instances"))) as host:
            first = process_of(host)
            counted = [host.start({})[-1] for _ in range(2)]
            assert counted == ([1.0, 2.0] if token == "good" else [1.0, 1.0])
            assert (process_of(host) is first) == (token == "good")


TIMEOUTS_S = {Mode.HANG: 0.2, Mode.ORPHAN: 2.0}
"""Of the step that goes wrong, where that takes the time to find out (ORPHAN: enough to abort)."""

FAULTS = {
    Mode.ABORT: r"crashed \(SIGABRT\); its last message: the engine is on fire",
    Mode.SEGFAULT: r"crashed \(SIGSEGV\)",
    Mode.EXIT: "ended its own process with exit code 3",
    Mode.SAY: "exit code 7; its last message: assertion failed: wheels == 4",
    Mode.HANG: "did not answer within 0.2 s",
    Mode.NOT_A_NUMBER: "gave vx = nan",
    Mode.FAIL: r"DoStep failed \(error\); its last message: a wheel came off",
    Mode.WORST: r"DoStep failed \(fatal\)",
    Mode.REFUSE: r"DoStep failed \(discard\)",
    Mode.TERMINATE: "the FMU ended the simulation",
    Mode.CLOSE_ALL: "exit code|closed its connection|SIGKILL",
    Mode.SCRIBBLE: "wrote to its process's connection|SIGKILL",
    Mode.ORPHAN: r"crashed \(SIGABRT\)",
}


@pytest.mark.parametrize(
    ("version", "mode"),
    [(2, mode) for mode in FAULTS] + [(3, Mode.FAIL), (3, Mode.REFUSE), (3, Mode.TERMINATE)],
)
def test_a_fault_is_reported_with_time_and_last_message(
    version: int, mode: Mode, hosts: dict[int, FmuHost], monkeypatch: pytest.MonkeyPatch
) -> None:
    host = hosts[version]
    host.start({"mode": float(mode), "at_s": 0.04})
    host.step((0.1, 0.0), 0.02)
    worker = process_of(host)
    monkeypatch.setattr(host, "timeout_s", TIMEOUTS_S.get(mode, PATIENCE_S))
    with pytest.raises(FmuFault, match=FAULTS[mode]) as caught:
        host.step((0.1, 0.0), 0.02)
    assert "faulty" in str(caught.value)
    assert "at t = 0.02 s" in str(caught.value)
    assert worker.returncode is not None
    assert_all_gone(session=worker.pid)
    with pytest.raises(FmuFault, match="no new run"):
        host.step((0.1, 0.0), 0.02)
    monkeypatch.undo()
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
def test_a_failed_initialisation_is_reported(
    mode: Mode, why: str, hosts: dict[int, FmuHost], monkeypatch: pytest.MonkeyPatch
) -> None:
    host = hosts[2]
    host.start({})
    monkeypatch.setattr(host, "startup_s", 0.2 if mode is Mode.INIT_HANGS else PATIENCE_S)
    with pytest.raises(FmuFault, match=f"while it was initialised: .*{why}"):
        host.start({"mode": float(mode)})


@pytest.mark.parametrize("mode", [Mode.FLOOD_LOG, Mode.FLOOD_STDOUT])
def test_an_fmu_that_never_stops_talking_still_drives(
    mode: Mode, hosts: dict[int, FmuHost], capfd: pytest.CaptureFixture[str]
) -> None:
    host = hosts[2]
    host.start({"mode": float(mode), "at_s": 0.0})
    host.step((0.1, 0.0), 0.02)
    host.step((0.1, 0.0), 0.02)
    shown: list[str] = []

    def read() -> str:
        shown.append(capfd.readouterr().err)
        return "".join(shown)

    until(lambda: "not shown" in read(), "the limit", PATIENCE_S)
    assert "all is well" in read()
    assert len(read()) < 100_000


def test_a_step_that_returns_early_is_a_fault(hosts: dict[int, FmuHost]) -> None:
    host = hosts[3]
    host.start({"mode": float(Mode.EARLY), "vx": 1.0})
    with pytest.raises(FmuFault, match=r"returned early at 0\.01 s"):
        host.step((0.0, 0.0), 0.02)


def test_a_worker_ended_from_outside_is_replaced(hosts: dict[int, FmuHost]) -> None:
    host = hosts[2]
    host.start({})
    folder = folder_of(process_of(host))
    process_of(host).terminate()
    with pytest.raises(FmuFault, match="SIGTERM"):
        host.step((0.0, 0.0), 0.02)
    assert not folder.exists()
    host.start({})
    host.step((0.0, 0.0), 0.02)


def test_nothing_is_left_after_closing(libraries: dict[int, Path], tmp_path: Path) -> None:
    environment = dict(os.environ)
    host = faulty_host(faulty_fmu(libraries[2], tmp_path / "f.fmu"))
    host.start({})
    process, folder = process_of(host), folder_of(process_of(host))
    assert folder.is_dir()
    host.close()
    assert not folder.exists()
    assert dict(os.environ) == environment
    assert process.returncode == 0


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
    encrypted = tmp_path / "encrypted.fmu"
    headers = re.compile(rb"(PK\x01\x02.{4}).", re.DOTALL)  # flags are the ninth byte
    encrypted.write_bytes(headers.sub(lambda m: m[1] + b"\x01", good.read_bytes()))
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
        (encrypted, "is encrypted"),
        (slipping, "leads out of its folder"),
        (empty, "without a modelDescription"),
        (foreign, "is for win64, not for this computer"),
        (exchange, "export it for Co-Simulation"),
        (old, "FMI version 1.0"),
        (torn, "cannot be read"),
        (lacking, "while it was loaded"),
        (refusing, "Failed to instantiate"),
        (aborting, "SIGABRT.*no licence"),
    ):
        with pytest.raises(InputError, match=why) as caught, open_fmu(get_car("orca"), path):
            pass
        assert "\n" not in str(caught.value)
    monkeypatch.setattr("bayesrace.plant.fmu.inspection._MOST_BYTES", 1000)
    with pytest.raises(InputError, match="claims to unpack to"):
        faulty_host(good)
    assert not (tmp_path.parent / "evil.txt").exists()
    assert not list((tmp_path / "temporary").iterdir())
