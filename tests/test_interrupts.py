"""Ctrl-C is one interrupt with exit code 130, wherever in the program it strikes; where a loop
waits for everything that happens, signals are but one of these things."""

import os
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from bayesrace.processes import catching_signals
from tests.programs import ROOT

SWALLOWED = """
import os, signal, sys, weakref
from bayesrace.processes import raise_if_interrupted, remembering_interrupts

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
        env={**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


INTERRUPTED = """
import threading, time
from bayesrace.errors import {failure}
from bayesrace.operation.cli import app
from bayesrace.processes import interrupt

def work(**_):
    threading.Thread(target=interrupt, args=({failure}("certificate 'a' has expired"),)).start()
    time.sleep(30)

app.app = work
app.main()
"""


@pytest.mark.parametrize(("failure", "code"), [("InputError", 2), ("RestartError", 75)])
def test_a_process_that_interrupts_itself_says_why(failure: str, code: int) -> None:
    """Wherever that strikes."""
    program = [sys.executable, "-c", INTERRUPTED.format(failure=failure)]
    done = subprocess.run(program, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (code, "bayesrace: certificate 'a' has expired\n")


def test_signals_are_reported_and_do_nothing_else() -> None:
    caught = (signal.SIGINT, signal.SIGTERM)
    before = [signal.getsignal(one) for one in caught]
    numbers: list[int] = []
    with suppress(ZeroDivisionError), catching_signals(numbers.append):
        for one in caught:
            signal.raise_signal(one)
        raise ZeroDivisionError
    assert numbers == [*caught]
    assert [signal.getsignal(one) for one in caught] == before


@pytest.mark.usefixtures("interruptible")
def test_a_signal_while_handlers_are_restored_leaves_none_behind(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Ctrl-C in between must not leave SIGTERM reported to a loop that has ended."""
    caught = (signal.SIGINT, signal.SIGTERM)
    before = [signal.getsignal(one) for one in caught]
    numbers: list[int] = []
    restore = signal.signal

    def struck(*arguments: Any) -> Any:
        handler = restore(*arguments)
        signal.raise_signal(signal.SIGINT)
        return handler

    with pytest.raises(KeyboardInterrupt), catching_signals(numbers.append):
        monkeypatch.setattr(signal, "signal", struck)
    assert [signal.getsignal(one) for one in caught] == before
    assert numbers == [signal.SIGINT]


def test_off_the_main_thread_signals_are_left_alone() -> None:
    """There, Python could not set a handler."""
    before, within = signal.getsignal(signal.SIGINT), []

    def elsewhere() -> None:
        with catching_signals(lambda _number: None):
            within.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert within == [before]
