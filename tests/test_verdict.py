"""Verdicts of the evidence commands: exit code, sentence, and JUnit XML."""

from pathlib import Path
from xml.etree import ElementTree

from rich.console import Console

from bayesrace.studies.evidence.verdict import Check, Verdict

HOLDS = Check("a <drive>", "same inputs", True, "721 of 721", 0.25)
FAILS = Check("b", "off the track: at most 0", False, "3 samples [deepest 4 mm] & more")


def test_a_verdict_passes_only_if_something_was_checked_and_all_of_it_holds() -> None:
    assert Verdict("replay", (HOLDS,)).exit_code == 0
    assert Verdict("replay", (HOLDS, FAILS)).exit_code == 1
    assert Verdict("replay", ()).exit_code == 1
    assert "nothing" in Verdict("replay", ()).text
    assert "1 of 2" in Verdict("replay", (HOLDS, FAILS)).text
    assert FAILS.found in Verdict("replay", (HOLDS, FAILS)).text


def test_junit_names_each_check_and_why_it_fails(tmp_path: Path) -> None:
    Verdict("replay", (HOLDS, FAILS)).write_junit(tmp_path / "junit.xml")
    root = ElementTree.parse(tmp_path / "junit.xml").getroot()  # noqa: S314 (our own)
    assert [one.attrib["failures"] for one in root] == ["0", "1"]
    assert [one.attrib["name"] for one in root.iter("testcase")] == [HOLDS.name, FAILS.name]
    assert root[0].attrib["name"] == HOLDS.subject
    assert [one.attrib["message"] for one in root.iter("failure")] == [FAILS.found]
    assert float(root[0].attrib["time"]) == HOLDS.seconds


def test_the_table_shows_brackets_as_they_are() -> None:
    console = Console(record=True, width=200)
    Verdict("replay", (HOLDS, FAILS)).print(console)
    text = console.export_text()
    assert FAILS.found in text
    assert "fails" in text
