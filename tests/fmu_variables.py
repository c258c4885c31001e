"""Descriptions of FMUs that exist on paper only: what a map is checked against."""

import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final
from xml.sax.saxutils import quoteattr

import numpy as np
from fmpy.model_description import (
    CoSimulation,
    Item,
    ModelDescription,
    ModelExchange,
    ModelVariable,
    SimpleType,
)

from bayesrace.arrays import Floats
from bayesrace.plant.fmu.wiring import STATES, Wiring

__all__ = [
    "OWN", "STATE", "TOLERANCE", "U", "assert_same", "description", "given",
    "our_names", "own_fmu", "read", "replacing", "taken", "values", "variable", "write_fmu",
]  # fmt: skip

_INITIAL: Final = {"input": "exact", "parameter": "exact", "output": "calculated"}
_VARIABILITY: Final = {"parameter": "fixed"}


def variable(name: str, causality: str = "output", unit: str | None = None, **more: Any) -> Any:
    """A real variable as an FMU would declare it; inputs and parameters start at 0.

    ``items``: makes it an enumeration.
    """
    settings: dict[str, Any] = {
        "type": "Float64",
        "variability": _VARIABILITY.get(causality, "continuous"),
        "initial": _INITIAL.get(causality, "calculated"),
        "start": None if causality == "output" else "0",
    }
    items = [Item(one, str(number)) for one, number in more.pop("items", {}).items()]
    declared = SimpleType(items=items) if items else None
    settings |= {"unit": unit, "declaredType": declared} | more
    return ModelVariable(name=name, causality=causality, **settings)


def given(name: str, unit: str | None = None, **more: Any) -> Any:
    """An output."""
    return variable(name, "output", unit, **more)


def taken(name: str, unit: str | None = None, **more: Any) -> Any:
    """An input."""
    return variable(name, "input", unit, **more)


OWN: Final = (
    *(given(name, unit, initial="exact", start="0") for name, unit in STATES.items()),
    taken("d", "1", min="-0.1", max="1.0"),
    taken("delta_rate", "rad/s"),
    variable("mass_kg", "parameter", "kg", start="0.041", min="0.001", description="mass"),
)
"""The variables of our own FMU."""


def description(*variables: Any, cosimulation: bool = True, name: str = "Paper") -> Any:
    """An FMU with these variables, for Co-Simulation or else Model Exchange."""
    fmu = ModelDescription("3.0", name, modelVariables=list(variables))
    fmu.coSimulation = CoSimulation() if cosimulation else None
    fmu.modelExchange = None if cosimulation else ModelExchange()
    return fmu


def own_fmu(*replaced: Any, without: tuple[str, ...] = ()) -> Any:
    """Our own FMU less the variables named, with others added."""
    return description(*(one for one in OWN if one.name not in without), *replaced)


def write_fmu(path: Path, variables: str, *, version: str = "3.0", types: str = "") -> Path:
    """An archive with this XML inside ModelVariables and TypeDefinitions, and an empty binary."""
    token = "guid" if version.startswith("2") else "instantiationToken"
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(
            "modelDescription.xml",
            f"<fmiModelDescription fmiVersion={quoteattr(version)} modelName='Paper' {token}='1'>"
            "<CoSimulation modelIdentifier='Paper' canHandleVariableCommunicationStepSize='true'/>"
            f"<TypeDefinitions>{types}</TypeDefinitions>"
            "<DefaultExperiment stepSize='0.004'/>"
            f"<ModelVariables>{variables}</ModelVariables><ModelStructure/>"
            "</fmiModelDescription>",
        )
        archive.writestr("binaries/x86_64-linux/Paper.so", b"")
    return path


STATE = np.array([1.5, -2.25, 0.75, 1.8, -0.3, 4.5, 0.2])
"""A car in a left turn, sliding outwards."""

U = (0.4, -2.0)
TOLERANCE = 1e-12
Say = Callable[[Floats], dict[str, float]]


def values(wiring: Wiring, said: dict[str, float]) -> list[float]:
    return [said[name] for name in wiring.outputs]


def read(wiring: Wiring, say: Say, state: Floats, start: Floats | None = None) -> Floats:
    """The state that the wiring makes of what the FMU says after a start elsewhere."""
    first = state - np.array([0.01, 0.02, 0.05, 0, 0, 0, 0]) if start is None else start
    wiring.start_values(first)
    wiring.begin(values(wiring, say(first)), first)
    return wiring.state(values(wiring, say(state)), U, 0.02)


def our_names(state: Floats) -> dict[str, float]:
    names = ("x", "y", "psi", "vx", "vy", "omega", "delta")
    return dict(zip(names, map(float, state), strict=True))


def replacing(*quantities: str, **theirs: Callable[[dict[str, float]], float]) -> Say:
    """An FMU that says our names but these quantities, and others instead."""

    def say(state: Floats) -> dict[str, float]:
        own = our_names(state)
        others = {name: value(own) for name, value in theirs.items()}
        return {k: v for k, v in own.items() if k not in quantities} | others

    return say


def assert_same(state: Floats, wanted: Floats) -> None:
    assert np.abs(state - wanted).max() < TOLERANCE, state - wanted
