"""What must hold, and whether it does: for the terminal, the exit code and JUnit XML."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from xml.etree import ElementTree

from rich.console import Console
from rich.text import Text

from bayesrace.files import write_whole
from bayesrace.operation.terminal import printable
from bayesrace.operation.terminal.terminal import plain_table

__all__ = ["Check", "Verdict"]


@dataclass(frozen=True)
class Check:
    """One thing that must hold."""

    subject: str
    """Of what: a recording, a scenario, a phase of the step."""
    name: str
    """What must hold, with its bound: ``off the track: at most 0 samples``."""
    passed: bool
    found: str
    """What was found instead, or by how much it holds, as a sentence for a person."""
    seconds: float = 0.0
    """How long it took to find out; 0: not known."""


@dataclass(frozen=True)
class Verdict:
    """All checks of a command; it passes if each does, and if there is one at all."""

    command: str
    checks: tuple[Check, ...]

    @property
    def passed(self) -> bool:
        """Whether everything holds."""
        return bool(self.checks) and all(one.passed for one in self.checks)

    @property
    def exit_code(self) -> int:
        """0 if everything holds, else 1."""
        return 0 if self.passed else 1

    @property
    def text(self) -> str:
        """In one line."""
        failed = [one for one in self.checks if not one.passed]
        if not self.checks:
            return "nothing was checked"
        if not failed:
            return f"{len(self.checks)} of {len(self.checks)} checks hold"
        first = failed[0]
        return (
            f"{len(failed)} of {len(self.checks)} checks fail; first {first.subject}: "
            f"{first.name}: {first.found}"
        )

    def print(self, console: Console) -> None:
        """A row for each check, then the verdict."""
        table = plain_table("subject", "what must hold", "", "found", left=4)
        for one in self.checks:
            mark = Text("holds") if one.passed else Text("fails", "bold red")
            subject, name, found = (Text(printable(t)) for t in (one.subject, one.name, one.found))
            table.add_row(subject, name, mark, found)
        console.print(table)
        console.print(Text(f"{self.command}: {printable(self.text)}"))

    def write_junit(self, path: Path) -> None:
        """As JUnit XML, which build servers read: a test suite for each subject."""
        write_whole(path, _junit(self.command, self.checks))


def _junit(command: str, checks: Iterable[Check]) -> str:
    root = ElementTree.Element("testsuites", name=f"bayesrace {command}")
    for subject, group in groupby(checks, lambda one: one.subject):
        of = tuple(group)
        suite = ElementTree.SubElement(
            root, "testsuite", name=subject, tests=str(len(of)), errors="0", skipped="0",
            failures=str(sum(not one.passed for one in of)),
            time=f"{sum(one.seconds for one in of):.3f}",
        )  # fmt: skip
        for one in of:
            case = ElementTree.SubElement(
                suite, "testcase", classname=f"bayesrace.{command}.{subject}", name=one.name,
                time=f"{one.seconds:.3f}",
            )  # fmt: skip
            if not one.passed:
                ElementTree.SubElement(case, "failure", message=one.found)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"
