"""Any bytes as calls of the native interface: no crash, no sanitizer finding, promises kept.

tests/native/fuzz.c says what is promised. A failing input is left in the test's folder:
``fuzz --replay FILE``.
"""

import shutil
import subprocess
from pathlib import Path
from typing import Final

import pytest

from bayesrace.codegen.build import build, casadi_includes
from bayesrace.codegen.settings import BuildSettings

pytestmark = pytest.mark.check

SOURCES: Final = Path(__file__).parent / "native"
SANITIZERS: Final = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
FLAGS: Final = ("-std=gnu11", "-O2", "-g")
STRICT: Final = ("-Wall", "-Wextra", "-Werror", "-Wno-unused-parameter", "-Wno-unused-function")
COVERAGE: Final = "-fsanitize-coverage=trace-pc"
SEED: Final = "1"
SEEDS: Final = tuple(map(str, range(1, 13)))
"""Which of them finds a fault changes with the code that guides the driver."""

Word = str | Path


@pytest.fixture(scope="module")
def small() -> Path:
    """A short horizon and few points: the same code, more inputs a second."""
    return build(BuildSettings(horizon=6, gp_capacity=16))[0]


def compiler(name: str) -> str:
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"{name} is not installed")
    return found


def ran(line: list[Word], timeout_s: float = 400) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(line, capture_output=True, text=True, check=False, timeout=timeout_s)


def made(line: list[Word]) -> None:
    done = ran(line)
    if "cannot find -lasan" in done.stderr or "cannot find -lubsan" in done.stderr:
        pytest.skip("gcc's sanitizer libraries are not installed")
    assert done.returncode == 0, done.stderr[-4000:]


def compiled(source: Path, artefact: Path, out: Path, *flags: str) -> Path:
    """Object file of one source."""
    line: list[Word] = [compiler("gcc"), *FLAGS, *STRICT, *SANITIZERS, *flags, f"-I{artefact}"]
    made([*line, "-isystem", casadi_includes()[0], "-c", source, "-o", out])
    return out


def linked(objects: dict[str, Path], program: Path) -> Path:
    """The fuzz target with its own driver."""
    daqp = casadi_includes()[1]
    made([compiler("gcc"), *SANITIZERS, *objects.values(), daqp, "-lm", "-o", program])
    return program


def objects_of(artefact: Path, folder: Path) -> dict[str, Path]:
    """Object files by name, those under test with the coverage that guides the driver."""
    sources = [*sorted(artefact.glob("*.c")), SOURCES / "fuzz.c"]
    out = {s.stem: compiled(s, artefact, folder / f"{s.stem}.o", COVERAGE) for s in sources}
    main = SOURCES / "fuzz_main.c"
    return out | {main.stem: compiled(main, artefact, folder / "fuzz_main.o")}


@pytest.fixture(scope="module")
def objects(small: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Those of the tracking problem."""
    return objects_of(small, tmp_path_factory.mktemp("fuzz"))


def test_no_input_breaks_a_promise(objects: dict[str, Path], tmp_path: Path) -> None:
    no_input_breaks_a_promise(objects, tmp_path)


def test_nor_of_the_problem_that_maximises_progress(tmp_path: Path) -> None:
    progress = BuildSettings(
        problem="progress", horizon=6, free_stages=2, block_stages=2, gp_capacity=16
    )
    no_input_breaks_a_promise(objects_of(build(progress)[0], tmp_path), tmp_path)


def no_input_breaks_a_promise(objects: dict[str, Path], tmp_path: Path) -> None:
    program, crash = linked(objects, tmp_path / "fuzz"), tmp_path / "crash.bin"
    done = ran([program, "3000", SEED, crash])
    assert done.returncode == 0, f"input left in {crash}\n{done.stderr[-4000:]}"
    assert done.stdout.startswith("3000 inputs")


@pytest.mark.parametrize(
    ("file", "guard", "without"),
    [
        ("br_step", "if (shifts < mpc->ahead)", "if (0)"),
        ("br_planner", "spacing >= BR_PATH_SPACING_MIN_M", "spacing > 0"),
        ("br_stage", "return BR_ERROR_STATE;\n    memcpy", "{}\n    memcpy"),
    ],
    ids=["too far ahead", "tiny spacing", "not plausible"],
)
def test_a_guard_left_out_is_found(
    objects: dict[str, Path], small: Path, tmp_path: Path, file: str, guard: str, without: str
) -> None:
    """A target that never fails would pass as well."""
    text = (small / f"{file}.c").read_text()
    assert text.count(guard) == 1
    source = tmp_path / f"{file}.c"
    source.write_text(text.replace(guard, without))
    broken = compiled(source, small, tmp_path / f"{file}.o", COVERAGE)
    program, crash = linked(objects | {file: broken}, tmp_path / "fuzz"), tmp_path / "crash.bin"
    assert any(ran([program, "6000", seed, crash]).returncode for seed in SEEDS)
    assert crash.is_file()
    assert ran([program, "--replay", crash]).returncode != 0


def test_libfuzzer_finds_nothing(small: Path, tmp_path: Path) -> None:
    include, daqp = casadi_includes()
    program = tmp_path / "libfuzzer"
    line: list[Word] = [compiler("clang"), *FLAGS, *SANITIZERS, "-fsanitize=fuzzer", f"-I{small}"]
    line += ["-isystem", include, *sorted(small.glob("*.c")), SOURCES / "fuzz.c", daqp]
    done = ran([*line, "-lm", "-o", program])
    if done.returncode and "fuzzer" in done.stderr:
        pytest.skip("this clang comes without libFuzzer")
    assert done.returncode == 0, done.stderr[-4000:]
    options = ("-runs=10000", "-max_len=1024", f"-seed={SEED}", f"-artifact_prefix={tmp_path}/")
    done = ran([program, *options])
    assert done.returncode == 0, f"input left in {tmp_path}\n{done.stderr[-4000:]}"
