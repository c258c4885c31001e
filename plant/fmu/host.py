"""A Co-Simulation FMU in a process of its own, behind calls that end in time.

Whatever the FMU does, the plant gets an answer or a :class:`FmuFault` that says what happened.
"""

import json
import math
import os
import struct
import sys
from array import array
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bayesrace.errors import InputError
from plant.fmu.faults import FmuFault
from plant.fmu.process import FmuProcess, WorkerFailed
from plant.fmu.wiring import Value
from plant.fmu.worker import LONGEST

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
        if sys.platform != "linux":
            raise InputError("an FMU as the plant needs Linux: run the plant there")
        self.path, self.timeout_s, self.startup_s = path, timeout_s, startup_s
        self.time_s = 0.0
        """Time that the FMU has reached."""
        self._description, self._outputs = description, tuple(outputs)
        self._answer = struct.Struct(f"=c{1 + len(outputs)}d")
        cpus = sorted(os.sched_getaffinity(0))
        self._arguments = {"cpus": cpus, "inputs": tuple(inputs), "outputs": tuple(outputs)}
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
        once = self._description.coSimulation.canBeInstantiatedOnlyOncePerProcess
        if self._process is not None and (not self._process.running or (once and self._used)):
            self.close()
        process = self._process or self._launch()
        process.output.restart()
        self._used, self.time_s = True, 0.0
        return self._values(b"s" + json.dumps(dict(values)).encode(), "while it was initialised")

    def step(self, inputs: Sequence[float], step_s: float, count: int = 1) -> list[float]:
        """Its outputs after ``count`` communication steps of ``step_s``.

        ``inputs``: held for all of them, or a row for each, one after the other. FmuFault if the
        FMU fails; it is then gone, and :meth:`start` begins with a new one.
        """
        return self._values(b"d" + array("d", (step_s, count, *inputs)).tobytes())

    def close(self) -> None:
        """End the process and remove the unpacked files."""
        process, self._process = self._process, None
        if process is not None:
            process.quit()

    def fault(self, what: str, when: str = "") -> FmuFault:
        """Ends the process, which is no car any more; the fault to raise."""
        process, self._process = self._process, None
        words = process.output.last_message() if process is not None else ""
        if process is not None:
            process.kill()
        at = when or f"at t = {self.time_s:.6g} s"
        last = f"; its last message: {words}" if words else ""
        return FmuFault(f"FMU {self.path.name} {at}: {what}{last}")

    def _launch(self) -> FmuProcess:
        try:
            process = FmuProcess(self.path, self._description, self._arguments)
        except OSError as error:  # no memory, processes, descriptors or disk left
            why = error.strerror or str(error)
            raise FmuFault(f"FMU {self.path.name}: its process does not start: {why}") from None
        self._process, self._used = process, False
        self._values(b"", "while it was loaded")
        return process

    def _values(self, question: bytes, when: str = "") -> list[float]:
        """The outputs that the worker answers, all of them finite; ``when``: at the start."""
        if self._process is None:
            raise FmuFault(f"FMU {self.path.name}: it has failed, and no new run has been started")
        if len(question) > LONGEST:
            raise self.fault(
                "too many values at once: set fewer in the map, or a longer step_s", when
            )
        limit = ("startup_s", self.startup_s) if when else ("timeout_s", self.timeout_s)
        try:
            answer = self._process.ask(question, *limit)
        except WorkerFailed as failure:
            raise self.fault(str(failure), when) from None
        if answer[:1] == b"f":
            raise self.fault(answer[1:].decode(errors="replace"), when)
        if len(answer) != self._answer.size or answer[:1] != b"v":
            raise self.fault("wrote to its process's connection with the plant", when)
        _, self.time_s, *values = self._answer.unpack(answer)
        for name, value in zip(self._outputs, values, strict=True):
            if not math.isfinite(value):
                raise self.fault(f"gave {name} = {value:g}")
        return values
