"""One worker process with an FMU loaded, which answers questions in bounded time.

Whatever the FMU does (crash, exit, hang, print without end, write to its descriptors), a question
is answered in time or raises :class:`WorkerFailed`.
"""

import json
import os
import select
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, Final

from bayesrace.interpreter import RUN_MODULE
from plant.fmu.output import Output
from plant.fmu.package import extract, library
from plant.fmu.worker import LONGEST

__all__ = ["FmuProcess", "WorkerFailed"]

_GOODBYE_S: Final = 0.5
"""For the FMU to free what it holds, when it is not needed any more."""


class WorkerFailed(Exception):  # noqa: N818
    """The process did not answer as it should; the message says why."""


class FmuProcess:
    """A process with the FMU unpacked for itself; it does not outlive this one.

    ``description``: fmpy's; ``arguments``: ``inputs`` and ``outputs`` of
    :class:`plant.fmu.instance.Instance`, and the ``cpus`` to run on. InputError if the file is
    damaged, or not for this computer.
    """

    def __init__(self, path: Path, description: Any, arguments: dict[str, Any]) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="bayesrace-fmu-"))
        try:
            extract(path, self.folder)
            arguments = arguments | {"library": str(library(path, self.folder, description))}
            self._launch(arguments)
        except BaseException:
            shutil.rmtree(self.folder, ignore_errors=True)
            raise

    def _launch(self, arguments: dict[str, Any]) -> None:
        with ExitStack() as ours, ExitStack() as theirs:
            # The kernel keeps messages apart: what the FMU writes there is a message of its own.
            self._socket, connection = socket.socketpair(type=socket.SOCK_SEQPACKET)
            ours.enter_context(self._socket)
            theirs.enter_context(connection)
            self._socket.setblocking(False)
            reading, writing = os.pipe()
            theirs.callback(os.close, writing)
            self.output = Output(reading)
            ours.callback(self.output.close)
            ends = {"folder": str(self.folder), "parent": os.getpid()}
            ends |= {"connection": connection.fileno()}
            self.popen = subprocess.Popen(
                [*RUN_MODULE, "plant.fmu.worker", json.dumps(arguments | ends)],
                stdin=subprocess.DEVNULL,
                stdout=writing,
                stderr=writing,
                pass_fds=(connection.fileno(),),
                # Ctrl-C at the terminal is for the plant, which ends the run in order
                start_new_session=True,
            )
            ours.pop_all()  # it has started: they are closed when it ends
        self._poll = select.poll()
        self._poll.register(self._socket, select.POLLIN)
        self._poll.register(reading, select.POLLIN)

    @property
    def running(self) -> bool:
        """Whether it lives."""
        return self.popen.poll() is None

    def ask(self, question: bytes, setting: str, timeout_s: float) -> bytes:
        """The answer to a question, or to loading; WorkerFailed if there is none in time.

        ``setting``: what the map calls the time.
        """
        deadline, answering = time.monotonic() + timeout_s, self._socket.fileno()
        try:
            if question:
                self._socket.send(question)
            # No spinning here: on two cores it takes from the FMU what it saves in waking up.
            while (left_s := deadline - time.monotonic()) > 0:
                for descriptor, _ in self._poll.poll(left_s * 1e3):
                    if descriptor != answering:
                        if not self.output.pump():
                            self._poll.unregister(descriptor)
                    elif answer := self._socket.recv(LONGEST):
                        return answer
                    else:
                        raise WorkerFailed(self._ended())
        except (ConnectionError, BlockingIOError):
            raise WorkerFailed(self._ended()) from None
        if not self.running:  # what it has started may hold its end of the connection open
            raise WorkerFailed(self._ended())
        raise WorkerFailed(f"did not answer within {timeout_s:g} s ({setting} in the map's [fmu])")

    def _ended(self) -> str:
        """How it has ended, now that its connection is closed."""
        try:
            code = self.popen.wait(1.0)
        except subprocess.TimeoutExpired:
            return "closed its connection to the plant"
        if code >= 0:
            return f"ended its own process with exit code {code}"
        with suppress(ValueError):
            return f"crashed ({signal.Signals(-code).name})"
        return f"crashed (signal {-code})"

    def quit(self) -> None:
        """Let it end in order, or not."""
        self._socket.close()
        with suppress(subprocess.TimeoutExpired):
            self.popen.wait(_GOODBYE_S)
        self.kill()

    def kill(self) -> None:
        """End it now, with what it has started in its session, and remove the unpacked FMU."""
        with suppress(ProcessLookupError, PermissionError):  # it may have gone and left some behind
            os.killpg(self.popen.pid, signal.SIGKILL)
        self.popen.wait()
        self._socket.close()
        self.output.pump()
        self.output.close()
        shutil.rmtree(self.folder, ignore_errors=True)
