"""Ctrl-C is one interrupt with exit code 130, wherever in the program it strikes."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.programs import ROOT

SWALLOWED = """
import os, signal, sys, weakref
from bayesrace.interrupts import raise_if_interrupted, remembering_interrupts

class Thing: ...

try:
    with remembering_interrupts():
        {how}
        raise_if_interrupted()
        print("went on")
except KeyboardInterrupt:
    sys.exit(130)
"""


@pytest.mark.parametrize(
    "how",
    [
        # an exception in a weak reference's callback is swallowed by the interpreter
        "weakref.finalize(Thing(), os.kill, os.getpid(), signal.SIGINT)",
        # one in a string being executed makes `python -m` end by SIGINT even if it is caught
        "exec('import os, signal; os.kill(os.getpid(), signal.SIGINT)')",
    ],
)
def test_an_interrupt_anywhere_is_one_interrupt(tmp_path: Path, how: str) -> None:
    (tmp_path / "struck.py").write_text(SWALLOWED.format(how=how))
    done = subprocess.run(
        [sys.executable, "-m", "struck"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")
