"""The controller FMU's own C: what Python has as well is the same, and no file makes it misread."""

import ctypes as ct
import re
import struct
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import codegen.fmu
from bayesrace.errors import InputError
from bayesrace.gp.weights import GpWeights
from bayesrace.manifest import read_manifest
from bayesrace.vehicles import get_car
from codegen.build import NATIVE as HEADERS
from codegen.compiler import find_compiler
from codegen.fmu import resources
from codegen.fmu.resources import PATH_FILE, WEIGHTS_FILE, path_resource, weights_resource
from controller import driver, path_table
from controller.fallback import Fallback, FallbackSettings
from controller.interface import StepOutput
from controller.native_step import StepStatus
from tests.conftest import Circuit
from tests.fmu_lockstep import Exported, exported_controllers  # noqa: F401 - a fixture
from tests.native_programs import PROGRAMS, SANITIZED, native_program

NATIVE = Path(codegen.fmu.__file__).parent / "native"
CAR = get_car("orca")
N = 20

_any = st.floats(allow_nan=True, allow_infinity=True)
_excess = [share * FallbackSettings().tolerance for share in (0.95, 1.05)]
_duty = st.one_of(st.floats(-0.12, 1.02), st.sampled_from([CAR.d_max + e for e in _excess]), _any)
_rate = st.one_of(
    st.floats(-5.1, 5.1), st.sampled_from([-CAR.delta_rate_max_radps - e for e in _excess]), _any
)


class _Settings(ct.Structure):
    _fields_ = [
        *((name, ct.c_double) for name in ("d_min", "d_max", "delta_rate_max_radps")),
        *((name, ct.c_double) for name in ("shifted_s", "tolerance", "brake_fade_mps")),
        ("recover_cycles", ct.c_int),
    ]


class _State(ct.Structure):
    _fields_ = [
        ("rows", ct.c_int),
        ("to_recover", ct.c_int),
        ("plan_s", ct.c_double),
        ("plan", ct.c_double * (2 * N)),
    ]


