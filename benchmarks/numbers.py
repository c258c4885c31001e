"""The numbers of README and docs: each stands in docs/numbers.json, with the command behind it.

    python -m benchmarks.numbers measure [NAME ...]   runs the commands; writes docs/numbers.json
    python -m benchmarks.numbers fill                 writes the numbers into README.md and docs/
    python -m benchmarks.numbers check                compares pages and file; says what is older

A page marks a number with its name: ``6.606 s<!--=race.laps.bayesrace.flying_lap_time_s-->``; unit
and any other words may stand between. Pages round: a number keeps the decimals that the page gives
it. The first part of the name is the measurement, the rest the path within what its command writes,
where a list's items go by their ``controller``, ``name``, ``what`` or place; of items of one name
the second is called ``name-2``. A text's numbers count, too: the second one's path ends in ``.1``.
``facts`` are counted anew at each check.

A number is older than what it depends on if commits since its own have changed that. 'check' fails
where page and file differ or a name is unknown; what is older it prints.
"""

import argparse
import json
import os
import platform
import re
import shlex
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from shutil import rmtree
from typing import Any, Final

from benchmarks.harness import ROOT, processor

FILE: Final = ROOT / "docs" / "numbers.json"
_RAW: Final = ROOT / "build" / "numbers"
"""What the commands have written, in full."""

_MARKED: Final = re.compile(
    r"(?P<number>[-−+]?\d[\d ]*(?:\.\d+)?(?:e-?\d+)?)"
    r"(?P<words>[^\d<\n]{0,30})<!--=(?P<name>[\w.%-]+)-->"
)

_IN_TEXT: Final = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e-?\d+)?(?![\w.])")


@dataclass
class Measurement:
    """A command with what it has measured; an entry of docs/numbers.json."""

    command: str
    """``{out}``: a folder of its own; ``{tracks}`` and ``{data}``: the paper's own files."""
    file: str
    """JSON that it leaves there."""
    depends: list[str]
    """Files and folders of which the numbers are."""
    commit: str = ""
    date: str = ""
    machine: str = ""
    numbers: dict[str, float] = field(default_factory=dict)


def facts() -> dict[str, Any]:
    """What can be counted in the tree."""
    from tests.takeover.spoilt_weights import SPOILT
    from tests.test_sensor_faults import FAULTS

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return {
        "controller_packages": len(project["dependencies"]),
        "spoilt_weights": len(SPOILT),
        "sensor_faults": len(FAULTS),
    }


def flat(value: Any, path: str = "") -> Iterator[tuple[str, float]]:
    """The numbers of a JSON value with their paths, those in its texts included."""
    if isinstance(value, bool):
        return
    if isinstance(value, int | float):
        yield path, value
        return
    if isinstance(value, str):
        for place, found in enumerate(_IN_TEXT.finditer(value)):
            yield f"{path}.{place}" if place else path, float(found[0])
        return
    items: list[tuple[str, Any]] = []
    if isinstance(value, dict):
        items = list(value.items())
    elif isinstance(value, list):
        seen = Counter[str]()
        for place, one in enumerate(value):
            key = _key(one, place)
            seen[key] += 1
            items.append((f"{key}-{seen[key]}" if seen[key] > 1 else key, one))
    for key, one in items:
        yield from flat(one, f"{path}.{key}" if path else key)


def _key(item: Any, place: int) -> str:
    """How an item of a list is named."""
    if isinstance(item, dict):
        for name in ("controller", "name", "what"):
            if isinstance(item.get(name), str):
                number = item.get("number")
                words = item[name] if number is None else f"{item[name]}-{number}"
                return re.sub(r"[^\w%-]+", "-", words)
    return str(place)


