"""Rules of MISRA C:2012 that the project's C does not keep, by cppcheck's add-on.

    python -m tests.native_misra [--json FILE]

Prints how often each rule is violated by the library (controller/native) and by the program
without Python (controller/host), and where. docs/c-code.md lists these rules as deviations.
"""

import argparse
import json
import re
import shutil
import subprocess
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import pytest

from bayesrace.codegen.build import HOST, NATIVE, casadi_includes, generate, problem_of
from bayesrace.codegen.messages import messages_header
from bayesrace.codegen.settings import BuildSettings

PAGE: Final = Path(__file__).parents[1] / "docs" / "c-code.md"

OURS: Final = (NATIVE, NATIVE.parent / HOST)

FINDING: Final = re.compile(r"^(?P<place>.+:\d+):misra-c2012-(?P<rule>\d+\.\d+)$", re.MULTILINE)


def findings() -> dict[str, list[str]]:
    """Places of the violations by rule. Skips the test where cppcheck is missing."""
    if shutil.which("cppcheck") is None:
        pytest.skip("cppcheck is not installed, see .ci/tools")
    with TemporaryDirectory() as name:
        folder = Path(name)  # the add-on writes beside the sources
        for own in OURS:
            shutil.copytree(own, folder / own.name)
        (folder / "daqp").symlink_to(casadi_includes()[0] / "daqp")
        made = folder / "made"
        made.mkdir()
        settings = BuildSettings()
        generate(problem_of(settings), settings, made)
        (made / "br_messages.h").write_text(messages_header())
        parts = [own.name for own in OURS]
        line = [
            *("cppcheck", "--quiet", "--addon=misra", "--std=c11", "-j2", "-D__GNUC__"),
            *("-D__x86_64__", "--suppress=*:daqp/*", "--suppress=*:made/*", "-I.", "-Imade"),
            *(f"-I{one}" for one in parts), "--template={file}:{line}:{id}", *parts,
        ]  # fmt: skip
        done = subprocess.run(line, cwd=folder, capture_output=True, text=True, check=True)
    found: dict[str, list[str]] = {}
    for one in sorted(set(FINDING.findall(done.stderr))):
        found.setdefault(one[1], []).append(one[0])
    return found


def deviations() -> set[str]:
    """Rules of the table in docs/c-code.md."""
    return set(re.findall(r"^\| (\d+\.\d+) ", PAGE.read_text(), re.MULTILINE))


def by_number(rules: Iterable[str]) -> list[str]:
    """In the order of the standard."""
    return sorted(rules, key=lambda rule: tuple(map(int, rule.split("."))))


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(prog="native_misra", description=__doc__)
    parser.add_argument("--json", type=Path, metavar="FILE", help="writes the numbers, too")
    given = parser.parse_args()
    found = findings()
    for rule in by_number(found):
        files = Counter(Path(place).name.partition(":")[0] for place in found[rule])
        most = ", ".join(f"{file} {count}" for file, count in files.most_common(4))
        print(f"{rule:>6} {len(found[rule]):5}  {most}")
    if given.json:
        numbers = {rule.replace(".", "-"): len(places) for rule, places in found.items()}
        given.json.write_text(json.dumps(numbers | {"rules": len(found)}))


if __name__ == "__main__":
    main()
