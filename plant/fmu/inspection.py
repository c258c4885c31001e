"""The content of an FMU's model description, read without running the FMU."""

import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, Final

from plant.fmu.package import read_description
from plant.fmu.units import Unit, unit_of

__all__ = ["FmuDescription", "Variable", "describe", "inspect"]

_KINDS: Final = {
    "Real": "real", "Float32": "real", "Float64": "real", "Boolean": "boolean",
    "Enumeration": "enumeration", "String": "string", "Binary": "binary", "Clock": "clock",
}  # fmt: skip
"""Of variables by FMI's types; the other types are integers of some width."""


@dataclass(frozen=True, slots=True)
class Variable:
    """One of an FMU's variables."""

    name: str
    kind: str
    fmi_type: str
    causality: str
    variability: str
    initial: str | None
    unit_name: str | None = None
    unit: Unit | None = None
    """None: not declared, or not known."""
    lowest: float = -math.inf
    highest: float = math.inf
    start: str | None = None
    description: str = ""
    array: bool = False
    items: Mapping[str, int] = field(default_factory=dict)
    """An enumeration's names and values."""

    @property
    def settable(self) -> bool:
        """Whether its start value can be set before initialisation."""
        return self.variability != "constant" and (
            self.initial in ("exact", "approx") or self.causality == "input"
        )

    @property
    def readable(self) -> bool:
        """Whether it can be read while the FMU runs."""
        return self.causality in ("output", "local")

    @property
    def scalar(self) -> bool:
        """Whether it is a single real number."""
        return self.kind == "real" and not self.array


@dataclass(frozen=True, slots=True)
class FmuDescription:
    """An FMU's model description, as far as the plant needs it."""

    model_name: str
    fmi_version: str
    interfaces: tuple[str, ...]
    variables: tuple[Variable, ...]
    description: str = ""
    tool: str = ""
    platforms: tuple[str, ...] = ()
    """Folders of binaries, as the FMI version calls them: linux64, x86_64-linux, …"""
    variable_step: bool = False
    internal_step_s: float | None = None
    experiment_step_s: float | None = None
    needs_tool: bool = False

    @property
    def default_step_s(self) -> float | None:
        """The FMU's own step, if it states one."""
        return self.internal_step_s or self.experiment_step_s

    @property
    def co_simulation(self) -> bool:
        """Whether it brings its own solver; the plant has none for it."""
        return "Co-Simulation" in self.interfaces


def inspect(path: Path) -> FmuDescription:
    """The description of the FMU ``path``; InputError if it is not an FMU 2 or 3."""
    raw = read_description(path)
    with zipfile.ZipFile(path) as archive:
        parts = [PurePosixPath(name.replace("\\", "/")).parts for name in archive.namelist()]
    platforms = {part[1] for part in parts if len(part) > 2 and part[0] == "binaries"}
    return describe(raw, tuple(sorted(platforms)))


def describe(raw: Any, platforms: tuple[str, ...] = ()) -> FmuDescription:
    """fmpy's ModelDescription ``raw`` as data of our own."""
    simulation, experiment = raw.coSimulation, raw.defaultExperiment
    kinds = {
        "Co-Simulation": simulation,
        "Model Exchange": raw.modelExchange,
        "Scheduled Execution": raw.scheduledExecution,
    }
    units = {unit.name: unit_of(unit.name, unit.baseUnit) for unit in raw.unitDefinitions}
    variables = (one for one in raw.modelVariables if one.causality != "independent")
    return FmuDescription(
        model_name=raw.modelName or "?",
        fmi_version=raw.fmiVersion,
        interfaces=tuple(name for name, interface in kinds.items() if interface is not None),
        variables=tuple(_variable(one, units) for one in variables),
        description=raw.description or "",
        tool=raw.generationTool or "",
        platforms=platforms,
        variable_step=bool(simulation and simulation.canHandleVariableCommunicationStepSize),
        internal_step_s=_number(simulation and simulation.fixedInternalStepSize),
        experiment_step_s=_number(experiment and experiment.stepSize),
        needs_tool=bool(simulation and simulation.needsExecutionTool),
    )


def _number(text: Any, otherwise: Any = None) -> Any:
    try:
        value = float(text)
    except (TypeError, ValueError):
        return otherwise
    return value if math.isfinite(value) else otherwise


def _variable(raw: Any, units: Mapping[str, Unit | None]) -> Variable:
    declared = raw.declaredType

    def attribute(name: str) -> Any:
        """Of the variable, or else of its declared type."""
        own = getattr(raw, name, None)
        return getattr(declared, name, None) if own is None else own

    unit_name = attribute("unit")
    return Variable(
        name=raw.name,
        kind=_KINDS.get(raw.type, "integer"),
        fmi_type=raw.type,
        causality=raw.causality,
        variability=raw.variability,
        initial=raw.initial,
        unit_name=unit_name,
        unit=units[unit_name] if unit_name in units else unit_of(unit_name),
        lowest=_number(attribute("min"), -math.inf),
        highest=_number(attribute("max"), math.inf),
        start=raw.start,
        description=raw.description or "",
        array=bool(raw.dimensions),
        items={str(i.name): int(_number(i.value, 0)) for i in declared.items} if declared else {},
    )
