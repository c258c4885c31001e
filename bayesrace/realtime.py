"""Real-time priority, CPU affinity and memory locking.

Refusals are reported, and the work goes on: most of it needs rights that few processes have.
:func:`short_slices` needs none: threads of the transport that are started in it run as soon as a
message wakes them.

:func:`prepare_thread` schedules and binds the calling thread alone, so call it from the control
thread once the transport has started its own: with the whole process at real-time priority,
message latency doubles on two cores.
"""

import ctypes
import gc
import os
import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from pydantic import Field

from bayesrace.strict import StrictModel

__all__ = [
    "SUSPENDED_S", "RealtimeSettings", "prepare_thread", "short_slices", "suspension",
    "uncollected",
]  # fmt: skip

SUSPENDED_S: Final = 1.0
"""A wait that ends so much later than it should: the process has not run."""

_PR_SET_TIMERSLACK = 29
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4

_SLICE_NS: Final = 100_000
"""The shortest slice that Linux grants."""
_SYSTEM_CALLS: Final = {"x86_64": (314, 315), "aarch64": (274, 275)}
"""Numbers of sched_setattr and sched_getattr, for which glibc before 2.41 has no functions."""


class RealtimeSettings(StrictModel):
    """What to ask the system for; nothing by default but an exact timer."""

    cpu: int | None = Field(None, ge=0, description="CPU to bind the control thread to")
    fifo: int | None = Field(
        None, ge=1, le=99, description="SCHED_FIFO priority of the control thread"
    )
    lock_memory: bool = Field(False, description="lock the memory of the process against paging")


def suspension(seconds: float) -> str:
    """What to report of a process that has not run for so long."""
    return (
        f"this process did not run for {seconds:.0f} s: the machine was suspended, or its "
        "processes were stopped"
    )


@contextmanager
def uncollected() -> Iterator[None]:
    """No cyclic garbage collection within the block: for work that keeps many objects and leaves no
    cycles, where looking for garbage among them takes a tenth to a quarter of the time."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def prepare_thread(settings: RealtimeSettings) -> list[str]:
    """Applies the settings to the calling thread; one line for each thing that was refused.

    Always: timer slack of 1 ns and memory that the start no longer needs given back (where the
    system has such a thing), and the cyclic garbage collector frozen and off. The loops make no
    reference cycles; between runs they call ``gc.collect()`` all the same.
    """
    gc.collect()
    _give_back()
    gc.freeze()
    gc.disable()
    refused = [
        _timer_slack(),
        _bind(settings.cpu),
        _fifo(settings.fifo),
        _lock_memory() if settings.lock_memory else "",
    ]
    return [text for text in refused if text]


class _Scheduling(ctypes.Structure):
    """``struct sched_attr`` of sched_setattr(2)."""

    _fields_ = [
        ("size", ctypes.c_uint32),
        ("policy", ctypes.c_uint32),
        ("flags", ctypes.c_uint64),
        ("nice", ctypes.c_int32),
        ("priority", ctypes.c_uint32),
        ("runtime", ctypes.c_uint64),
        ("deadline", ctypes.c_uint64),
        ("period", ctypes.c_uint64),
    ]


@contextmanager
def short_slices() -> Iterator[None]:
    """Threads that are started in the block run as soon as they wake, before ordinary threads.

    Linux, from 6.12 on, lets a thread with a shorter slice preempt one with a longer slice when it
    wakes, though in the long run it gets no more of the CPU. Without that, a message waits until
    the thread that runs on its CPU sleeps, or for a tick of the scheduler (4 ms at 250 Hz). No
    effect on other systems, where the kernel refuses it, and on threads with a policy of their own.
    """
    before = _scheduling()
    if before is None or before.policy != os.SCHED_OTHER:
        yield
        return
    slice_ns, before.runtime = before.runtime, _SLICE_NS
    _schedule(before)
    try:
        yield
    finally:
        before.runtime = slice_ns  # 0, the system's own, would lose one that was set before
        _schedule(before)


def _scheduling() -> _Scheduling | None:
    """Of the calling thread; None where it cannot be known."""
    calls, libc = _SYSTEM_CALLS.get(platform.machine()), _libc()
    if calls is None or libc is None:
        return None
    found = _Scheduling()
    size = ctypes.sizeof(found)
    return found if libc.syscall(calls[1], 0, ctypes.byref(found), size, 0) == 0 else None


def _schedule(scheduling: _Scheduling) -> None:
    libc = _libc()
    if libc is not None:
        libc.syscall(_SYSTEM_CALLS[platform.machine()][0], 0, ctypes.byref(scheduling), 0)


def _libc() -> ctypes.CDLL | None:
    return ctypes.CDLL(None, use_errno=True) if sys.platform.startswith("linux") else None


def _give_back() -> None:
    """Reading track, line and weights leaves megabytes that only glibc gives back, when asked."""
    trim = getattr(_libc(), "malloc_trim", None)
    if trim is not None:
        trim(0)


def _timer_slack() -> str:
    libc = _libc()
    if libc is None or libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0) == 0:
        return ""
    return f"timer slack stays as it is: {os.strerror(ctypes.get_errno())}"


def _bind(cpu: int | None) -> str:
    if cpu is None:
        return ""
    if not hasattr(os, "sched_setaffinity"):
        return f"not bound to CPU {cpu}: this system has no CPU affinity"
    try:
        os.sched_setaffinity(0, {cpu})
    except OSError as error:
        return f"not bound to CPU {cpu}: {error.strerror}; this process may use {_allowed()}"
    return ""


def _allowed() -> str:
    return "CPUs " + ", ".join(map(str, sorted(os.sched_getaffinity(0))))


def _fifo(priority: int | None) -> str:
    if priority is None:
        return ""
    if not hasattr(os, "sched_setscheduler"):
        return "no SCHED_FIFO: this system does not have it"
    # Threads and processes started from here on begin at normal priority.
    policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
    try:
        os.sched_setscheduler(0, policy, os.sched_param(priority))
    except OSError as error:
        return (
            f"no SCHED_FIFO priority {priority}: {error.strerror}; "
            "allow it with CAP_SYS_NICE or 'ulimit -r'"
        )
    return ""


def _lock_memory() -> str:
    libc = _libc()
    if libc is None:
        return "memory not locked: not possible on this system"
    # On fault: what is never touched (stacks of the transport's threads) takes no memory.
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) == 0:
        return ""
    reason = os.strerror(ctypes.get_errno())
    return f"memory not locked: {reason}; allow it with CAP_IPC_LOCK or 'ulimit -l'"
