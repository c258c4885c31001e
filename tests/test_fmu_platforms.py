"""Binaries of an FMU: rebuilt from its own sources, and for processors and systems not this one."""

import html
import os
import re
import shlex
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from fmpy import extract

from bayesrace.codegen.build import build
from bayesrace.codegen.compiler import find_compiler
from bayesrace.codegen.fmu import car_fmu, pack
from bayesrace.codegen.fmu.build import FLAGS
from bayesrace.codegen.platforms import get_platform, host_platform
from bayesrace.codegen.settings import BuildSettings
from bayesrace.errors import InputError
from bayesrace.vehicles import Car
from tests.car_fmu import Version, built_in, commands, driven, packed_car, slave, unpacked_car
from tests.fmu_lockstep import Exported, exported_controllers  # noqa: F401 - a fixture
from tests.fmu_master import Slave

HERE = Path(__file__).parent

WINDOWS = "x86_64-windows"
EVERYWHERE = ("x86_64-linux", "aarch64-linux", WINDOWS)

ARM_LIBRARIES = Path("/usr/aarch64-linux-gnu")
"""Where Debian's libc6-arm64-cross is."""

linux = pytest.mark.skipif(sys.platform != "linux", reason="the line in the archive is for Linux")


def stated_line(unpacked: Path) -> list[str]:
    """The command that the FMU states, with the compiler that was found here for cc."""
    page = (unpacked / "documentation" / "index.html").read_text()
    (line,) = re.findall(r"<pre>cc (.*)</pre>", page)
    return [*find_compiler().command, *shlex.split(html.unescape(line))]


@linux
@pytest.mark.parametrize("version", [2, 3])
def test_the_sources_rebuild_the_binary_with_the_line_they_state(
    version: Version, tmp_path: Path
) -> None:
    inputs = commands(200)
    one = slave(version)
    one.initialise()
    expected = driven(one, inputs)
    one.close()
    folder = tmp_path / "fmu"
    extract(str(packed_car(version)), unzipdir=str(folder))
    (binary,) = (folder / "binaries").glob("*/*")
    binary.unlink()
    sources = folder / "sources"
    subprocess.run(stated_line(folder), cwd=sources, check=True)
    shutil.move(sources / binary.name, binary)
    again = Slave(packed_car(version), folder)
    again.initialise()
    np.testing.assert_array_equal(driven(again, inputs), expected)
    again.close()


