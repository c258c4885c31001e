"""Training in a process of its own, which leaves the CPU to everything else.

:class:`Trainer` starts ``python -m learning.worker PARENT FOLDER`` and gives it one :class:`Task`
after another; each ends with an :class:`Outcome`. Both travel as pickled files of the folder; a
line on standard input starts a task. The process ends with its input, or with its parent.
"""

import os
import pickle
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from bayesrace.clock import die_with_parent
from bayesrace.errors import InputError
from bayesrace.files import write_whole
from bayesrace.gp.weights import GpWeights, read_weights
from bayesrace.integrators import Discretisation
from bayesrace.interpreter import RUN_MODULE
from learning.dataset import Dataset, concatenate
from learning.pool import bounded
from learning.settings import TrainingSettings
from learning.training import train

__all__ = ["NICE", "Outcome", "Task", "Trainer", "main", "perform"]

NICE: Final = 10
"""A tenth of what others get of a CPU. At 19 a busy machine would hardly ever run the training."""

_LOG, _TASK, _OUTCOME = "worker.log", ".task.part", ".outcome.part"


@dataclass(frozen=True, eq=False)
class Task:
    """Learn from samples, and keep a bounded part of them."""

    discretisation: Discretisation
    samples: Sequence[Dataset]
    """In the order in which they were driven."""
    initial: Path | None
    """Weights to start the optimiser from."""
    training: TrainingSettings
    keep: int
    """Samples to keep at most."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """The result of a task."""

    error: str = ""
    """Why there are no weights; empty if there are."""
    weights: GpWeights | None = None
    samples: int = 0
    """Learned from."""
    kept: Dataset | None = None
    """Kept of the samples, also where nothing can be learned from them; None if that failed."""
    training_s: float = 0.0


def perform(task: Task) -> Outcome:
    """Trains; what cannot be learned is in the outcome.

    InputError for weights that cannot be started from, of another model or damaged.
    """
    begin_s = time.monotonic()
    samples = concatenate(task.samples)
    initial = None if task.initial is None else read_weights(task.initial)
    weights, error = None, ""
    try:
        weights = train(samples, task.discretisation, task.training, initial)
    except (InputError, ArithmeticError, ValueError) as reason:  # LinAlgError is a ValueError
        error = str(reason) or type(reason).__name__
    kept = bounded(samples, task.keep, weights or initial)
    return Outcome(error, weights, len(samples), kept, time.monotonic() - begin_s)


class Trainer:
    """Runs one task at a time in a process that is started again if it has died."""

    def __init__(self, folder: Path) -> None:
        """``folder``: for the running task and for ``worker.log``, the process's messages."""
        self._folder, self._log = folder, folder / _LOG
        self._log.write_bytes(b"")
        self._process: subprocess.Popen[bytes] | None = None
        self.busy = False
        """A task runs."""

    def prepare(self) -> "subprocess.Popen[bytes]":
        """Starts the process unless it runs: it takes seconds. For the main thread."""
        if self._process is not None and self._process.poll() is None:
            return self._process
        # One thread for linear algebra: idle ones of a pool would still spin against a controller.
        threads = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        command = [*RUN_MODULE, "learning.worker", str(os.getpid()), str(self._folder)]
        with self._log.open("ab") as log:
            # A session of its own: Ctrl-C at the terminal is for the job, which ends its worker.
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=log, stderr=log,
                env={**os.environ, **threads}, start_new_session=True, bufsize=0,
            )  # fmt: skip
        with suppress(ProcessLookupError):  # at once: its imports take a while, too
            os.setpriority(os.PRIO_PROCESS, self._process.pid, NICE)
        return self._process

    def start(self, task: Task) -> None:
        """Runs the task; only if not :attr:`busy`. For the main thread."""
        process = self.prepare()
        os.truncate(self._log, 0)  # the process appends: it continues at the beginning
        (self._folder / _OUTCOME).unlink(missing_ok=True)
        write_whole(self._folder / _TASK, pickle.dumps(task))
        self.busy = True
        if process.stdin is not None:
            with suppress(BrokenPipeError):  # it has died, which poll() reports
                process.stdin.write(b"\n")

    def poll(self) -> Outcome | None:
        """The outcome, once; None while the task runs, or without one. An error if it died."""
        if not self.busy or self._process is None:
            return None
        code, path = self._process.poll(), self._folder / _OUTCOME
        if path.exists():
            outcome: Outcome = pickle.loads(path.read_bytes())  # noqa: S301 - of our own process
        elif code is None:
            return None
        else:
            words = self._log.read_text(errors="replace").strip().splitlines()
            how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
            outcome = Outcome(f"the training {how}{f': {words[-1]}' if code > 0 and words else ''}")
        self.busy = False
        return outcome

    def stop(self) -> None:
        """Kills the process, and the task with it."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        for name in (_TASK, _OUTCOME):
            (self._folder / name).unlink(missing_ok=True)


def main(parent: int, folder: Path) -> None:
    """Performs tasks until the input ends."""
    die_with_parent(parent)
    for _ in sys.stdin:
        task: Task = pickle.loads((folder / _TASK).read_bytes())  # noqa: S301 - of our own parent
        try:
            outcome = perform(task)
        except (InputError, OSError, MemoryError) as error:
            outcome = Outcome(str(error) or type(error).__name__)
        write_whole(folder / _OUTCOME, pickle.dumps(outcome))


if __name__ == "__main__":
    from learning.worker import main as run  # the parent unpickles outcomes by this module's name

    run(int(sys.argv[1]), Path(sys.argv[2]))
