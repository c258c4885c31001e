"""The process that an FMU runs in: whatever the FMU does to its process, it does to this one.

:class:`plant.fmu.process.FmuProcess` starts it. The FMU's log goes to standard output, which is a
pipe to the plant. When the plant ends, however it ends, this process ends too, and removes the
unpacked FMU.

A question is a byte and its content: ``s`` and JSON to start, ``d`` and doubles (step size, number
of steps, inputs) to step. So is an answer: ``v`` and doubles (time, outputs), ``f`` and a text that
says what failed. Loading is answered without a question, its outputs are zero.
"""

import json
import os
import shutil
import signal
import socket
import sys
import threading
from array import array
from contextlib import suppress
from typing import Any, Final

from bayesrace.clock import die_with_parent

__all__ = ["LONGEST", "main"]

LONGEST: Final = 1 << 16
"""Bytes of a question or an answer; the longest carry start values."""

_LABELS: Final = ("info", "warning", "discard", "error", "fatal", "pending")
_LONGEST_MESSAGE: Final = 1000
"""Characters of the log."""


def _log(status: int, message: str) -> None:
    label = _LABELS[status] if 0 <= status < len(_LABELS) else str(status)
    text = " ".join(message[:_LONGEST_MESSAGE].split())
    with suppress(OSError):  # the FMU may have closed it
        os.write(1, f"[FMU {label}] {text}\n".encode(errors="replace"))


def _serve(connection: socket.socket, arguments: dict[str, Any]) -> None:
    """Loads the FMU, then answers questions until the plant closes the connection."""
    from plant.fmu.instance import CallFailed, Instance  # brings fmpy, and takes its time

    try:
        instance = Instance(**arguments, log=_log)
        while True:
            values = array("d", (instance.time_s, *instance.values()))
            connection.send(b"v" + values.tobytes())
            question = connection.recv(LONGEST)
            if not question:
                return instance.free()
            if question[:1] == b"s":
                instance.start(json.loads(question[1:]))
            else:
                step_s, count, *inputs = array("d", question[1:])
                instance.step(step_s, int(count), inputs)
    except CallFailed as failure:  # the plant ends this process, once it has read the message
        connection.send(b"f" + str(failure).encode(errors="replace")[:4000])
        connection.recv(1)


def _end_with(parent: int, folder: str) -> None:
    """At SIGTERM or the parent's death: end, also while the FMU computes, and what it started."""
    reading, writing = os.pipe()
    os.set_blocking(writing, False)

    def wait() -> None:
        with suppress(OSError):  # the FMU may close it
            os.read(reading, 1)
        shutil.rmtree(folder, ignore_errors=True)
        os.killpg(os.getpid(), signal.SIGKILL)

    threading.Thread(target=wait, daemon=True).start()
    # Python's own handler waits for the end of the FMU's call; the byte in the pipe does not.
    signal.signal(signal.SIGTERM, lambda *_: None)
    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    die_with_parent(parent)


def main(argv: list[str]) -> int:
    """Serve the plant that has started this process; returns the exit code."""
    arguments = json.loads(argv[0])
    folder, descriptor = arguments["folder"], arguments.pop("connection")
    parent, cpus = arguments.pop("parent"), arguments.pop("cpus")
    _end_with(parent, folder)
    # An FMU that hangs must not keep the plant off a CPU.
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    os.sched_setaffinity(0, cpus)
    os.chdir(folder)  # what an FMU writes beside itself is removed with it
    os.set_inheritable(descriptor, False)  # not for what the FMU starts
    with suppress(ConnectionError):  # the plant has ended
        _serve(socket.socket(fileno=descriptor), arguments)
    shutil.rmtree(folder, ignore_errors=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
