"""The controller FMU's own C: sizes and statuses are the step's, and no file makes it misread."""

import re
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest

from bayesrace.codegen import host_files
from bayesrace.codegen.build import HOST
from bayesrace.codegen.build import NATIVE as HEADERS
from bayesrace.codegen.host_files import PATH_FILE, WEIGHTS_FILE, path_file, weights_file
from bayesrace.controller import native_step
from bayesrace.controller.native_step import Status
from bayesrace.errors import InputError
from bayesrace.gp.weights import Weights
from bayesrace.manifest import read_manifest
from tests.conftest import Circuit
from tests.fmu_lockstep import Exported, exported_controllers  # noqa: F401 - a fixture
from tests.native_programs import PROGRAMS, SANITIZED, native_program


@pytest.mark.parametrize(
    ("macro", "values"),
    [
        ("BR_PATH_COLUMNS", {native_step.PATH_COLUMNS, host_files.PATH_COLUMNS}),
    ],
)
def test_sizes_and_limits_of_the_native_step_are_those_that_python_states(
    macro: str, values: set[float]
) -> None:
    found = re.search(rf"#define {macro} (\S+)", (HEADERS / "bayesrace_mpc.h").read_text())
    assert found is not None
    assert {float(found[1])} == values


def test_statuses_mean_what_they_mean_in_the_controller_process(exported: Exported) -> None:
    [status] = [one for one in exported.define().variables if one.name == "status"]
    numbers = [int(number) for number in re.findall(r"\d+", status.description)]
    of_steps = [one for one in Status if one < Status.TIME_LIMIT]  # has no budget
    without = [Status.DOUBTED, Status.UNPREDICTABLE, Status.HALTED, Status.NO_STATE]
    assert numbers == [*of_steps, *without, Status.STEP_FAILED]


@pytest.fixture(scope="module")
def loader(tmp_path_factory: pytest.TempPathFactory, kinematic_artefact: Path) -> Path:
    """tests/native/host_files.c with the step, under the address and undefined sanitizers."""
    out = tmp_path_factory.mktemp("loader") / "loader"
    host = kinematic_artefact / HOST
    ours = ("-Wall", f"-I{host}", str(host / "br_files.c"))
    source = PROGRAMS / "host_files.c"
    return native_program(kinematic_artefact, source, out, *SANITIZED, also=ours)


@pytest.fixture(scope="module")
def good(circuit: Circuit, weights: Weights, kinematic_artefact: Path) -> tuple[bytes, bytes]:
    """Both files, small."""
    rows = circuit.table.rows[::16]
    identity = weights.discretisation
    path = path_file(rows, circuit.table.spacing_m * 16, read_manifest(kinematic_artefact))
    return path, weights_file(weights, identity, 1024)


def load(loader: Path, folder: Path, identity: str, pairs: list[tuple[bytes, bytes]]) -> list[str]:
    """What the loader says of each pair of files."""
    names = []
    for i, (path, weights) in enumerate(pairs):
        own = folder / f"{i}"
        own.mkdir()
        (own / PATH_FILE).write_bytes(path)
        (own / WEIGHTS_FILE).write_bytes(weights)
        names.append(str(own))
    line = [str(loader), identity, *names]
    done = subprocess.run(line, capture_output=True, text=True, check=False, timeout=200)
    assert done.returncode == 0, done.stderr[-4000:]
    return done.stdout.splitlines()


def signed(data: bytes) -> bytes:
    """The same file with length and checksum that fit what is in it now."""
    body = data[32:]
    value = 14695981039346656037
    for byte in body:
        value = (value ^ byte) * 1099511628211 & 0xFFFFFFFFFFFFFFFF
    return data[:12] + struct.pack("<IQ", len(body), value) + data[24:]


