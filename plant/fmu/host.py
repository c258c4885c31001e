"""A Co-Simulation FMU in a process of its own, behind calls that end in time.

Whatever the FMU does, the plant gets an answer in time or a :class:`FmuFault` that says what
happened.
"""

import json
import math
import os
import struct
from array import array
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bayesrace.errors import InputError
from plant.fmu.faults import FmuFault
from plant.fmu.process import SCRIBBLED, FmuProcess, WorkerFailed
from plant.fmu.wiring import Value

__all__ = ["FmuHost"]


class FmuHost:
    """An FMU, ready to run; close it when done.

    ``description``: fmpy's. ``inputs`` and ``outputs`` name its variables, real numbers, in the
    order in which values are passed. ``timeout_s``: how long it may take for a step; ``startup_s``:
    for loading, and for an initialisation; tools behind it may have to start too.

    Raises InputError if it is not for this computer, or cannot be loaded and instantiated. On Linux
    the FMU ends with the thread that started it: use one that stays.
    """

    def __init__(
        self,
        path: Path,
        description: Any,
        inputs: Sequence[str],
        outputs: Sequence[str],
        *,
        timeout_s: float,
        startup_s: float,
    ) -> None:
        if os.name != "posix":
            raise InputError("an FMU as the plant needs Linux or macOS: run the plant there")
        self.path, self.timeout_s, self.startup_s = path, timeout_s, startup_s
        self.time_s = 0.0
        """Time that the FMU has reached."""
        self._description, self._outputs = description, tuple(outputs)
        self._answer = struct.Struct(f"=c{1 + len(self._outputs)}d")
        self._told: dict[str, Any] = {
            "cpus": sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [],
            "inputs": tuple(inputs),
            "outputs": tuple(outputs),
        }
        self._process: FmuProcess | None = None
        self._used = False
        try:
            self._launch()
        except FmuFault as fault:
            raise InputError(f"{fault}: use another FMU, or repair this one") from None

    def start(self, values: Mapping[str, Value]) -> list[float]:
        """A new instance with these values set before its initialisation; its outputs at t = 0.

        Raises FmuFault if the FMU fails.
        """
        process = self._process
        once = self._description.coSimulation.canBeInstantiatedOnlyOncePerProcess
        if process is not None and (not process.running or (once and self._used)):
            self.close()
        if self._process is None:
            self._launch()
        self._used, self.time_s = True, 0.0
        self._running.output.restart()
        question = b"s" + json.dumps(dict(values)).encode()
        return self._values(question, self.startup_s, "startup_s", "while it was initialised")

    def step(self, inputs: Sequence[float], step_s: float, count: int = 1) -> list[float]:
        """Its outputs after ``count`` communication steps of ``step_s``.

        ``inputs``: held for all of them, or a row for each, one after the other. FmuFault if the
        FMU fails; it is then gone, and :meth:`start` begins with a new one.
        """
        question = b"d" + array("d", (step_s, count, *inputs)).tobytes()
        return self._values(question, self.timeout_s, "timeout_s", "")

    def close(self) -> None:
        """End the process and remove the unpacked files."""
        process, self._process = self._process, None
        if process is not None:
            process.quit()

    def __enter__(self) -> "FmuHost":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def fault(self, what: str, when: str = "") -> FmuFault:
        """Ends the process, which is no car any more; the fault to raise."""
        words = ""
        process, self._process = self._process, None
        if process is not None:
            said = process.output.last_words()
            words = f"; its last words: {said}" if said else ""
            process.kill()
        at = when or f"at t = {self.time_s:.6g} s"
        return FmuFault(f"FMU {self.path.name} {at}: {what}{words}")

    @property
    def _running(self) -> FmuProcess:
        if self._process is None:
            raise FmuFault(f"FMU {self.path.name}: it has failed, and no new run has been started")
        return self._process

    def _launch(self) -> None:
        self._process = FmuProcess(self.path, self._description, self._told)
        self._used = False
        self._values(b"", self.startup_s, "startup_s", "while it was loaded")

    def _values(self, question: bytes, timeout_s: float, setting: str, when: str) -> list[float]:
        """The outputs that come as an answer, all of them finite."""
        try:
            answer = self._running.ask(question, timeout_s, setting)
        except WorkerFailed as failure:
            raise self.fault(str(failure), when) from None
        if answer[:1] == b"f":
            raise self.fault(answer[1:].decode(errors="replace"), when)
        if len(answer) != self._answer.size or answer[:1] != b"v":
            raise self.fault(SCRIBBLED, when)
        _, self.time_s, *values = self._answer.unpack(answer)
        for name, value in zip(self._outputs, values, strict=True):
            if not math.isfinite(value):
                raise self.fault(f"gave {name} = {value:g}")
        return values
