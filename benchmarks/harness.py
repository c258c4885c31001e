"""What all benchmarks share: ways that take turns, percentiles, a table, and a JSON file.

A benchmark compares ways to do the same thing. :func:`in_turn` lets them take turns, so that
whatever else the machine does slows all of them down, and :func:`ratio` compares them round by
round. Every benchmark has ``--json FILE``, which holds the numbers with commit and machine.
"""

import json
import os
import platform
import subprocess
from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from rich.console import Console
from rich.table import Table

from bayesrace.cache import cpu_identity
from bayesrace.controller.assembly import PredictiveController, compiled_controller
from bayesrace.gp.weights import read_weights
from bayesrace.operation.preparation import Prepared, prepare
from bayesrace.operation.settings import PreparationSettings
from bayesrace.operation.terminal.terminal import stages_on

ROOT = Path(__file__).resolve().parents[1]
Row = dict[str, Any]  # what is measured, in words, and numbers
Result = TypeVar("Result")


def arguments(text: str | None, *words: str, **defaults: Any) -> Namespace:
    """Reads the command line: ``words`` in their order, and an option for each default.

    An option has the type of its default: False becomes a flag, a tuple takes any number of words.
    """
    parser = ArgumentParser(description=text, formatter_class=RawDescriptionHelpFormatter)
    for name in words:
        parser.add_argument(name)
    for name, default in defaults.items():
        form: Row = {"type": type(default), "help": f"[{default}]"}
        if default is False:
            form = {"action": "store_true"}
        elif isinstance(default, tuple):
            form = {"nargs": "*", "help": f"[{' '.join(default)}]"}
        parser.add_argument(f"--{name.replace('_', '-')}", default=default, **form)
    parser.add_argument("--json", type=Path, help="write the numbers to this file")
    return parser.parse_args()


def prepared(*tracks: str) -> Prepared:
    """Lines, weights and controllers of these tracks, as a race makes them or has them cached."""
    with stages_on(Console(stderr=True)) as stages:
        return prepare(PreparationSettings(), tracks, stages)


def controller(made: Prepared, number: int = 0) -> PredictiveController:
    """The compiled controller on one of the tracks, with the learned weights."""
    on, car, weights = made.tracks[number], PreparationSettings().car, read_weights(made.weights)
    return compiled_controller(made.artefacts[0], car, on.track, on.line, weights)


def in_turn(ways: Mapping[str, Callable[[], Result]], rounds: int) -> dict[str, list[Result]]:
    """The results of each way, one a round; every other round goes through them backwards."""
    results: dict[str, list[Result]] = {name: [] for name in ways}
    for number in range(rounds):
        for name in list(ways)[:: -1 if number % 2 else 1]:
            results[name].append(ways[name]())
    return results


def percentiles(values: Any, *shares: float) -> Row:
    """Percentiles by name; p50, p90 and p99 if none are named."""
    return {f"p{one:g}": float(np.percentile(values, one)) for one in shares or (50, 90, 99)}


def ratio(values: ArrayLike, base: ArrayLike) -> Row:
    """The median of the rounds' ratios, and the least and the largest one."""
    low, middle, high = np.percentile(np.divide(values, base), [0, 50, 100])
    return {"ratio": float(middle), "least": float(low), "largest": float(high)}


def processor() -> str:
    """Its name, as the machine gives it."""
    return cpu_identity().splitlines()[0].rpartition(":")[2].strip()


def resident_bytes(pid: int | str) -> int:
    """Resident memory of a process."""
    status = Path(f"/proc/{pid}/status").read_text()
    return 1024 * int(status.partition("VmRSS:")[2].split()[0])


def report(given: Namespace, title: str, rows: Sequence[Row], exact: ArrayLike = ()) -> None:
    """Prints the rows as a table, and writes the JSON file if it is wanted.

    ``exact``: numbers that are the same on every machine, for the comparison of two versions.
    """
    table = Table(*rows[0], title=title, title_justify="left")
    for row in rows:
        cells = (row.get(name, "–") for name in rows[0])
        table.add_row(*(f"{one:.4g}" if isinstance(one, float) else str(one) for one in cells))
    Console(markup=False).print(table)
    if given.json:
        git = ["git", "-C", str(ROOT), "describe", "--always", "--dirty"]
        commit = subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip()
        content = {
            "title": title, "options": vars(given), "utc": f"{datetime.now(UTC):%F %T}",
            "commit": commit, "processor": processor(), "processors": os.cpu_count(),
            "system": platform.platform(),
            "rows": list(rows), "exact": np.ravel(exact).tolist(),
        }  # fmt: skip
        given.json.write_text(json.dumps(content, indent=1, default=str) + "\n")
