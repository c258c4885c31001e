"""Any bytes as calls of the native interface: no crash, no sanitizer finding, promises kept.

tests/native/fuzz.c says what is promised. A failing input is left in the test's folder:
``fuzz --replay FILE``.
"""

import subprocess
from pathlib import Path
from typing import Final

import pytest

from bayesrace.codegen.build import build, casadi_includes
from bayesrace.codegen.settings import BuildSettings
from tests.native_programs import PROGRAMS, SANITIZERS, STRICT, artefact_objects, gcc

pytestmark = pytest.mark.check

FLAGS: Final = ("-O2", *SANITIZERS, *STRICT)
COVERAGE: Final = "-fsanitize-coverage=trace-pc"
"""Guides the driver, which itself is compiled without."""
SEED: Final = "1"
SEEDS: Final = tuple(map(str, range(1, 13)))
"""Which of them finds a fault changes with the code that guides the driver."""

SMALL: Final = BuildSettings(horizon=6, gp_capacity=16)
"""A short horizon and few points: the same code, more inputs a second."""
PROGRESS: Final = SMALL.model_copy(
    update={"problem": "progress", "free_stages": 2, "block_stages": 2}
)


def compiled(source: Path, artefact: Path, folder: Path, *flags: str) -> Path:
    """Object file of one source."""
    out = folder / f"{source.stem}.o"
    gcc(*FLAGS, *flags, f"-I{artefact}", "-isystem", casadi_includes()[0], "-c", source, "-o", out)
    return out


def fuzzer(artefact: Path, folder: Path, broken: Path | None = None) -> Path:
    """The fuzz target with its own driver; ``broken`` takes the place of the source of its name."""
    replaced = {one.name: one for one in artefact_objects(artefact, (*FLAGS, COVERAGE))}
    if broken:
        one = compiled(broken, artefact, folder, COVERAGE)
        assert one.name in replaced
        replaced[one.name] = one
    target = compiled(PROGRAMS / "fuzz.c", artefact, folder, COVERAGE)
    main = compiled(PROGRAMS / "fuzz_main.c", artefact, folder)
    program = folder / "fuzz"
    objects = (*replaced.values(), target, main, casadi_includes()[1])
    gcc(*SANITIZERS, *objects, "-lm", "-o", program)
    return program


def ran(*line: str | Path) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(line, capture_output=True, text=True, check=False, timeout=400)


@pytest.mark.parametrize("settings", [SMALL, PROGRESS], ids=["tracking", "progress"])
def test_no_input_breaks_a_promise(settings: BuildSettings, tmp_path: Path) -> None:
    program, crash = fuzzer(build(settings)[0], tmp_path), tmp_path / "crash.bin"
    done = ran(program, "3000", SEED, crash)
    assert done.returncode == 0, f"input left in {crash}\n{done.stderr[-4000:]}"
    assert done.stdout.startswith("3000 inputs")


@pytest.mark.parametrize(
    ("file", "guard", "without"),
    [
        ("br_step.c", "if (shifts < mpc->ahead)", "if (0)"),
        ("br_planner.c", "spacing >= BR_PATH_SPACING_MIN_M", "spacing > 0"),
        ("br_stage.c", "return BR_ERROR_STATE;\n    memcpy", "{}\n    memcpy"),
    ],
    ids=["too far ahead", "tiny spacing", "not plausible"],
)
def test_a_guard_left_out_is_found(tmp_path: Path, file: str, guard: str, without: str) -> None:
    """A target that never fails would pass as well."""
    artefact = build(SMALL)[0]
    text, source = (artefact / file).read_text(), tmp_path / file
    assert text.count(guard) == 1
    source.write_text(text.replace(guard, without))
    program, crash = fuzzer(artefact, tmp_path, source), tmp_path / "crash.bin"
    assert any(ran(program, "6000", seed, crash).returncode for seed in SEEDS)
    assert crash.is_file()
    assert ran(program, "--replay", crash).returncode != 0
