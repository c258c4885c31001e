"""Training in a process of its own, which leaves the CPU to everything else."""

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Final

from threadpoolctl import threadpool_limits

from bayesrace.errors import InputError
from bayesrace.gp.weights import GpWeights, read_weights
from bayesrace.integrators import Discretisation
from bayesrace.learning.dataset import Dataset, concatenate
from bayesrace.learning.settings import TrainingSettings
from bayesrace.learning.subset import bounded
from bayesrace.learning.training import train
from bayesrace.processes import die_with_parent

__all__ = ["NICE", "Outcome", "Trainer", "perform"]

NICE: Final = 10
"""A tenth of what others get of a CPU. At 19 a busy machine would hardly ever run the training."""

_LONGEST_S: Final = 1800.0
"""A training without a result for so long counts as hung; one of 20,000 samples takes a minute."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """The result of a training."""

    error: str = ""
    """Why there are no weights; empty if there are."""
    weights: GpWeights | None = None
    samples: int = 0
    """Learned from."""
    kept: Dataset | None = None
    """Kept of the samples, also where nothing can be learned from them; None if that failed."""
    training_s: float = 0.0


def perform(
    discretisation: Discretisation,
    samples: Sequence[Dataset],
    initial: Path | None,
    settings: TrainingSettings,
    keep: int,
) -> Outcome:
    """Learns from samples, in the order in which they were driven, and keeps ``keep`` of them.

    ``initial``: weights to start the optimiser from; InputError if they are of another model or
    damaged. What cannot be learned is in the outcome.
    """
    begin_s, every = time.monotonic(), concatenate(samples)
    before = None if initial is None else read_weights(initial)
    weights, error = None, ""
    try:
        weights = train(every, discretisation, settings, before)
    except (InputError, ArithmeticError, ValueError) as reason:  # LinAlgError is a ValueError
        error = str(reason) or type(reason).__name__
    kept = bounded(every, keep, weights or before)
    return Outcome(error, weights, len(every), kept, time.monotonic() - begin_s)


class Trainer:
    """Runs one training at a time in a process, which another replaces if it has died or hangs.

    For the main thread.
    """

    def __init__(self) -> None:
        self._pool: ProcessPoolExecutor | None = None
        self._process: BaseProcess
        self._training: Future[Outcome] | None = None
        self._begin_s = 0.0

    @property
    def busy(self) -> bool:
        """A training runs, or its outcome waits for :meth:`poll`."""
        return self._training is not None

    def prepare(self) -> ProcessPoolExecutor:
        """Starts the process unless it runs: its imports take seconds."""
        if self._pool is None or not self._process.is_alive():
            spawn, others = multiprocessing.get_context("spawn"), multiprocessing.active_children()
            self._pool = ProcessPoolExecutor(1, spawn, initializer=_begin, initargs=(os.getpid(),))
            # Ctrl-C at the terminal is for the job, which ends its process.
            before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            self._pool.submit(int)
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
            (self._process,) = set(multiprocessing.active_children()) - set(others)
            with suppress(ProcessLookupError):  # at once: the imports would disturb others, too
                os.setpriority(os.PRIO_PROCESS, self._process.pid or 0, NICE)
        return self._pool

    def start(self, task: Callable[[], Outcome]) -> None:
        """Calls a partial :func:`perform` in the process; only if not :attr:`busy`."""
        self._begin_s, self._training = time.monotonic(), self.prepare().submit(task)

    def poll(self) -> Outcome | None:
        """The outcome, once; None while the training runs, or without one.

        An error if the training failed, or if its process has died or hangs.
        """
        training = self._training
        if training is None or (
            not training.done() and time.monotonic() < self._begin_s + _LONGEST_S
        ):
            return None
        self._training = None
        try:
            return training.result(timeout=0)
        except TimeoutError:
            self.stop()
            return Outcome(f"the training had no result after {_LONGEST_S:.0f} s and was killed")
        except BrokenProcessPool:
            self.stop()
            code = self._process.exitcode or 0
            how = f"was killed by signal {-code}" if code < 0 else f"ended with code {code}"
            return Outcome(f"the training {how}")
        except Exception as error:
            known = str(error) if isinstance(error, InputError) else ""
            return Outcome(known or f"the training failed: {type(error).__name__}: {error}")

    def stop(self) -> None:
        """Kills the process, and the training with it."""
        self._training = None
        if self._pool is not None:
            self._process.kill()
            self._pool.shutdown(cancel_futures=True)
            self._pool = None


def _begin(parent: int) -> None:
    """Of the process, which ends with its parent."""
    die_with_parent(parent)
    threadpool_limits(1)  # idle threads of linear algebra would still spin against a controller
