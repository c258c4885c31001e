"""One instance of a Co-Simulation FMU by fmpy: FMI 2.0 and 3.0 behind one interface.

It runs in the FMU's own process. A call that the FMU answers with more than a warning raises
:class:`CallFailed`.
"""

import ctypes
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, Final

from fmpy import read_model_description
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import fmi2Discard, fmi2Terminated
from fmpy.simulation import apply_start_values, instantiate_fmu

__all__ = ["CallFailed", "Instance"]

Transfer = tuple[Callable[[], object], Any, list[int]]

_STATUS: Final = ("ok", "warning", "discard", "error", "fatal", "pending")
_ENDED: Final = "the FMU ended the simulation"


class CallFailed(Exception):  # noqa: N818
    """The FMU did not do what it was called for; the message says what."""


class _Calls:
    """Turns a status worse than a warning into CallFailed."""

    def __enter__(self) -> None:
        pass

    def __exit__(self, _kind: object, error: object, _traceback: object) -> None:
        if isinstance(error, FMICallException):
            known = 0 <= error.status < len(_STATUS)
            status = _STATUS[error.status] if known else f"illegal status {error.status}"
            raise CallFailed(f"{error.function} failed ({status})") from None


_CALLS: Final = _Calls()


class Instance:
    """The unpacked FMU in ``folder``, instantiated by its ``library``.

    ``inputs`` and ``outputs`` name its variables, real numbers, in the order in which values are
    passed; ``log`` takes status and text of its messages. CallFailed if it gives no instance.
    """

    def __init__(
        self,
        *,
        folder: str,
        library: str,
        inputs: Sequence[str],
        outputs: Sequence[str],
        log: Callable[[int, str], None],
    ) -> None:
        self._folder, self._library = folder, library
        self._description = read_model_description(folder, validate=False)
        self._two = self._description.fmiVersion == "2.0"
        variables = {variable.name: variable for variable in self._description.modelVariables}
        self._inputs = [variables[name] for name in inputs]
        self._outputs = [variables[name] for name in outputs]
        self._log = log
        self._make()

    def _make(self) -> None:
        def log(*arguments: Any) -> None:  # environment, instance (FMI 2), status, category, text
            status, _, message = arguments[-3:]
            self._log(status, (message or b"").decode(errors="replace"))

        self._initialised = False
        self.time_s = self._excess_s = 0.0
        folder, description, library = self._folder, self._description, self._library
        try:  # its events are its own to handle, and it is not allowed to return early
            self._fmu = instantiate_fmu(
                folder, description, "CoSimulation", logger=log, library_path=library
            )
        except Exception as error:  # the loader's words, or the first function that is missing
            raise CallFailed(str(error)) from None
        self._set = self._transfers("Set", self._inputs)
        self._get = self._transfers("Get", self._outputs)
        self._values = [0.0] * len(self._outputs)

    def _transfers(self, direction: str, variables: Sequence[Any]) -> list[Transfer]:
        """For each type of variable: the call, its buffer, and positions among all values."""
        version, sizes = ("fmi2", 1) if self._two else ("fmi3", 2)
        transfers: list[Transfer] = []
        for kind in {variable.type for variable in variables}:
            positions = [i for i, variable in enumerate(variables) if variable.type == kind]
            count = len(positions)
            buffer = ((ctypes.c_float if kind == "Float32" else ctypes.c_double) * count)()
            references = (ctypes.c_uint * count)(*(variables[i].valueReference for i in positions))
            arguments = (self._fmu.component, references, count, buffer, count)[: 3 + sizes]
            function = getattr(self._fmu, f"{version}{direction}{kind}")
            transfers.append((partial(function, *arguments), buffer, positions))
        return transfers

    def start(self, values: Mapping[str, Any]) -> None:
        """Set these values and initialise at time zero, a new instance if this one has run."""
        if self._initialised:
            self.free()
            self._make()
        fmu, description = self._fmu, self._description
        self._initialised = True
        with _CALLS:
            if self._two:
                fmu.setupExperiment()
            elif any(_structural(v) and v.name in values for v in description.modelVariables):
                fmu.enterConfigurationMode()
                values = apply_start_values(fmu, description, values, _structural)
                fmu.exitConfigurationMode()
            apply_start_values(fmu, description, values)
            fmu.enterInitializationMode()
            fmu.exitInitializationMode()

    def step(self, step_s: float, count: int, inputs: Sequence[float]) -> None:
        """``count`` communication steps with inputs that hold, or with a row of them for each."""
        begin_s, width = self.time_s, len(self._inputs)
        advance = _advance_2 if self._two else _advance_3
        with _CALLS:
            for k in range(count):
                if row := inputs[k * width : (k + 1) * width]:
                    for set_, buffer, positions in self._set:
                        buffer[:] = [row[position] for position in positions]
                        set_()
                advance(self._fmu, begin_s + k * step_s, step_s)
        # Kahan's sum: rounding does not add up.
        added_s = count * step_s - self._excess_s
        self.time_s = begin_s + added_s
        self._excess_s = (self.time_s - begin_s) - added_s

    def values(self) -> list[float]:
        """The values of the outputs; zeros before initialisation."""
        with _CALLS:
            for get, buffer, positions in self._get if self._initialised else ():
                get()
                for position, value in zip(positions, buffer, strict=True):
                    self._values[position] = value
        return self._values

    def free(self) -> None:
        """Terminate and free the instance, whatever it answers."""
        fmu = self._fmu
        with suppress(FMICallException):
            if self._initialised:  # before, FMI allows no end but to free it
                fmu.terminate()
        (fmu.fmi2FreeInstance if self._two else fmu.fmi3FreeInstance)(fmu.component)


def _structural(variable: Any) -> bool:
    return bool(variable.causality == "structuralParameter")


def _advance_2(fmu: Any, time_s: float, step_s: float) -> None:
    try:
        fmu.doStep(time_s, step_s)
    except FMICallException as error:
        ended = False
        if error.status == fmi2Discard:
            with suppress(Exception):  # it may not know, or lack the function, as FMI allows
                ended = fmu.getBooleanStatus(fmi2Terminated)
        if ended:
            raise CallFailed(_ENDED) from None
        raise


def _advance_3(fmu: Any, time_s: float, step_s: float) -> None:
    _, ended, early, reached_s = fmu.doStep(time_s, step_s)
    if ended:
        raise CallFailed(_ENDED)
    if early:  # nothing has allowed it to
        raise CallFailed(f"fmi3DoStep returned early at {reached_s:.6g} s")