def damaged(data: bytes, random: np.random.Generator) -> list[bytes]:
    """Cut anywhere, too long, empty, or with one bit changed: all of it is noticed."""
    cuts = [*range(0, 40, 3), *random.integers(40, len(data), 20), len(data) - 1]
    changed = [data[:cut] for cut in cuts] + [data + b"\0", data + bytes(1 << 23), b""]
    for at in (*range(24), *random.integers(32, len(data), 20)):
        one = bytearray(data)
        one[at] ^= 1 << int(random.integers(8))
        changed.append(bytes(one))
    return changed


def hostile(data: bytes, random: np.random.Generator) -> list[bytes]:
    """Counts, kernels, lengths and numbers with a checksum that fits; some are usable."""
    values = (0, 1, 3, 4, 1024, 1025, 2**31, 2**32 - 1, 0x7FF00000, 0x7FF80000)
    outputs = 32 + 256 + 801  # where they begin in a file of weights
    places = (32, 36, outputs, outputs + 4, outputs + 12)
    changes = [(len(data), at, value) for at in places for value in values]
    for _ in range(80):
        end = int(random.choice([len(data), *random.integers(40, len(data), 3)]))
        at = int(random.choice([*range(outputs, outputs + 120, 4), *random.integers(32, end, 9)]))
        changes.append((end, min(at, end - 4), int(random.choice(values))))
    files = []
    for end, at, value in changes:
        one = bytearray(data[:end])
        one[at : at + 4] = struct.pack("<I", value)
        files.append(signed(bytes(one)))
    return files


def test_files_are_loaded_or_refused_and_never_read_beyond_their_end(
    loader: Path, tmp_path: Path, good: tuple[bytes, bytes], weights: Weights
) -> None:
    random = np.random.default_rng(0)
    path, gp = good
    bad_paths, bad_weights = damaged(path, random), damaged(gp, random)
    pairs = [(one, gp) for one in bad_paths] + [(path, one) for one in bad_weights]
    sure = len(pairs)
    pairs += [(one, gp) for one in hostile(path, random)]
    pairs += [(path, one) for one in hostile(gp, random)]
    loaded, *said = load(loader, tmp_path, weights.discretisation, [good, *pairs])
    assert loaded == "0 "
    assert len(said) == len(pairs)
    assert all(line.startswith("-1 ") for line in said[:sure])
    assert all(line == "0 " or line.startswith("-1 ") for line in said[sure:])
    assert {line.split(":")[0] for line in said} >= {
        "-1 path.bin is cut off or too long",
        "-1 path.bin is damaged (checksum)",
        "-1 path.bin has an impossible length",
        "-1 path.bin is longer than this controller has room for",
        "-1 weights.bin has an unknown kernel",
        "-1 weights.bin has more training points than this controller has room for",
        "-1 weights.bin GP weights are unusable",
    }


def test_missing_files_and_weights_of_another_model_are_named(
    loader: Path, tmp_path: Path, good: tuple[bytes, bytes]
) -> None:
    assert "learned for another model" in load(loader, tmp_path, "another", [good])[0]
    (tmp_path / "0" / WEIGHTS_FILE).unlink()
    for name in (WEIGHTS_FILE, PATH_FILE):
        (tmp_path / "0" / name).unlink(missing_ok=True)
        line = [str(loader), "another", str(tmp_path / "0")]
        done = subprocess.run(line, capture_output=True, text=True, check=True, timeout=60)
        assert f"{name} is missing" in done.stdout


def test_what_cannot_be_loaded_is_not_written(
    circuit: Circuit, weights: Weights, kinematic_artefact: Path
) -> None:
    manifest = read_manifest(kinematic_artefact)
    identity = manifest.discretisation
    with pytest.raises(InputError, match="learned for"):
        weights_file(weights, "another", 1024)
    with pytest.raises(InputError, match="train with fewer points"):
        weights_file(weights, identity, 100)
    with pytest.raises(InputError, match="path table"):
        path_file(circuit.table.rows[:, :6], 0.005, manifest)
    with pytest.raises(InputError, match="not finite"):
        path_file(circuit.table.rows * np.nan, 0.005, manifest)
