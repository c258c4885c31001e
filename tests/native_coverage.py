"""Lines and branches of our C that the unit tests execute, counted by gcov.

    python -m tests.native_coverage

The tests run again on libraries that are built to count, beside those that users get: the flags of
the former are not the latter's.
"""

import json
import os
import shutil
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

ROOT: Final = Path(__file__).resolve().parents[1]
OUT: Final = ROOT / "build" / "coverage" / "native"
OURS: Final = {
    path.name
    for folder in ("controller/native", "controller/host", "codegen/fmu/native")
    for path in (ROOT / folder).glob("*.[ch]")
}
WITHOUT_CODE: Final = {"br_avx2.c", "br_avx512.c"}
"""They include the code of others, or name it."""

TESTS: Final = (
    "native_", "blocks", "turn", "fmu_controller", "fmu_export", "fmu_misuse", "driver", "fallback",
    "compensation", "host",
)  # fmt: skip
"""Beginnings of the names of the modules that test C."""

LEFT_OUT: Final = "not same_bits and not same_file and not ipopt"
"""Tests that compare with what the product's own flags make, or are IPOPT's work for the most."""


def run_tests() -> None:
    """Leaves notes and counts below ``OUT``."""
    shutil.rmtree(OUT, ignore_errors=True)
    (OUT / "notes").mkdir(parents=True)
    modules = [
        path for path in (ROOT / "tests").glob("test_*.py") if path.stem[5:].startswith(TESTS)
    ]
    counting = {
        "CC": str(ROOT / "tests" / "native" / "coverage_cc"),
        "COVERAGE_NOTES": str(OUT / "notes"),
    }
    line = [sys.executable, "-m", "pytest", "-q", "-m", "not check", "-k", LEFT_OUT]
    line += ["--numprocesses", "auto", "--dist", "worksteal", *map(str, sorted(modules))]
    with TemporaryDirectory() as cache:  # what is in another one does not count
        counting["BAYESRACE_CACHE"] = cache
        done = subprocess.run(line, cwd=ROOT, env=os.environ | counting, check=False)
    if done.returncode:
        sys.exit(done.returncode)


def counted() -> Iterator[dict[str, Any]]:
    """What gcov says of each source file of each build, executed or not."""
    for notes in (OUT / "notes").rglob("*.gcno"):
        line = ["gcov", "--json-format", "--stdout", "--branch-probabilities", notes.name]
        done = subprocess.run(line, cwd=notes.parent, capture_output=True, check=True)
        yield from json.loads(done.stdout)["files"]


def main() -> None:
    """Runs the tests and prints a table; fails if they fail, or leave a source of ours unbuilt."""
    run_tests()
    lines: dict[str, Counter[int]] = defaultdict(Counter)
    branches: dict[str, Counter[tuple[int, int]]] = defaultdict(Counter)
    for file in counted():
        name = Path(file["file"]).name
        if name not in OURS:
            continue
        for line in file["lines"]:
            number = line["line_number"]
            lines[name][number] += line["count"]
            for index, branch in enumerate(line["branches"]):
                branches[name][number, index] += branch["count"]
    if unbuilt := sorted(name for name in OURS - WITHOUT_CODE - set(lines) if name.endswith(".c")):
        sys.exit(f"no test builds {', '.join(unbuilt)}")
    print(f"{'C source':26} {'lines':>12} {'branches':>12}  not executed")
    rows = [[0, 0, 0, 0]]
    for name in sorted(lines):
        missed = sorted(number for number, count in lines[name].items() if not count)
        numbers = [
            len(lines[name]) - len(missed),
            len(lines[name]),
            sum(count > 0 for count in branches[name].values()),
            len(branches[name]),
        ]
        rows.append(numbers)
        print_row(name, numbers, " ".join(map(str, missed)))
    print_row("total", [sum(column) for column in zip(*rows, strict=True)])


def print_row(name: str, numbers: list[int], missed: str = "") -> None:
    """A line of the table."""
    hit, lines, taken, branches = numbers
    shares = f"{hit:4}/{lines:4} {hit / lines:5.1%}", f"{taken:4}/{branches:4}"
    print(f"{name:26} {shares[0]} {shares[1]} {taken / max(branches, 1):5.1%}  {missed}".rstrip())


if __name__ == "__main__":
    main()
