"""One instance of a Co-Simulation FMU by fmpy: FMI 2.0 and 3.0 behind one interface.

It runs in the FMU's own process. A call that the FMU answers with more than a warning raises
:class:`CallFailed`.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Final

from fmpy import read_model_description
from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import fmi2Discard, fmi2Terminated
from fmpy.simulation import apply_start_values, instantiate_fmu

__all__ = ["CallFailed", "Instance"]

_STATUS: Final = ("ok", "warning", "discard", "error", "fatal", "pending")
_ENDED: Final = "the FMU ended the simulation"


class CallFailed(Exception):  # noqa: N818
    """The FMU did not do what it was called for; the message says what."""


@contextmanager
def _calls() -> Iterator[None]:
    """Turns a status worse than a warning into CallFailed."""
    try:
        yield
    except FMICallException as error:
        known = 0 <= error.status < len(_STATUS)
        status = _STATUS[error.status] if known else f"illegal status {error.status}"
        raise CallFailed(f"{error.function} failed ({status})") from None


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
        self._inputs, self._outputs = (
            _by_type([variables[name] for name in names]) for names in (inputs, outputs)
        )
        self._width, self._values = len(inputs), [0.0] * len(outputs)
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

    def start(self, values: Mapping[str, Any]) -> None:
        """Set these values and initialise at time zero, a new instance if this one has run."""
        if self._initialised:
            self.free()
            self._make()
        fmu, description = self._fmu, self._description
        self._initialised = True
        with _calls():
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
        begin_s, width = self.time_s, self._width
        advance = _advance_2 if self._two else _advance_3
        with _calls():
            for k in range(count):
                if row := inputs[k * width : (k + 1) * width]:
                    for kind, references, positions in self._inputs:
                        getattr(self._fmu, f"set{kind}")(references, [row[i] for i in positions])
                advance(self._fmu, begin_s + k * step_s, step_s)
        # Kahan's sum: rounding does not add up.
        added_s = count * step_s - self._excess_s
        self.time_s = begin_s + added_s
        self._excess_s = (self.time_s - begin_s) - added_s

    def values(self) -> list[float]:
        """The values of the outputs; zeros before initialisation."""
        with _calls():
            for kind, references, positions in self._outputs if self._initialised else ():
                values = getattr(self._fmu, f"get{kind}")(references)
                for position, value in zip(positions, values, strict=True):
                    self._values[position] = value
        return self._values

    def free(self) -> None:
        """Terminate and free the instance, whatever it says to that."""
        fmu = self._fmu
        with suppress(FMICallException):
            if self._initialised:  # before, FMI allows no end but to free it
                fmu.terminate()
        (fmu.fmi2FreeInstance if self._two else fmu.fmi3FreeInstance)(fmu.component)


def _structural(variable: Any) -> bool:
    return bool(variable.causality == "structuralParameter")


def _by_type(variables: Sequence[Any]) -> list[tuple[str, list[int], list[int]]]:
    """Variables that one call transfers: type, references, positions among all values."""
    groups: dict[str, tuple[str, list[int], list[int]]] = {}
    for position, variable in enumerate(variables):
        _, references, positions = groups.setdefault(variable.type, (variable.type, [], []))
        references.append(variable.valueReference)
        positions.append(position)
    return list(groups.values())


def _advance_2(fmu: Any, time_s: float, step_s: float) -> None:
    try:
        fmu.doStep(time_s, step_s)
    except FMICallException as error:
        ended = False
        if error.status == fmi2Discard:
            with suppress(Exception):  # it may not say, or lack the function, as FMI allows
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
