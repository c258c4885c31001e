"""A Co-Simulation FMU in a process of its own, behind calls that end in time.

Whatever the FMU does (crash, exit, hang, print without end, write to its descriptors), the plant
gets an answer or a :class:`FmuFault` that says what happened.
"""

import math
import os
import re
import select
import signal
import socket
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from subprocess import PIPE, STDOUT, Popen, TimeoutExpired
from typing import IO, Annotated, Any, Final, cast

from msgspec import Meta, MsgspecError, msgpack

from bayesrace.errors import InputError
from bayesrace.files import temporary_folder
from bayesrace.plant.fmu.inspection import extract, library
from bayesrace.plant.fmu.wiring import Value
from bayesrace.plant.fmu.worker import LONGEST
from bayesrace.plant.vehicle import FmuFault
from bayesrace.processes import RUN_MODULE

__all__ = ["FmuHost"]

_WORKER: Final = "bayesrace.plant.fmu.worker"

_GOODBYE_S: Final = 2.0
"""For the FMU to free what it holds, when it is not needed any more."""

_SHOWN: Final = 1 << 16
"""Bytes of one run's output that are passed on."""
_KEPT: Final = 4096
"""Bytes in which the last message is looked for."""
_TROUBLE: Final = re.compile(r"^\[FMU (?!info)\w+\] (.+)", re.MULTILINE)


class _Output(threading.Thread):
    """Passes an FMU's standard output and error, and its log, on within bounds; keeps the end."""

    def __init__(self, pipe: IO[bytes]) -> None:
        super().__init__(daemon=True)
        self._pipe = pipe
        self.restart()
        self.start()

    def restart(self) -> None:
        """A new run: pass on again, and forget the output of the last one."""
        self._left, self._tail = _SHOWN, b""

    def run(self) -> None:
        """Reads until no process has the pipe open any more."""
        with self._pipe:
            while data := os.read(self._pipe.fileno(), 1 << 16):
                self._tail = (self._tail + data)[-_KEPT:]
                self._pass_on(data[: self._left])

    def last_message(self) -> str:
        """The last message of its log that reports trouble, or else the last line."""
        self.join(1.0)  # a process that has left the session may hold the pipe open
        text = self._tail.decode(errors="replace").strip()
        lines: list[str] = _TROUBLE.findall(text) or text.splitlines()
        return lines[-1].removeprefix("[FMU info]").strip() if lines else ""

    def _pass_on(self, data: bytes) -> None:
        self._left -= len(data)
        if data and not self._left:
            data += b"\n[what else the FMU prints is not shown]\n"
        # A standard error that nothing reads must not hold up the car: then it is lost.
        for begin in range(0, len(data), select.PIPE_BUF):
            with suppress(OSError, ValueError):
                if select.select((), (2,), (), 0)[1]:
                    os.write(2, data[begin : begin + select.PIPE_BUF])