@pytest.mark.parametrize(
    ("macro", "values"),
    [
        ("BR_PATH_COLUMNS", {path_table.PATH_COLUMNS, resources.PATH_COLUMNS}),
        ("BR_PATH_CAPACITY", {path_table.CAPACITY, resources.PATH_CAPACITY}),
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
    of_steps = [one for one in StepStatus if one is not StepStatus.TIME_LIMIT]  # has no budget
    assert numbers == [*of_steps, driver.UNPREDICTABLE, driver.HALTED, driver.STEP_RAISED]


@pytest.fixture(scope="module")
def decide(
    tmp_path_factory: pytest.TempPathFactory, kinematic_artefact: Path
) -> Callable[..., int]:
    """fallback_decide, compiled alone."""
    library = tmp_path_factory.mktemp("fallback") / "fallback.so"
    source = NATIVE / "controller_fallback.c"
    line = [*find_compiler().command, "-shared", "-fPIC", "-O2", f"-I{kinematic_artefact}"]
    subprocess.run([*line, str(source), "-lm", "-o", str(library)], check=True, timeout=120)
    function = ct.CDLL(str(library)).fallback_decide
    function.argtypes = [ct.c_void_p] * 3 + [ct.c_double] * 2 + [ct.c_void_p]
    return function


_cycle = st.tuples(
    st.sampled_from(["good", "good", "bad", "nothing"]),
    st.tuples(_duty, _rate),
    st.tuples(_duty, _rate, st.booleans()),
    st.one_of(st.sampled_from([2.0, 0.1, 0.05, 0.0, -0.05]), _any),
    st.sampled_from([0.0, 0.002, 0.02, 0.05, 0.1, 1.0]),
)


@settings(max_examples=300, deadline=None)
@given(
    st.lists(_cycle, max_size=25),
    st.sampled_from([0.0, 0.02, 0.1]),
    st.integers(1, 4),
)
def test_the_fallback_in_c_does_what_the_one_in_python_does(
    decide: Callable[..., int],
    cycles: list[tuple[str, tuple[float, float], tuple[float, float, bool], float, float]],
    shifted_s: float,
    recover: int,
) -> None:
    chosen = FallbackSettings(shifted_s=shifted_s, recover_cycles=recover)
    python = Fallback(CAR, chosen)
    state = _State()
    numbers = _Settings(
        CAR.d_min, CAR.d_max, CAR.delta_rate_max_radps, chosen.shifted_s, chosen.tolerance,
        CAR.brake_fade_mps, chosen.recover_cycles,
    )  # fmt: skip
    time_s = 0.0
    for kind, first, (d, rate, spoil), vx, later_s in cycles:
        time_s += later_s
        plan = np.column_stack([np.linspace(0.2, 0.9, N), np.linspace(-4.0, 4.0, N)])
        plan[0] = first
        if spoil:
            plan[N // 2] = d, rate
        output = StepOutput(
            u=plan[0].copy(), status=0 if kind == "good" else 3, plan_u=plan, plan_step_s=0.02
        )
        expected = python.decide(None if kind == "nothing" else output, vx, time_s)
        u = np.full(2, np.nan)
        address = plan.ctypes.data if kind == "good" else None
        level = decide(ct.byref(state), ct.byref(numbers), address, vx, time_s, u.ctypes.data)
        assert (*u, level) == expected
        assert np.isfinite(u).all()


@pytest.fixture(scope="module")
def loader(tmp_path_factory: pytest.TempPathFactory, kinematic_artefact: Path) -> Path:
    """tests/native/fmu_resources.c with the step, under the address and undefined sanitizers."""
    out = tmp_path_factory.mktemp("loader") / "loader"
    ours = ("-Wall", f"-I{NATIVE}", str(NATIVE / "controller_resources.c"))
    source = PROGRAMS / "fmu_resources.c"
    return native_program(kinematic_artefact, source, out, *SANITIZED, also=ours)


@pytest.fixture(scope="module")
def good(circuit: Circuit, weights: GpWeights) -> tuple[bytes, bytes]:
    """Both files, small."""
    rows = circuit.table.rows[::16]
    identity = weights.discretisation
    path = path_resource(rows, circuit.table.spacing_m * 16)
    return path, weights_resource(weights, identity, 1024)


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


def test_what_was_written_is_loaded(
    loader: Path, tmp_path: Path, good: tuple[bytes, bytes], weights: GpWeights
) -> None:
    none = weights_resource(None, weights.discretisation, 1024)
    pairs = [good, (good[0], none)]
    assert load(loader, tmp_path, weights.discretisation, pairs) == ["0 ", "0 "]


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
    """Counts, kernels, lengths and numbers of somebody who knows the checksum; some are usable."""
    values = (0, 1, 3, 4, 1024, 1025, 2**31, 2**32 - 1, 0x7FF00000, 0x7FF80000)
    places = (32, 36, 288, 292, 300)
    changes = [(len(data), at, value) for at in places for value in values]
    for _ in range(80):
        end = int(random.choice([len(data), *random.integers(40, len(data), 3)]))
        at = int(random.choice([*range(288, 408, 4), *random.integers(32, end, 9)]))
        changes.append((end, min(at, end - 4), int(random.choice(values))))
    files = []
    for end, at, value in changes:
        one = bytearray(data[:end])
        one[at : at + 4] = struct.pack("<I", value)
        files.append(signed(bytes(one)))
    return files


def test_damaged_and_hostile_files_are_refused_and_never_read_beyond_their_end(
    loader: Path, tmp_path: Path, good: tuple[bytes, bytes], weights: GpWeights
) -> None:
    random = np.random.default_rng(0)
    path, gp = good
    bad_paths, bad_weights = damaged(path, random), damaged(gp, random)
    pairs = [(one, gp) for one in bad_paths] + [(path, one) for one in bad_weights]
    sure = len(pairs)
    pairs += [(one, gp) for one in hostile(path, random)]
    pairs += [(path, one) for one in hostile(gp, random)]
    said = load(loader, tmp_path, weights.discretisation, pairs)
    assert len(said) == len(pairs)
    assert all(line.startswith("-1 resources/") for line in said[:sure])
    assert all(line == "0 " or line.startswith("-1 resources/") for line in said[sure:])
    assert {line.split(":")[0] for line in said} >= {
        "-1 resources/path.bin is cut off or too long",
        "-1 resources/path.bin is damaged (checksum)",
        "-1 resources/path.bin has an impossible length",
        "-1 resources/weights.bin has an unknown kernel",
        "-1 resources/weights.bin has more training points than this controller has room for",
        "-1 resources/weights.bin GP weights are unusable",
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
        assert f"resources/{name} is missing" in done.stdout


def test_what_cannot_be_loaded_is_not_written(
    circuit: Circuit, weights: GpWeights, kinematic_artefact: Path
) -> None:
    identity = read_manifest(kinematic_artefact).discretisation
    with pytest.raises(InputError, match="learned for"):
        weights_resource(weights, "another", 1024)
    with pytest.raises(InputError, match="train with fewer points"):
        weights_resource(weights, identity, 100)
    with pytest.raises(InputError, match="path table"):
        path_resource(circuit.table.rows[:, :6], 0.005)
    with pytest.raises(InputError, match="not finite"):
        path_resource(circuit.table.rows * np.nan, 0.005)
