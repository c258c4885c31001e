"""The worker process that trains, which gives way to everything else, and who talks to it."""

import json
import os
import subprocess
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import IO, Final

from pydantic import ValidationError

from bayesrace.interpreter import RUN_MODULE
from learning.worker import Outcome, Task

__all__ = ["NICE", "Trainer"]

NICE: Final = 10
"""A tenth of what others get of a CPU, and at once out of their way. At 19 a busy machine would
hardly ever come to training."""

_PATIENCE_S: Final = 3.0

_MOST_OUTPUT: Final = 1_000_000
"""Bytes; a file that has become longer begins anew with the next task."""


class Trainer:
    """One task at a time, in a process that is started when there is one and again when it died.

    ``told`` gets each task's outcome, in a thread of its own: one with an error if the process
    ended over it.
    """

    def __init__(self, output: Path, told: Callable[[Outcome], None]) -> None:
        """``output``: file for what the process has to say besides; emptied."""
        self._output, self._told = output, told
        output.write_bytes(b"")
        self._process: subprocess.Popen[str] | None = None
        self._listener: threading.Thread | None = None
        self._task: Task | None = None
        self._stopping = False

    @property
    def busy(self) -> bool:
        """A task is under way."""
        return self._task is not None

    def prepare(self) -> None:
        """Has the process ready: it takes seconds to start. For the main thread."""
        if self._process is None or self._process.poll() is not None:
            if self._listener is not None:
                self._listener.join()
            self._process = self._launch()

    def start(self, task: Task) -> None:
        """Hands the task over; only if not :attr:`busy`. For the main thread."""
        self.prepare()
        if self._output.stat().st_size > _MOST_OUTPUT:
            os.truncate(self._output, 0)  # the process appends: it goes on at the beginning
        self._task = task
        if self._process is not None:
            with suppress(BrokenPipeError):  # it died: the listener tells
                _pipe(self._process.stdin).write(task.model_dump_json() + "\n")
                _pipe(self._process.stdin).flush()

    def stop(self) -> None:
        """Ends the process, and the task with it, which is not told any more."""
        self._stopping = True
        process = self._process
        if process is None:
            return
        process.terminate()
        try:
            process.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        if self._listener is not None:
            self._listener.join()

    def _launch(self) -> "subprocess.Popen[str]":
        # One thread for linear algebra: idle ones of a pool would still spin against a controller.
        threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        with self._output.open("ab") as output:
            process = subprocess.Popen(
                [*RUN_MODULE, "learning.worker", str(os.getpid())],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=output,
                text=True,
                env={**os.environ, **threads},
                # Ctrl-C at the terminal is for the job, which ends its worker in order.
                start_new_session=True,
            )
        # From its first moment on: it imports a lot, and its threads inherit it.
        with suppress(ProcessLookupError):
            os.setpriority(os.PRIO_PROCESS, process.pid, NICE)
        self._listener = threading.Thread(
            target=self._listen, args=(process,), name="trainer-listener", daemon=True
        )
        self._listener.start()
        return process

    def _listen(self, process: "subprocess.Popen[str]") -> None:
        for line in _pipe(process.stdout):
            self._tell(self._outcome(line))
        code = process.wait()
        if self._task is not None and not self._stopping:
            words = self._output.read_text(errors="replace").strip().splitlines()
            how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
            said = f": {words[-1]}" if words and code > 0 else ""
            self._tell(Outcome(number=self._task.number, error=f"the training {how}{said}"))

    def _outcome(self, line: str) -> Outcome:
        try:
            return Outcome.model_validate(json.loads(line))
        except (ValueError, ValidationError) as error:
            number = -1 if self._task is None else self._task.number
            return Outcome(number=number, error=f"the training answered nonsense: {error}")

    def _tell(self, outcome: Outcome) -> None:
        self._task = None
        if not self._stopping:
            self._told(outcome)


def _pipe(end: IO[str] | None) -> IO[str]:
    if end is None:
        raise RuntimeError("the worker was started without pipes")
    return end