class FmuHost:
    """An FMU, ready to run; close it when done.

    ``inputs`` and ``outputs`` name its variables, real numbers, in the order in which values are
    passed. ``timeout_s``: how long it may take for a step; ``startup_s``: for loading, and for an
    initialisation; tools behind it may have to start too.

    Raises InputError if it is not for this computer, or cannot be loaded and instantiated.
    """

    def __init__(
        self, path: Path, fmu: Any, inputs: Sequence[str], outputs: Sequence[str], *,
        timeout_s: float, startup_s: float,
    ) -> None:  # fmt: skip
        if sys.platform != "linux":
            raise InputError("an FMU as the plant needs Linux: run the plant there")
        self.path, self.timeout_s, self.startup_s = path, timeout_s, startup_s
        self.time_s = 0.0
        """Time that the FMU has reached."""
        self._excess_s = 0.0  # of its sum
        self._fmu, self._inputs, self._outputs = fmu, inputs, outputs
        one_each = Meta(min_length=len(outputs), max_length=len(outputs))
        self._decoder = msgpack.Decoder(Annotated[list[float], one_each] | str)
        self._cpus = sorted(os.sched_getaffinity(0))
        self._process: Popen[bytes] | None = None
        self._used = False
        try:
            self._launch()
        except FmuFault as fault:
            raise InputError(f"{fault}: use another FMU, or repair this one") from None

    def start(self, values: Mapping[str, Value]) -> list[float]:
        """A new instance with these values set before its initialisation; its outputs at t = 0.

        Raises FmuFault if the FMU fails.
        """
        once = self._fmu.coSimulation.canBeInstantiatedOnlyOncePerProcess
        if self._process and (self._process.poll() is not None or (once and self._used)):
            self.close()
        if not self._process:
            self._launch()
        self._output.restart()
        self._used, self.time_s, self._excess_s = True, 0.0, 0.0
        return self._ask(values, "while it was initialised")

    def step(self, inputs: Sequence[float], step_s: float, count: int = 1) -> list[float]:
        """Its outputs after ``count`` communication steps of ``step_s``.

        ``inputs``: held for all of them, or a row for each, one after the other. FmuFault if the
        FMU fails; it is then gone, and :meth:`start` begins with a new one.
        """
        outputs, begin_s = self._ask((step_s, count, self.time_s, inputs)), self.time_s
        # Kahan's sum: rounding does not add up.
        added_s = count * step_s - self._excess_s
        self.time_s = begin_s + added_s
        self._excess_s = (self.time_s - begin_s) - added_s
        return outputs

    def close(self) -> None:
        """End the process and remove the unpacked files."""
        if self._process:
            with suppress(OSError):
                self._plant.send(msgpack.encode(None))
            self._wait(self._process, _GOODBYE_S)
            self._kill()

    def fault(self, what: str, when: str = "") -> FmuFault:
        """Ends the process, which is no car any more; the fault to raise."""
        self._kill()
        words = self._output.last_message()
        at = when or f"at t = {self.time_s:.6g} s"
        last = f"; its last message: {words}" if words else ""
        return FmuFault(f"FMU {self.path.name} {at}: {what}{last}")

    def _launch(self) -> None:
        self._used = False
        try:
            with ExitStack() as ours:
                folder = ours.enter_context(temporary_folder())
                extract(self.path, folder)
                binary = library(self.path, folder, self._fmu)
                # The kernel keeps messages apart: what the FMU writes there is one of its own.
                self._plant, worker = socket.socketpair(type=socket.SOCK_SEQPACKET)
                ours.enter_context(self._plant)
                with worker:
                    # Ctrl-C at the terminal is for the plant, which ends the run in order.
                    process = Popen(
                        (*RUN_MODULE, _WORKER, str(worker.fileno()), folder, binary),
                        stdin=PIPE, stdout=PIPE, stderr=STDOUT, pass_fds=(worker.fileno(),),
                        start_new_session=True,
                    )  # fmt: skip
                # Its end tells the worker of the plant's.
                ours.enter_context(cast("IO[bytes]", process.stdin))
                self._output = _Output(cast("IO[bytes]", process.stdout))
                self._process = process
                self._held = ours.pop_all()
        except (OSError, RuntimeError) as error:  # no memory, processes, descriptors or disk left
            why = getattr(error, "strerror", None) or error
            raise FmuFault(f"FMU {self.path.name}: its process does not start: {why}") from None
        self._ask((self._cpus, self._inputs, self._outputs), "while it was loaded")

    def _ask(self, question: object, when: str = "") -> list[float]:
        """The outputs that the worker answers, all finite; ``when``: at the start.

        FmuFault, without a process from then on, if there are none in time.
        """
        if not self._process:
            raise FmuFault(f"FMU {self.path.name}: it has failed, and no new run has been started")
        answer = self._answer(self._process, question, "startup_s" if when else "timeout_s")
        if isinstance(answer, str):
            raise self.fault(answer, when)
        for name, value in zip(self._outputs, answer, strict=True):
            if not math.isfinite(value):
                raise self.fault(f"gave {name} = {value:g}", when)
        return answer

    def _answer(self, process: Popen[bytes], question: object, limit: str) -> list[float] | str:
        """Outputs, or what has failed; ``limit``: of the time, as the map calls it."""
        message, limit_s = msgpack.encode(question), getattr(self, limit)
        if len(message) > LONGEST:
            return "too many values at once: set fewer in the map, or a longer step_s"
        try:
            self._plant.settimeout(limit_s)
            self._plant.send(message)
            if answer := self._plant.recv(LONGEST):
                outputs: list[float] | str = self._decoder.decode(answer)
                return outputs
        except MsgspecError:
            return "wrote to its process's connection with the plant"
        except OSError as error:
            # What a process that has ended has started may hold its connection open.
            if isinstance(error, TimeoutError) and process.poll() is None:
                return f"did not answer within {limit_s:g} s ({limit} in the map's [fmu])"
        code = self._wait(process, 1.0)
        if code is None:
            return "closed its connection to the plant"
        names = {-one: f"crashed ({one.name})" for one in signal.Signals}
        return names.get(code, f"ended its own process with exit code {code}")

    @staticmethod
    def _wait(process: Popen[bytes], seconds: float) -> int | None:
        """Its exit code; None if it lives on."""
        with suppress(TimeoutExpired):
            process.wait(seconds)
        return process.returncode

    def _kill(self) -> None:
        """End the process now, with what it has started, and remove the unpacked FMU."""
        process, self._process = self._process, None
        if process:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            self._held.close()
