"""C programs around the native step, compiled by gcc: under sanitizers, or with any other flags."""

import os
import re
import shutil
import subprocess
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Final

import pytest

from bayesrace.cache import software
from bayesrace.codegen.build import casadi_includes
from bayesrace.codegen.compiler import FLAGS
from tests.shared import shared_folder

__all__ = [
    "GENERATED",
    "OPTIMISED",
    "PROGRAMS",
    "SANITIZED",
    "SANITIZERS",
    "STRICT",
    "artefact_objects",
    "gcc",
    "native_program",
]

PROGRAMS: Final = Path(__file__).parent / "native"
"""Where the programs lie."""

SANITIZERS: Final[tuple[str, ...]] = (
    "-g",
    "-std=gnu11",
    "-fno-omit-frame-pointer",
    "-fsanitize=address,undefined",
    "-fno-sanitize-recover=all",
)
"""Not optimised: compiled in a third of the time."""

SANITIZED: Final[tuple[str, ...]] = ("-O1", *SANITIZERS)
"""For what runs for longer than it takes to compile."""

STRICT: Final = (
    "-Werror", "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion", "-Wshadow", "-Wvla",
    "-Wcast-qual", "-Wstrict-prototypes", "-Wmissing-prototypes",
)  # fmt: skip

GENERATED: Final = ("-Wno-unused-parameter", "-Wno-missing-prototypes")
"""For CasADi's C: its functions have one signature, and get prototypes in one of its files only."""

OPTIMISED: Final = (*(flag for flag in FLAGS if flag != "-fPIC"), *STRICT)
"""As the artefact's library is, and therefore to the same bits."""

Word = str | Path


def gcc(*words: Word, cwd: Path | None = None) -> str:
    """Runs gcc; its warnings. Skips the test where gcc or one of its sanitizers is missing."""
    compiler = shutil.which("gcc")
    if compiler is None:
        pytest.skip("gcc is not installed")
    done = subprocess.run(
        [compiler, *words], cwd=cwd, capture_output=True, text=True, check=False, timeout=280
    )
    if re.search(r"cannot find \S*(asan|ubsan|tsan)", done.stderr):
        pytest.skip("gcc's sanitizer libraries are not installed")
    assert done.returncode == 0, done.stderr[-4000:]
    return done.stderr


@cache
def artefact_objects(artefact: Path, flags: tuple[str, ...]) -> tuple[Path, ...]:
    """The artefact's own sources as object files, compiled with these flags."""
    sources = sorted(artefact.glob("*.c"))
    # -isystem: the warnings are for our own code
    line: list[Word] = [*flags, f"-I{artefact}", "-isystem", casadi_includes()[0], "-c"]

    def make(folder: Path) -> None:
        def compiled(source: Path) -> None:
            lenient = GENERATED if source.name == "br_model.c" else ()
            gcc(*line, *lenient, source, "-o", folder / f"{source.stem}.o")

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            list(pool.map(compiled, sources))

    parts: list[str | bytes] = [*flags, *GENERATED, gcc("-v"), *software((), ("casadi",))]
    parts += [path.read_bytes() for path in [*sources, *sorted(artefact.glob("*.h"))]]
    folder = shared_folder("objects", parts, make)
    return tuple(folder / f"{source.stem}.o" for source in sources)


def native_program(
    artefact: Path, source: Path, out: Path, *flags: str, also: Sequence[str] = ()
) -> Path:
    """``source`` as a program with the artefact's own sources and DAQP.

    ``also``: further sources, and flags that are for them, for it and for the linker alone.
    """
    include, daqp = casadi_includes()
    objects = artefact_objects(artefact, flags)
    line: list[Word] = [*flags, f"-I{artefact}", "-isystem", include, *also, source]
    gcc(*line, *objects, daqp, "-lm", "-o", out)
    return out
