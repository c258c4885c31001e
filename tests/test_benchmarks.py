"""Benchmarks: they take turns, write what they print, and are there where the docs name them."""

import json
import re
import sys
from argparse import Namespace
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from benchmarks.harness import ROOT, arguments, in_turn, percentiles, ratio, report


def test_ways_take_turns_and_every_other_round_goes_backwards() -> None:
    called: list[str] = []

    def way(name: str) -> int:
        called.append(name)
        return len(called)

    ways: dict[str, Callable[[], int]] = {name: partial(way, name) for name in "ab"}
    assert in_turn(ways, 3) == {"a": [1, 4, 5], "b": [2, 3, 6]}
    assert called == ["a", "b", "b", "a", "a", "b"]


def test_the_file_has_the_numbers_with_commit_and_machine(tmp_path: Path) -> None:
    given = Namespace(json=tmp_path / "numbers.json")
    rows = [{"way": "one", **percentiles([1.0, 2.0, 3.0], 50), **ratio([2, 3, 8], [1, 1, 2])}]
    report(given, "title", rows, exact=[[1.5]])
    content = json.loads(given.json.read_text())
    assert content["rows"] == [{"way": "one", "p50": 2, "ratio": 3, "least": 2, "largest": 4}]
    assert content["exact"] == [1.5]
    assert {"commit", "processor", "system", "utc"} <= set(content)


def test_options_have_the_type_of_their_default(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["x", "here", "--laps", "4", "--of", "a", "b", "--same-laps"])
    given = arguments("text", "folder", laps=3, of=("c",), same_laps=False, share=0.5)
    assert (given.folder, given.laps, given.of) == ("here", 4, ["a", "b"])
    assert (given.same_laps, given.share) == (True, 0.5)


def test_the_docs_name_benchmarks_that_are_there() -> None:
    """Decisions are history: they name what is gone by its last commit, as an argument of git."""
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        for name in re.findall(r"python -m benchmarks\.(\w+)", page.read_text()):
            assert (ROOT / "benchmarks" / f"{name}.py").exists(), f"{page.name}: {name}"
