"""The process that an FMU runs in: whatever the FMU does to its process, it does to this one.

:class:`bayesrace.plant.fmu.host.FmuHost` runs this module; its standard input ends when the plant
ends. The first question says on which processors to run and which inputs and outputs count. The
others are a mapping of start values, or what :meth:`_Instance.step` takes. The answer is the
outputs (zeros before a start), or a text that says what failed.
"""

import os
import shutil
import signal
import socket
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, Final

from fmpy import read_model_description
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import fmi2Discard, fmi2Terminated
from fmpy.simulation import apply_start_values, instantiate_fmu
from msgspec import msgpack

__all__ = ["LONGEST"]

LONGEST: Final = 1 << 16
"""Bytes of a question or an answer; the longest carry start values."""

_STATUS: Final = dict(enumerate(("info", "warning", "discard", "error", "fatal", "pending")))
_LONGEST_MESSAGE: Final = 1000
"""Characters of the FMU's log."""


def _serve(plant: socket.socket, folder: str, library: str) -> None:
    """Loads the unpacked FMU and answers the plant until it sends None."""
    os.chdir(folder)  # what an FMU writes beside itself is removed with it
    plant.set_inheritable(False)  # not for what the FMU starts
    watch = threading.Thread(target=_end_with_the_plant, args=(folder,), daemon=True)
    watch.start()
    try:
        cpus, inputs, outputs = msgpack.decode(plant.recv(LONGEST))
        # An FMU that hangs must not keep the plant off a CPU.
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        os.sched_setaffinity(0, cpus)
        instance = _Instance(folder, library, inputs, outputs)
        while True:
            plant.send(msgpack.encode(instance.values()))
            match msgpack.decode(plant.recv(LONGEST)):
                case None:
                    return instance.free()
                case dict() as values:
                    instance.start(values)
                case step:
                    instance.step(*step)
    except Exception as error:  # the FMU's refusal, or the loader's words
        with suppress(ConnectionError):
            plant.send(msgpack.encode(_words(error)))
        watch.join()  # the plant ends this process, or has ended itself


def _words(error: Exception) -> str:
    if isinstance(error, FMICallException):
        status = _STATUS.get(error.status, f"illegal status {error.status}")
        return f"{error.function} failed ({status})"
    return str(error)[:4000]


def _end_with_the_plant(folder: str) -> None:
    """At the plant's death: end, also while the FMU computes, and what it has started."""
    with suppress(OSError):  # the FMU may have closed it
        while os.read(0, 1):
            pass
    shutil.rmtree(folder, ignore_errors=True)
    os.killpg(0, signal.SIGKILL)


def _log(*arguments: Any) -> None:
    """Takes (environment, instance in FMI 2, status, category, text) to standard output."""
    status, _, message = arguments[-3:]
    text = " ".join((message or b"").decode(errors="replace")[:_LONGEST_MESSAGE].split())
    with suppress(OSError):  # the FMU may have closed it
        os.write(1, f"[FMU {_STATUS.get(status, status)}] {text}\n".encode(errors="replace"))


class _Instance:
    """One instance of the unpacked FMU: FMI 2.0 and 3.0 by fmpy, behind one interface.

    ``inputs`` and ``outputs`` name its variables, real numbers, in the order in which values are
    passed. Whatever fmpy raises if the FMU gives no instance, or answers a call with more than a
    warning.
    """

    def __init__(
        self, folder: str, library: str, inputs: Sequence[str], outputs: Sequence[str]
    ) -> None:
        self._folder, self._library = folder, library
        self._description = read_model_description(folder, validate=False)
        self._two = self._description.fmiVersion == "2.0"
        variables = {variable.name: variable for variable in self._description.modelVariables}
        self._inputs = [variables[name] for name in inputs]
        self._outputs = [variables[name] for name in outputs]
        self._make()

    def _make(self) -> None:
        # Its events are its own to handle, and it is not allowed to return early.
        self._fmu = instantiate_fmu(
            self._folder, self._description, "CoSimulation", logger=_log, library_path=self._library
        )
        self._set = self._by_type("set", self._inputs)
        self._get = self._by_type("get", self._outputs)
        self._initialised = False

    def _by_type(
        self, verb: str, variables: Sequence[Any]
    ) -> list[tuple[Callable[..., Any], list[int]]]:
        """For each type: fmpy's function for its variables, and their places among all."""
        calls: list[tuple[Callable[..., Any], list[int]]] = []
        for kind in {variable.type for variable in variables}:
            places = [i for i, variable in enumerate(variables) if variable.type == kind]
            references = [variables[i].valueReference for i in places]
            calls.append((partial(getattr(self._fmu, f"{verb}{kind}"), references), places))
        return calls

    def start(self, values: Mapping[str, Any]) -> None:
        """Set these values and initialise at time zero, a new instance if this one has run."""
        if self._initialised:
            self.free()
            self._make()
        fmu, self._initialised = self._fmu, True
        if self._two:
            fmu.setupExperiment()
        apply_start_values(fmu, self._description, values)
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()

    def step(self, step_s: float, count: int, begin_s: float, inputs: Sequence[float]) -> None:
        """``count`` communication steps with inputs that hold, or with a row of them for each."""
        width = len(self._inputs)
        for k in range(count):
            if row := inputs[k * width : (k + 1) * width]:
                for set_, places in self._set:
                    set_([row[place] for place in places])
            self._advance(begin_s + k * step_s, step_s)

    def _advance(self, time_s: float, step_s: float) -> None:
        """One communication step, which has to be whole."""
        try:
            whole = (False, False, False, time_s + step_s)  # FMI 2 has no answer
            _, ended, early, reached_s = self._fmu.doStep(time_s, step_s) or whole
        except FMICallException as error:
            ended = early = False
            if self._two and error.status == fmi2Discard:
                with suppress(Exception):  # it may not know, or lack the function, as FMI allows
                    ended = self._fmu.getBooleanStatus(fmi2Terminated)
            if not ended:
                raise
        if ended:
            raise RuntimeError("the FMU ended the simulation")
        if early:  # nothing has allowed it to
            raise RuntimeError(f"fmi3DoStep returned early at {reached_s:.6g} s")

    def values(self) -> list[float]:
        """The values of the outputs; zeros before initialisation."""
        values = [0.0] * len(self._outputs)
        for get, places in self._get if self._initialised else ():
            for place, value in zip(places, get(), strict=True):
                values[place] = value
        return values

    def free(self) -> None:
        """Terminate and free the instance, whatever it answers."""
        fmu = self._fmu
        with suppress(FMICallException):
            if self._initialised:  # before, FMI allows no end but to free it
                fmu.terminate()
        (fmu.fmi2FreeInstance if self._two else fmu.fmi3FreeInstance)(fmu.component)


if __name__ == "__main__":
    _serve(socket.socket(fileno=int(sys.argv[1])), *sys.argv[2:])
