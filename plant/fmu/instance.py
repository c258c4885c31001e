"""One instance of a Co-Simulation FMU: the calls of FMI 2.0 and 3.0 behind one interface.

Runs in the FMU's own process. Values pass as doubles, packed by type into arrays that are made
once; what the FMU answers other than "OK" or "warning" raises :class:`CallFailed`.
"""

import ctypes
import math
from collections.abc import Callable, Sequence
from typing import Any, Final, Protocol

from fmpy.fmi1 import FMICallException
from fmpy.fmi2 import (
    FMU2Slave,
    defaultCallbacks,
    fmi2CallbackFunctions,
    fmi2CallbackLoggerTYPE,
    fmi2Discard,
    fmi2LastSuccessfulTime,
    fmi2Terminated,
)
from fmpy.fmi3 import FMU3Slave

from plant.fmu.faults import CallFailed

__all__ = ["Instance", "Variable", "load"]

Variable = tuple[str, int]
"""Type, as FMI names it, and value reference."""
Value = float | int | bool | str
Logger = Callable[[int, str, str], None]
"""Takes status, category and message."""

_STATUS: Final = ("ok", "warning", "discard", "error", "fatal", "pending")

_MOST_RETURNS: Final = 10_000
"""Early returns within one step; more is no progress."""

_CTYPES_2: Final[dict[str, tuple[str, Any]]] = {
    "Real": ("Real", ctypes.c_double),
    "Integer": ("Integer", ctypes.c_int),
    "Enumeration": ("Integer", ctypes.c_int),
    "Boolean": ("Boolean", ctypes.c_int),
    "String": ("String", ctypes.c_char_p),
}
_CTYPES_3: Final[dict[str, tuple[str, Any]]] = {
    "Float64": ("Float64", ctypes.c_double),
    "Float32": ("Float32", ctypes.c_float),
    **{
        f"{sign}Int{bits}": (f"{sign}Int{bits}", getattr(ctypes, f"c_{sign.lower()}int{bits}"))
        for sign in ("", "U")
        for bits in (8, 16, 32, 64)
    },
    "Enumeration": ("Int64", ctypes.c_int64),
    "Boolean": ("Boolean", ctypes.c_bool),
    "String": ("String", ctypes.c_char_p),
}


class _Block:
    """Variables of one type, transferred by one call."""

    def __init__(self, ctype: Any, members: Sequence[tuple[int, int]]) -> None:
        """``members``: (position among all values, value reference)."""
        count = len(members)
        self.positions = [position for position, _ in members]
        self.count = count
        self.references = (ctypes.c_uint * count)(*(reference for _, reference in members))
        self.values = (ctype * count)()
        self.real = ctype in (ctypes.c_double, ctypes.c_float)
        self.lowest, self.highest = _bounds(ctype)
        self.run: Any = None
        """The call, arguments bound; set by the instance."""


def _bounds(ctype: Any) -> tuple[int, int]:
    """Whole numbers that the type can hold."""
    if ctype is ctypes.c_bool:
        return 0, 1
    bits = 8 * ctypes.sizeof(ctype)
    signed = ctype(-1).value == -1 if ctype is not ctypes.c_char_p else True
    return (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)


class Instance(Protocol):
    """An instance, or the possibility of one."""

    def instantiate(self) -> None:
        """Make the instance."""

    def initialise(
        self, structural: Sequence[tuple[Variable, Value]], values: Sequence[tuple[Variable, Value]]
    ) -> None:
        """Set structural parameters and start values, and initialise at time zero."""

    def write(self, row: Sequence[float]) -> None:
        """Set the inputs."""

    def read(self, out: Any) -> None:
        """Get the outputs into ``out[0]`` and on."""

    def advance(self, time_s: float, step_s: float) -> None:
        """One communication step from ``time_s``."""

    def free(self) -> None:
        """Terminate and free the instance."""


