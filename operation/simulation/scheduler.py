"""Threads that take turns in simulated time: a discrete-event simulation of blocking code.

One thread runs at a time, until it sleeps; then the clock goes on to what is due next. What happens
at one moment happens in the order in which it was asked for.
"""

import threading
from collections.abc import Callable
from heapq import heappop, heappush
from itertools import count
from typing import Final

__all__ = ["Scheduler", "Task"]

_BEGIN_NS: Final = 1_000_000_000
"""A clock that shows 0 would be one that was never set."""


class _EndedError(BaseException):
    """Ends a task's thread wherever it sleeps; no code that it runs catches it."""


class Task:
    """A thread that lives in simulated time."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.paused_until_ns = 0
        """It does not run before."""
        self.ended = False
        self.error: BaseException | None = None
        """That its thread has ended with."""
        self._ends = False
        self._debt_ns = 0
        """Work done at this moment, which takes time that has not passed yet."""
        self._turn = threading.Semaphore(0)


class Scheduler:
    """The clock of the thread that makes it and of all tasks, see :class:`bayesrace.clock.Clock`;
    a simulation's main thread calls it."""

    def __init__(self) -> None:
        self._now_ns = _BEGIN_NS
        self._numbers = count()
        self._due: list[tuple[int, int, Task | Callable[[], None]]] = []
        self._main = self._running = Task("main")
        self._running_thread = threading.get_ident()

    def monotonic_ns(self) -> int:
        """Now [ns]."""
        running = self._running
        # Threads of a process beside its loop, such as the one that judges weights, look as well.
        if running._debt_ns and threading.get_ident() == self._running_thread:
            debt_ns, running._debt_ns = running._debt_ns, 0
            self.sleep_until_ns(self._now_ns + debt_ns)
        return self._now_ns

    def work_s(self, duration_ns: int) -> float:
        """Lets the running task work for so long; when it has [s]. Others run when it next looks at
        the clock, so compiled code may call it."""
        self._running._debt_ns += duration_ns
        return (self._now_ns + self._running._debt_ns) * 1e-9

    def call_at(self, at_ns: int, action: Callable[[], None]) -> None:
        """Calls it then, or at once if that has passed; it must not sleep."""
        heappush(self._due, (max(at_ns, self._now_ns), next(self._numbers), action))

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Others run, and the clock goes on until it is that late."""
        me = self._running
        deadline_ns += me._debt_ns if deadline_ns <= self._now_ns else 0
        me._debt_ns = 0
        if deadline_ns <= self._now_ns:
            return
        heappush(self._due, (deadline_ns, next(self._numbers), me))
        if self._pass_on() is not me:
            me._turn.acquire()
            self._running_thread = threading.get_ident()
        if me._ends:
            raise _EndedError

    def start(self, name: str, run: Callable[[], object]) -> Task:
        """A task that begins to run when the others sleep."""
        task = Task(name)

        def live() -> None:
            task._turn.acquire()
            self._running_thread = threading.get_ident()
            try:
                if not task._ends:
                    run()
            except _EndedError:
                pass
            except BaseException as error:
                task.error = error
            task.ended = True
            self._pass_on()

        threading.Thread(target=live, name=f"simulated-{name}", daemon=True).start()
        heappush(self._due, (self._now_ns, next(self._numbers), task))
        return task

    def end(self, task: Task) -> None:
        """Ends the task where it is, as a process that is killed; returns when it has."""
        task._ends, task.paused_until_ns = True, 0
        while not task.ended:
            heappush(self._due, (self._now_ns, next(self._numbers), task))
            self.sleep_until_ns(self._now_ns + 1)

    def _pass_on(self) -> Task:
        """Does what is due, up to the next task's turn."""
        me = self._running
        while True:
            at_ns, _, what = heappop(self._due)
            self._now_ns = max(self._now_ns, at_ns)
            if not isinstance(what, Task):
                what()
            elif what.paused_until_ns > self._now_ns:
                heappush(self._due, (what.paused_until_ns, next(self._numbers), what))
            elif not what.ended:
                self._running = what
                if what is not me:
                    what._turn.release()
                return what
