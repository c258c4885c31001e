"""What an FMU says of itself: interface types, platforms and variables, without running it."""

import math
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, Final, Literal

from plant.fmu.package import read_description
from plant.fmu.units import Unit, UnitDefinition, unit_of

__all__ = ["FmuDescription", "Kind", "Variable", "describe", "inspect"]

Kind = Literal["real", "integer", "boolean", "enumeration", "string", "binary", "clock"]

_KINDS: Final[dict[str, Kind]] = {
    "Real": "real",
    "Float32": "real",
    "Float64": "real",
    "Boolean": "boolean",
    "Enumeration": "enumeration",
    "String": "string",
    "Binary": "binary",
    "Clock": "clock",
}
"""The others are integers of some width."""


@dataclass(frozen=True, slots=True)
class Variable:
    """One of an FMU's variables."""

    name: str
    kind: Kind
    fmi_type: str
    causality: str
    variability: str
    initial: str | None
    unit_name: str | None = None
    unit: Unit | None = None
    """None: not declared, or not understood."""
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


@dataclass(frozen=True, slots=True)
class FmuDescription:
    """An FMU's model description, as far as driving it as the car needs it."""

    model_name: str
    fmi_version: str
    interfaces: tuple[str, ...]
    variables: tuple[Variable, ...]
    description: str = ""
    tool: str = ""
    platforms: tuple[str, ...] = ()
    """Folders of binaries, as the FMI version calls them: linux64, x86_64-linux, …"""
    variable_step: bool = False
    default_step_s: float | None = None
    needs_tool: bool = False

    @property
    def co_simulation(self) -> bool:
        """Whether it brings its own solver, which is what the plant can run."""
        return "Co-Simulation" in self.interfaces


def inspect(path: Path) -> FmuDescription:
    """What the FMU ``path`` says of itself; InputError if it is not an FMU 2 or 3."""
    raw = read_description(path)
    with zipfile.ZipFile(path) as archive:
        parts = [PurePosixPath(name.replace("\\", "/")).parts for name in archive.namelist()]
    platforms = {part[1] for part in parts if len(part) > 2 and part[0] == "binaries"}
    return describe(raw, tuple(sorted(platforms)))


def describe(raw: Any, platforms: Sequence[str] = ()) -> FmuDescription:
    """fmpy's ModelDescription ``raw`` as data of our own."""
    kinds = {
        "Co-Simulation": raw.coSimulation,
        "Model Exchange": raw.modelExchange,
        "Scheduled Execution": raw.scheduledExecution,
    }
    definitions = {unit.name: _definition(unit.baseUnit) for unit in raw.unitDefinitions}
    simulation = raw.coSimulation
    return FmuDescription(
        model_name=raw.modelName or "?",
        fmi_version=raw.fmiVersion,
        interfaces=tuple(name for name, interface in kinds.items() if interface is not None),
        variables=tuple(
            _variable(variable, definitions)
            for variable in raw.modelVariables
            if variable.causality != "independent"
        ),
        description=raw.description or "",
        tool=raw.generationTool or "",
        platforms=tuple(platforms),
        variable_step=bool(simulation and simulation.canHandleVariableCommunicationStepSize),
        default_step_s=_step(raw),
        needs_tool=bool(simulation and simulation.needsExecutionTool),
    )


def _step(raw: Any) -> float | None:
    fixed = raw.coSimulation.fixedInternalStepSize if raw.coSimulation else None
    experiment = raw.defaultExperiment.stepSize if raw.defaultExperiment else None
    return _number(fixed) or _number(experiment)


def _number(text: Any) -> float | None:
    try:
        value = float(text)
    except (TypeError, ValueError):
        return None
    return value if math.isfinite(value) else None


def _definition(base: Any) -> UnitDefinition | None:
    if base is None:
        return None
    exponents = (base.kg, base.m, base.s, base.A, base.K, base.mol, base.cd, base.rad)
    return UnitDefinition(exponents, base.factor, base.offset)


def _variable(raw: Any, definitions: Mapping[str, UnitDefinition | None]) -> Variable:
    declared = raw.declaredType

    def attribute(name: str) -> str | None:
        own = getattr(raw, name, None)
        value = own if own is not None or declared is None else getattr(declared, name, None)
        return None if value is None else str(value)

    unit_name = attribute("unit")
    lowest, highest = _number(attribute("min")), _number(attribute("max"))
    items = {} if declared is None else {str(i.name): _item(i.value) for i in declared.items}
    return Variable(
        name=raw.name,
        kind=_KINDS.get(raw.type, "integer"),
        fmi_type=raw.type,
        causality=raw.causality,
        variability=raw.variability,
        initial=raw.initial,
        unit_name=unit_name,
        unit=unit_of(unit_name, definitions.get(unit_name or "")),
        lowest=-math.inf if lowest is None else lowest,
        highest=math.inf if highest is None else highest,
        start=raw.start,
        description=raw.description or "",
        array=bool(raw.dimensions),
        items=items,
    )


def _item(value: Any) -> int:
    number = _number(value)
    return 0 if number is None else int(number)
