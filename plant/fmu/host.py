"""Runs an FMU in a process of its own and asks it, never waiting longer than it may take.

Whatever the FMU does (crash, exit, hang, print without end, fill its descriptors), the plant gets
an answer in time or a :class:`FmuFault` that says what happened.
"""

import json
import math
import os
import select
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from array import array
from collections.abc import Mapping, Sequence
from contextlib import suppress
from mmap import mmap
from pathlib import Path
from typing import Any, Final

from bayesrace.errors import InputError
from bayesrace.interpreter import RUN_MODULE
from plant.fmu.channel import (
    DOUBLE,
    FAULT,
    LOAD,
    QUIT,
    READY,
    START,
    STEP,
    VALUES,
    Channel,
    Closed,
    ProtocolError,
)
from plant.fmu.faults import FmuFault
from plant.fmu.output import Output
from plant.fmu.package import extract, library, read_description
from plant.fmu.worker import WORDS_BYTES, read_words

__all__ = ["FmuHost", "Value"]

Value = float | int | bool | str

_STARTUP_S: Final = 8.0
"""For the process to start and the FMU to be loaded, and for each initialisation; tools behind it
may have to start too. Both together are less than who asks for a run waits."""

_GOODBYE_S: Final = 0.5
"""For the FMU to free what it holds, when it is not needed any more."""

_ROOT: Final = Path(__file__).resolve().parents[2]
_PREFIX: Final = "bayesrace-fmu-"

_SCRIBBLED: Final = "wrote to its process's connection with the plant"

_NUMERIC: Final = (
    "Real", "Integer", "Boolean", "Enumeration", "Float64", "Float32",
    *(f"{sign}Int{bits}" for sign in ("", "U") for bits in (8, 16, 32, 64)),
)  # fmt: skip


class _Died(Exception):  # noqa: N818
    """The process has ended."""


class _Process:
    """One process with the FMU loaded; gone for good after a fault."""

    def __init__(self, folder: Path, cpus: Sequence[int]) -> None:
        ours, theirs = socket.socketpair()
        read, write = os.pipe()
        with tempfile.TemporaryFile() as page:
            page.truncate(WORDS_BYTES)
            self._page = mmap(page.fileno(), WORDS_BYTES)
            told = {
                "folder": str(folder),
                "parent": os.getpid(),
                "cpus": list(cpus),
                "socket": theirs.fileno(),
                "words": page.fileno(),
            }
            self._popen = subprocess.Popen(
                [*RUN_MODULE, "plant.fmu.worker", json.dumps(told)],
                cwd=_ROOT,
                stdin=subprocess.DEVNULL,
                stdout=write,
                stderr=write,
                pass_fds=(theirs.fileno(), page.fileno()),
                # Ctrl-C at the terminal is for the plant, which ends the run in order
                start_new_session=True,
            )
        os.close(write)
        theirs.close()
        self._socket = ours
        self._channel = Channel(ours.fileno(), blocking=False)
        self.output = Output(read)
        self._poll = select.poll()
        self._poll.register(ours.fileno(), select.POLLIN)
        self._poll.register(read, select.POLLIN)
        self._printing = read

    @property
    def running(self) -> bool:
        """Whether it lives."""
        return self._popen.poll() is None

    def ask(self, kind: int, payload: bytes, timeout_s: float) -> tuple[int, memoryview]:
        """The answer to a question; _Died, TimeoutError or ProtocolError instead of one."""
        deadline = time.monotonic() + timeout_s
        try:
            self._channel.send(kind, payload, deadline)
            # No spinning here: on two cores it takes from the FMU what it saves in waking up.
            while (answer := self._channel.poll()) is None:
                left_s = deadline - time.monotonic()
                if left_s <= 0:
                    raise TimeoutError
                for descriptor, _ in self._poll.poll(left_s * 1e3):
                    if descriptor == self._printing and not self.output.pump():
                        self._poll.unregister(descriptor)
        except Closed:
            raise _Died from None
        return answer

    def last_words(self) -> str:
        """What it said last, to the log or else to its standard output."""
        self.output.pump()
        return read_words(self._page) or self.output.last_line

    def ended(self) -> str:
        """How it has ended, now that its channel is closed; kills what still lives."""
        try:
            code = self._popen.wait(1.0)
        except subprocess.TimeoutExpired:
            self.kill()
            return "closed its connection to the plant"
        if code < 0:
            try:
                return f"crashed ({signal.Signals(-code).name})"
            except ValueError:
                return f"crashed (signal {-code})"
        return f"ended its own process with exit code {code}"

    def quit(self) -> None:
        """Let it end in order, or not."""
        if self.running:
            with suppress(_Died, TimeoutError, ProtocolError):
                self.ask(QUIT, b"", _GOODBYE_S)
        self.kill()

    def kill(self) -> None:
        """End it now, with what it has started in its session."""
        with suppress(ProcessLookupError, PermissionError):  # it may have gone and left some behind
            os.killpg(self._popen.pid, signal.SIGKILL)
        self._popen.wait()
        self.output.close()
        self._socket.close()