def test_another_platform_needs_ziglang(
    car: Car, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("bayesrace.codegen.platforms.find_spec", lambda name: None)
    host = host_platform().name
    other = "aarch64-linux" if host == "x86_64-linux" else "x86_64-linux"
    with pytest.raises(InputError, match=f"{other}.*pip install ziglang"):
        pack(car_fmu(car), tmp_path / "x.fmu", [host, other])
    assert not (tmp_path / "x.fmu").exists()


def elf_exports(data: bytes, folder: Path) -> set[str]:
    """Names that a Linux library offers."""
    if shutil.which("readelf") is None:
        pytest.skip("readelf is not installed")
    path = folder / "library.so"
    path.write_bytes(data)
    line = ["readelf", "--dyn-syms", "--wide", str(path)]
    text = subprocess.run(line, capture_output=True, text=True, check=True).stdout
    rows = [row.split() for row in text.splitlines()]
    return {row[7] for row in rows if len(row) == 8 and row[4] == "GLOBAL" and row[6] != "UND"}


@pytest.fixture(scope="module", params=[2, 3])
def everywhere(ziglang: None, request: pytest.FixtureRequest) -> Path:
    """The car's FMU with binaries for all platforms that can be built for, unpacked."""
    return unpacked_car(request.param, platforms=EVERYWHERE)


def binary(unpacked: Path, name: str) -> Path:
    """The only file of the platform's folder."""
    (found,) = (unpacked / "binaries" / get_platform(name).folder(int(unpacked.name))).iterdir()
    return found


@pytest.mark.check
@pytest.mark.timeout(1500)  # ziglang builds a C library per target the first time
def test_cross_compiled_binaries_are_for_their_platform_and_offer_fmi(
    everywhere: Path, tmp_path: Path
) -> None:
    machines = {"x86_64-linux": 62, "aarch64-linux": 183}
    offered = {}
    for name, machine in machines.items():
        data = binary(everywhere, name).read_bytes()
        assert data[:5] == b"\x7fELF\x02"
        assert struct.unpack_from("<H", data, 18) == (machine,)
        offered[name] = elf_exports(data, tmp_path)
    names = offered["x86_64-linux"]
    assert f"fmi{everywhere.name}GetVersion" in names
    assert len(names) > 30
    assert all(name.startswith(f"fmi{everywhere.name}") for name in names)
    assert offered["aarch64-linux"] == names
    data = binary(everywhere, WINDOWS).read_bytes()
    (header,) = struct.unpack_from("<I", data, 0x3C)
    assert data[header : header + 4] == b"PE\0\0"
    assert struct.unpack_from("<H", data, header + 4) == (0x8664,)
    (directory,) = struct.unpack_from("<I", data, header + 24 + 112)
    assert directory  # it has a table of exports, which names them
    assert all(f"\0{name}\0".encode() in data for name in names)


def emulator(platform: str) -> list[str]:
    """What precedes the name of a program for this platform to run it here."""
    commands = {"aarch64-linux": ("qemu-aarch64", "-L", str(ARM_LIBRARIES)), WINDOWS: ("wine",)}
    command, *arguments = commands[platform]
    if platform != WINDOWS and not (ARM_LIBRARIES / "lib").is_dir():
        pytest.skip("libc6-arm64-cross is not installed")
    if shutil.which(command) is None:
        pytest.skip(f"{command} is not installed")
    return [command, *arguments]


def drive_program(platform: str, sources: Path, program: Path, *flags: str) -> None:
    """tests/native/fmi3_drive.c for a platform."""
    target = get_platform(platform).zig
    assert target is not None
    # The FMUs' own flags: ziglang builds the target's C library for each combination of some.
    line = [sys.executable, "-m", "ziglang", "cc", "-target", target, "-s", "-g0", *FLAGS]
    line += [
        f"-I{sources}",
        *flags,
        str(HERE / "native" / "fmi3_drive.c"),
        *([] if platform == WINDOWS else ["-ldl"]),
    ]
    subprocess.run([*line, "-o", str(program)], check=True)


@linux
@pytest.mark.check
@pytest.mark.timeout(1500)
@pytest.mark.parametrize("everywhere", [3], indirect=True)
@pytest.mark.parametrize("platform", ["aarch64-linux", WINDOWS])
def test_on_other_platforms_the_same_binary_drives_alike(
    platform: str, everywhere: Path, car: Car, tmp_path: Path
) -> None:
    """But for the C library, whose sine may differ in its last bit."""
    if host_platform().name != "x86_64-linux":
        pytest.skip("the emulators are for x86_64-linux")
    under = emulator(platform)
    program = tmp_path / "drive.exe"
    drive_program(platform, everywhere / "sources", program)
    inputs = np.array(commands(400))
    quiet = {"WINEDEBUG": "-all", "WINEDLLOVERRIDES": "mscoree,mshtml="}
    done = subprocess.run(
        [*under, str(program), str(binary(everywhere, platform))],
        input=inputs.tobytes(),
        capture_output=True,
        check=True,
        env={**os.environ, "WINEPREFIX": str(tmp_path / "wine"), **quiet},
    )
    states = np.frombuffer(done.stdout).reshape(-1, 7)
    expected = built_in(car, [(d, rate) for d, rate in inputs])[:, :7]
    np.testing.assert_allclose(states, expected, rtol=0, atol=1e-12)


@linux
@pytest.mark.check
@pytest.mark.timeout(1500)
def test_the_controller_for_another_processor_drives_alike(
    exported: Exported, daqp: Path, ziglang: None, tmp_path: Path
) -> None:
    """Of an artefact that has DAQP's C; here the same states are answered with CasADi's DAQP."""
    under = emulator("aarch64-linux")
    artefact, _ = build(BuildSettings(), daqp=daqp)
    fmu = pack(exported.define(artefact=artefact), tmp_path / "c.fmu", ["aarch64-linux"])
    unpacked = tmp_path / "3"
    extract(str(fmu), unzipdir=str(unpacked))
    program = tmp_path / "drive"
    drive_program("aarch64-linux", unpacked / "sources", program, "-DCONTROLLER")
    run = exported.lockstep().run(exported.circuit.start(v_mps=0.1), 200)
    done = subprocess.run(
        [*under, program, binary(unpacked, "aarch64-linux"), unpacked / "resources"],
        input=np.array(run.x).tobytes(), capture_output=True, check=True,
    )  # fmt: skip
    answered = np.frombuffer(done.stdout).reshape(-1, 2)
    np.testing.assert_allclose(answered, np.array(run.u), rtol=0, atol=1e-9)