def pages() -> list[Path]:
    """README and docs, without decisions, which are dated."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def wanted() -> dict[str, set[str]]:
    """Names that the pages use, by their measurement."""
    names: dict[str, set[str]] = {}
    for page in pages():
        for found in re.finditer(r"<!--=([\w.%-]+)-->", page.read_text()):
            measurement, _, path = found[1].partition(".")
            names.setdefault(measurement, set()).add(path)
    return names


def read() -> dict[str, Measurement]:
    """docs/numbers.json."""
    return {name: Measurement(**content) for name, content in json.loads(FILE.read_text()).items()}


def known() -> Callable[[str], float]:
    """Looks up a number by its whole name; KeyError if there is none."""
    measured, counted = read(), dict(flat(facts()))

    def look_up(name: str) -> float:
        measurement, _, path = name.partition(".")
        return counted[path] if measurement == "facts" else measured[measurement].numbers[path]

    return look_up


def _git(*words: str) -> str:
    done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def measure(names: list[str], given: dict[str, str]) -> None:
    """Runs the commands and writes their numbers, those that the pages use."""
    if _git("status", "--porcelain", "--untracked-files=no"):
        sys.exit("numbers: commit first, so that the numbers have a commit")
    everything = read()
    for name in names or list(everything):
        one, out = everything[name], _RAW / name
        if any(f"{{{key}}}" in one.command and not value for key, value in given.items()):
            print(f"{name}: left out, it needs --tracks and --data")
            continue
        rmtree(out, ignore_errors=True)
        out.mkdir(parents=True)
        words = [part.format(out=out, **given) for part in shlex.split(one.command)]
        print(f"{name}: {shlex.join(words)}", flush=True)
        subprocess.run([Path(sys.executable).parent / words[0], *words[1:]], check=True)
        found = dict(flat(json.loads((out / one.file).read_text())))
        paths = sorted(wanted().get(name, set()))
        for path in set(paths) - set(found):
            print(f"{name}: its command writes no '{path}'")
        one.numbers = {path: found[path] for path in paths if path in found}
        one.commit = _git("rev-parse", "--short", "HEAD")
        one.date = datetime.now(UTC).date().isoformat()
        one.machine = f"{processor()}, {os.cpu_count()} CPUs, Linux {platform.release()}"
        text = {key: asdict(each) for key, each in sorted(everything.items())}
        FILE.write_text(json.dumps(text, indent=1) + "\n")


def _shown(value: float, like: str) -> str:
    """The number with the decimals of another."""
    digits = like.replace(" ", "").replace("−", "-")
    decimals = len(digits.partition(".")[2])
    if "e" in digits:
        return f"{value:.0e}".replace("e-0", "e-").replace("e+0", "e")
    sign = "+" if digits.startswith("+") else ""
    text = f"{value:{sign}.{decimals}f}"
    return text.replace("-", "−") if "−" in like else text


def fill(write: bool) -> list[str]:
    """Differences between pages and file; ``write``: puts the file's numbers into the pages."""
    look_up, faults = known(), []
    for page in pages():
        text, marked = page.read_text(), 0

        def replaced(found: re.Match[str], page: Path = page) -> str:
            nonlocal marked
            marked += 1
            try:
                number = _shown(look_up(found["name"]), found["number"])
            except KeyError:
                faults.append(f"{page.name}: no number is called '{found['name']}'")
                return found[0]
            if number != found["number"]:
                faults.append(f"{page.name}: {found['name']} is {number}, not {found['number']}")
            return f"{number}{found['words']}<!--={found['name']}-->"

        new = _MARKED.sub(replaced, text)
        if (count := text.count("<!--=")) != marked:
            faults.append(f"{page.name}: {count - marked} marks have no number before them")
        if write and new != text:
            page.write_text(new)
    return faults


def older() -> list[str]:
    """Measurements whose commit is behind changes of what they depend on."""
    lines = []
    for name, one in read().items():
        try:
            log = _git("log", "--oneline", f"{one.commit}..HEAD", "--", *one.depends)
        except subprocess.CalledProcessError:
            log = "its commit is not in this history"
        if log:
            count = len(log.splitlines())
            lines.append(f"{name}: measured at {one.commit} ({one.date}), {count} commits ago")
    return lines


def main() -> int:
    """The program; returns its exit code."""
    parser = argparse.ArgumentParser(prog="benchmarks.numbers", description=__doc__)
    parser.add_argument("action", choices=("measure", "fill", "check"))
    parser.add_argument("names", nargs="*", metavar="NAME", help="measurements; default: all")
    parser.add_argument("--tracks", default="", help="folder of the paper's tracks")
    parser.add_argument("--data", default="", help="folder of the paper's data")
    given = parser.parse_args()
    if given.action == "measure":
        measure(given.names, {"tracks": given.tracks, "data": given.data})
        return 0
    faults = fill(write=given.action == "fill")
    if given.action == "fill":
        faults = [fault for fault in faults if " is " not in fault]
    for line in older():
        print(f"older than what it depends on: {line}")
    for fault in faults:
        print(fault)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