class FmuHost:
    """A Co-Simulation FMU, ready to run; close it when done.

    ``inputs`` and ``outputs`` name its variables (numbers, no arrays) in the order in which values
    are passed. ``timeout_s``: how long it may take for a step; ``startup_s``: for loading,
    and for an initialisation.

    Raises InputError if the file is no such FMU, is not for this computer, or cannot be loaded
    and instantiated. On Linux the FMU ends with the thread that started it: use one that stays.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        inputs: Sequence[str],
        outputs: Sequence[str],
        timeout_s: float = 2.0,
        startup_s: float = _STARTUP_S,
    ) -> None:
        self.path = Path(path)
        if os.name != "posix":
            raise InputError("an FMU as the plant needs Linux or macOS: run the plant there")
        self.description: Any = read_description(self.path)
        if self.description.coSimulation is None:
            raise InputError(
                f"{self.path} is for Model Exchange only, and the plant has no solver for it: "
                "export it for Co-Simulation"
            )
        self._variables = {v.name: v for v in self.description.modelVariables}
        self._inputs = [self._numeric(name) for name in inputs]
        self._outputs = [self._numeric(name) for name in outputs]
        self._names = tuple(outputs)
        self.timeout_s = timeout_s
        self.startup_s = startup_s
        self.time_s = 0.0
        """Time that the FMU has reached."""
        self._cpus = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
        self._process: _Process | None = None
        self._used = False
        self._folder = self._library = Path()
        try:
            self._unpack()
            self._launch()
        except FmuFault as fault:
            self.close()
            raise InputError(f"{fault}: use another FMU, or repair this one") from None
        except BaseException:
            self.close()
            raise

    def start(self, values: Mapping[str, Value]) -> list[float]:
        """A new instance with these values set before its initialisation; its outputs at t = 0.

        Raises InputError for a value that is no such variable's, FmuFault if the FMU fails.
        """
        told = self._start_values(values)
        once = self.description.coSimulation.canBeInstantiatedOnlyOncePerProcess
        if self._process is not None and (not self._process.running or (once and self._used)):
            self._process.quit()
            self._process = None
        if self._process is None:
            if not self._folder.is_dir():  # a process ended from outside takes them with it
                self._unpack()
            self._launch()
        self._process_now.output.restart()
        self._used = True
        self.time_s = 0.0
        return self._values(START, told, self.startup_s, "while it was initialised")

    def step(self, inputs: Sequence[float], step_s: float, count: int = 1) -> list[float]:
        """Its outputs after ``count`` communication steps of ``step_s``.

        ``inputs``: held for all of them, or a row for each, one after the other. FmuFault if the
        FMU fails; it is then gone, and :meth:`start` begins with a new one.
        """
        question = array("d", (step_s, count, *inputs)).tobytes()
        return self._values(STEP, question, self.timeout_s, "")

    def close(self) -> None:
        """End the process and remove the unpacked files."""
        process, self._process = self._process, None
        if process is not None:
            process.quit()
        if self._folder.name.startswith(_PREFIX):
            shutil.rmtree(self._folder, ignore_errors=True)

    def __enter__(self) -> "FmuHost":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def _name(self) -> str:
        return f"FMU {self.path.name}"

    @property
    def _process_now(self) -> _Process:
        if self._process is None:
            raise FmuFault(f"{self._name}: it has failed, and no new run has been started")
        return self._process

    def _unpack(self) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix=_PREFIX))
        extract(self.path, self._folder)
        self._library = library(self.path, self._folder, self.description)

    def _launch(self) -> None:
        description = self.description
        told = {
            "version": description.fmiVersion,
            "folder": str(self._folder),
            "library": str(self._library),
            "identifier": description.coSimulation.modelIdentifier,
            "token": description.guid,
            "inputs": self._inputs,
            "outputs": self._outputs,
        }
        self._process = _Process(self._folder, self._cpus)
        self._used = False
        self._asked(LOAD, json.dumps(told).encode(), self.startup_s, "while it was loaded")

    def _values(self, kind: int, payload: bytes, timeout_s: float, when: str) -> list[float]:
        """The outputs that come as an answer, all of them finite."""
        self.time_s, *values = map(float, self._asked(kind, payload, timeout_s, when).cast("d"))
        if not math.isfinite(sum(values)):
            for name, value in zip(self._names, values, strict=True):
                if not math.isfinite(value):
                    raise self.fault(f"gave {name} = {value:g}")
        return values

    def _asked(self, kind: int, payload: bytes, timeout_s: float, when: str) -> memoryview:
        process = self._process_now
        try:
            answer, data = process.ask(kind, payload, timeout_s)
        except TimeoutError:
            # What it has started may hold its end of the connection open.
            ended = "" if process.running else process.ended()
            which = "timeout_s" if kind == STEP else "startup_s"
            silent = f"did not answer within {timeout_s:g} s ({which} in the map's [fmu])"
            raise self.fault(ended or silent, when) from None
        except _Died:
            raise self.fault(process.ended(), when) from None
        except ProtocolError:
            raise self.fault(_SCRIBBLED, when) from None
        if answer == FAULT:
            raise self.fault(bytes(data).decode(errors="replace"), when)
        expected = (READY, 0) if kind == LOAD else (VALUES, DOUBLE * (1 + len(self._outputs)))
        if (answer, len(data)) != expected:
            raise self.fault(_SCRIBBLED, when)
        return data

    def fault(self, what: str, when: str = "") -> FmuFault:
        """Ends the process, which is no car any more; the fault to raise."""
        words = ""
        if self._process is not None:
            said = self._process.last_words()
            words = f"; its last words: {said}" if said else ""
            self._process.kill()
            self._process = None
        at = when or f"at t = {self.time_s:.6g} s"
        return FmuFault(f"{self._name} {at}: {what}{words}")

    def _numeric(self, name: str) -> tuple[str, int]:
        variable = self._variable(name)
        if variable.type not in _NUMERIC:
            raise InputError(
                f"{self._name}: {name} is of type {variable.type}; inputs and outputs of the car "
                "are numbers"
            )
        return variable.type, variable.valueReference

    def _variable(self, name: str) -> Any:
        variable = self._variables.get(name)
        if variable is None:
            raise InputError(
                f"{self._name} has no variable '{name}'; 'bayesrace fmu inspect' lists them"
            )
        if variable.dimensions:
            raise InputError(f"{self._name}: {name} is an array; only single values can be used")
        return variable

    def _start_values(self, values: Mapping[str, Value]) -> bytes:
        """The question START: each value with its variable's type and reference."""
        told: dict[str, list[Any]] = {"structural": [], "values": []}
        for name, value in values.items():
            variable = self._variable(name)
            entry = ((variable.type, variable.valueReference), self._fitting(variable, value))
            structural = variable.causality == "structuralParameter"
            told["structural" if structural else "values"].append(entry)
        return json.dumps(told).encode()

    def _fitting(self, variable: Any, value: Value) -> Value:
        """The value as the variable's type holds it; InputError if it does not."""
        kind = variable.type
        if kind in ("Real", "Float64", "Float32") and not isinstance(value, str):
            if math.isfinite(value):
                return float(value)
        elif kind == "Boolean" and not isinstance(value, str):
            if value in (0, 1):
                return bool(value)
        elif kind == "String" and isinstance(value, str):
            return value
        elif kind in _NUMERIC and not isinstance(value, str) and _holds(kind, value):
            return int(value)
        raise InputError(f"{self._name}: {variable.name} is of type {kind} and cannot be {value!r}")


def _holds(kind: str, value: float) -> bool:
    """Whether a type of whole numbers has this one."""
    bits = int(kind.lstrip("UInt")) if kind[-1].isdigit() else 64 if kind == "Enumeration" else 32
    low, high = (0, 2**bits) if kind[0] == "U" else (-(2 ** (bits - 1)), 2 ** (bits - 1))
    return math.isfinite(value) and value == int(value) and low <= value < high
