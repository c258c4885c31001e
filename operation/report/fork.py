"""Work in a copy of this process, beside the work of this one."""

import io
import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any, TypeVar

from bayesrace.clock import die_with_parent

__all__ = ["forked"]

T = TypeVar("T")

_log = logging.getLogger("bayesrace.report")


@contextmanager
def forked(work: Callable[[], T]) -> Iterator[Callable[[], T]]:
    """A copy of this process calls ``work`` during the block, to which a function is given that
    waits for the result.

    What ``work`` returns or raises is pickled. The copy writes nothing to the terminal, Ctrl-C
    concerns this process alone, and the copy ends with it. If the copy is killed, as for want of
    memory, this process calls ``work``.
    """
    context = get_context("fork")
    with ProcessPoolExecutor(1, context, _begin, (work, os.getpid())) as pool:
        future: Future[T] = pool.submit(_call)

        def result() -> T:
            try:
                return future.result()
            except BrokenProcessPool:
                _log.warning("a second process was killed; its work is done in the first one")
                return work()

        yield result


_work: list[Callable[[], Any]] = []
"""In the copy: what it calls. Only the copy's memory holds it; it need not be pickled."""


def _begin(work: Callable[[], Any], parent: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    die_with_parent(parent)
    # Another thread, as of a progress bar, may have held a stream's lock at the fork: nothing
    # would ever release it in the copy, which would wait for it for ever at its end.
    sys.stdout = sys.stderr = io.StringIO()
    logging.disable()
    _work[:] = [work]


def _call() -> Any:
    return _work[0]()
