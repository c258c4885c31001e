"""The worked examples of docs/extending.md are true: each runs, and stays short."""

import re
import subprocess
import sys

import pytest

from tests.programs import ROOT

EXAMPLES = re.findall(
    r"^## ([^\n]+)\n.*?^```python\n(.*?)^```$",
    (ROOT / "docs" / "extending.md").read_text(),
    flags=re.DOTALL | re.MULTILINE,
)


# test_cars.py runs 'Add a car', which is a file and a program.
PROGRAMS = [(title, code) for title, code in EXAMPLES if title != "Add a car"]


@pytest.mark.parametrize(("title", "code"), PROGRAMS, ids=[title for title, _ in PROGRAMS])
def test_the_example_runs(title: str, code: str) -> None:
    assert len(code.splitlines()) < 60, title
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