class _Base:
    """What both versions share."""

    _types: dict[str, tuple[str, Any]]
    _prefix: str

    def __init__(self, fmu: Any, inputs: Sequence[Variable], outputs: Sequence[Variable]) -> None:
        self._fmu = fmu
        self._inputs = self._blocks(inputs)
        self._outputs = self._blocks(outputs)
        self._initialised = False

    def _blocks(self, variables: Sequence[Variable]) -> list[tuple[str, _Block]]:
        by_type: dict[str, list[tuple[int, int]]] = {}
        for position, (kind, reference) in enumerate(variables):
            by_type.setdefault(kind, []).append((position, reference))
        return [
            (self._types[kind][0], _Block(self._types[kind][1], members))
            for kind, members in by_type.items()
        ]

    def _bind(self) -> None:
        """Binds the transfers to the instance that has just been made."""
        self._initialised = False
        for direction, blocks in (("Set", self._inputs), ("Get", self._outputs)):
            for name, block in blocks:
                block.run = self._transfer(direction, name, block.references, block.values)

    def _transfer(self, direction: str, name: str, references: Any, values: Any) -> Any:
        function = getattr(self._fmu, f"{self._prefix}{direction}{name}")
        sizes = (len(references),) if self._prefix == "fmi2" else (len(references), None)
        arguments = [self._fmu.component, references, sizes[0], values]
        if len(sizes) == 2:
            arguments.append(len(values))
        return lambda: _call(function, *arguments)

    def set(self, variable: Variable, value: Value) -> None:
        """Set one variable of any type."""
        name, ctype = self._types[variable[0]]
        given: Any = value.encode() if isinstance(value, str) else value
        transfer = self._transfer("Set", name, (ctypes.c_uint * 1)(variable[1]), (ctype * 1)(given))
        transfer()

    def write(self, row: Sequence[float]) -> None:
        """See :meth:`Instance.write`."""
        for _, block in self._inputs:
            for i, position in enumerate(block.positions):
                value = row[position]
                block.values[i] = (
                    value if block.real else min(max(round(value), block.lowest), block.highest)
                )
            block.run()

    def read(self, out: Any) -> None:
        """See :meth:`Instance.read`."""
        for _, block in self._outputs:
            block.run()
            for position, value in zip(block.positions, block.values, strict=True):
                out[position] = value


def _call(function: Callable[..., Any], *arguments: Any) -> Any:
    """An FMI call; CallFailed if its status is worse than a warning."""
    try:
        return function(*arguments)
    except FMICallException as error:
        known = 0 <= error.status < len(_STATUS)
        status = _STATUS[error.status] if known else f"illegal status {error.status}"
        raise CallFailed(f"{error.function} failed ({status})") from None


class _Fmi2(_Base):
    _types = _CTYPES_2
    _prefix = "fmi2"

    def __init__(
        self, fmu: Any, logger: Logger, inputs: Sequence[Variable], outputs: Sequence[Variable]
    ) -> None:
        super().__init__(fmu, inputs, outputs)

        def log(_environment: Any, _name: Any, status: int, category: Any, message: Any) -> None:
            logger(status, _text(category), _text(message))

        self._callbacks = fmi2CallbackFunctions()
        self._callbacks.logger = fmi2CallbackLoggerTYPE(log)
        self._callbacks.allocateMemory = defaultCallbacks.allocateMemory
        self._callbacks.freeMemory = defaultCallbacks.freeMemory
        try:  # C that fills in the message's arguments, where fmpy has it
            from fmpy.logging import addLoggerProxy

            addLoggerProxy(ctypes.byref(self._callbacks))
        except Exception:  # noqa: S110 - the message then comes with its blanks unfilled
            pass

    def instantiate(self) -> None:
        try:
            self._fmu.instantiate(callbacks=self._callbacks, loggingOn=False)
        except Exception:
            raise CallFailed("fmi2Instantiate gave no instance") from None
        self._bind()

    def initialise(
        self, structural: Sequence[tuple[Variable, Value]], values: Sequence[tuple[Variable, Value]]
    ) -> None:
        _call(self._fmu.setupExperiment)
        for variable, value in (*structural, *values):
            self.set(variable, value)
        _call(self._fmu.enterInitializationMode)
        _call(self._fmu.exitInitializationMode)
        self._initialised = True

    def advance(self, time_s: float, step_s: float) -> None:
        fmu = self._fmu
        try:
            fmu.fmi2DoStep(fmu.component, time_s, step_s, 1)
        except FMICallException as error:
            if error.status == fmi2Discard:
                raise CallFailed(self._discarded()) from None
            _call(_raise, error)

    def _discarded(self) -> str:
        """What the FMU says of a step it has not finished, be it to end the simulation."""
        if self._status(self._fmu.getBooleanStatus, fmi2Terminated):
            return "the FMU ended the simulation"
        reached_s = self._status(self._fmu.getRealStatus, fmi2LastSuccessfulTime)
        reached = "" if reached_s is None else f" (it got to {reached_s:.6g} s)"
        return f"fmi2DoStep discarded the step{reached}"

    @staticmethod
    def _status(get: Callable[[int], Any], kind: int) -> Any:
        """None if the FMU cannot tell, which FMI allows."""
        try:
            return get(kind)
        except Exception:  # or lacks the function
            return None

    def free(self) -> None:
        try:
            if self._initialised:  # before, FMI allows no end but to free it
                _call(self._fmu.fmi2Terminate, self._fmu.component)
        finally:
            self._fmu.fmi2FreeInstance(self._fmu.component)


class _Fmi3(_Base):
    _types = _CTYPES_3
    _prefix = "fmi3"

    def __init__(
        self, fmu: Any, logger: Logger, inputs: Sequence[Variable], outputs: Sequence[Variable]
    ) -> None:
        super().__init__(fmu, inputs, outputs)

        def log(_environment: Any, status: int, category: Any, message: Any) -> None:
            logger(status, _text(category), _text(message))

        self._log = log
        self._event, self._terminate, self._early = (ctypes.c_bool() for _ in range(3))
        self._reached = ctypes.c_double()
        self._told = [
            ctypes.byref(value)
            for value in (self._event, self._terminate, self._early, self._reached)
        ]

    def instantiate(self) -> None:
        # Events are the FMU's own affair, and it is not asked to return early.
        try:
            self._fmu.instantiate(logMessage=self._log)
        except Exception:
            raise CallFailed("fmi3InstantiateCoSimulation gave no instance") from None
        self._bind()

    def initialise(
        self, structural: Sequence[tuple[Variable, Value]], values: Sequence[tuple[Variable, Value]]
    ) -> None:
        fmu = self._fmu
        if structural:
            _call(fmu.enterConfigurationMode)
            for variable, value in structural:
                self.set(variable, value)
            _call(fmu.exitConfigurationMode)
        for variable, value in values:
            self.set(variable, value)
        _call(fmu.enterInitializationMode)
        _call(fmu.exitInitializationMode)
        self._initialised = True

    def advance(self, time_s: float, step_s: float) -> None:
        fmu, end_s = self._fmu, time_s + step_s
        for _ in range(_MOST_RETURNS):
            _call(fmu.fmi3DoStep, fmu.component, time_s, step_s, True, *self._told)
            if self._terminate.value:
                raise CallFailed("the FMU ended the simulation")
            if not self._early.value:
                return
            # It may return early only if it is allowed to; where it does all the same, go on.
            before_s, time_s = time_s, self._reached.value
            step_s = end_s - time_s
            if not time_s > before_s or not math.isfinite(time_s):
                break
            if step_s <= 1e-12:
                return
        raise CallFailed(
            f"fmi3DoStep returned early at {self._reached.value:.6g} s, again and again"
        )

    def free(self) -> None:
        try:
            if self._initialised:  # before, FMI allows no end but to free it
                _call(self._fmu.fmi3Terminate, self._fmu.component)
        finally:
            self._fmu.fmi3FreeInstance(self._fmu.component)


def _raise(error: Exception) -> None:
    raise error


def _text(data: bytes | None) -> str:
    return "" if data is None else data.decode(errors="replace")


def load(
    version: str,
    folder: str,
    library: str,
    identifier: str,
    token: str,
    inputs: Sequence[Variable],
    outputs: Sequence[Variable],
    logger: Logger,
) -> Instance:
    """Loads the unpacked FMU's library; CallFailed if that cannot be done."""
    arguments = {
        "guid": token, "unzipDirectory": folder, "modelIdentifier": identifier,
        "instanceName": identifier, "libraryPath": library,
    }  # fmt: skip
    try:
        if version.startswith("3."):
            return _Fmi3(FMU3Slave(**arguments), logger, inputs, outputs)
        return _Fmi2(FMU2Slave(**arguments), logger, inputs, outputs)
    except Exception as error:  # the loader's words, or the first function that is missing
        raise CallFailed(str(error)) from None
