"""The XML of an FMU: model description (FMI 2.0 and 3.0) and build description (FMI 3.0)."""

import re
from collections.abc import Sequence
from functools import cache
from math import isfinite
from typing import Any, Final
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import pint

from bayesrace.errors import InputError
from codegen.fmu.definition import FmuDefinition, Variable
from codegen.fmu.sources import linked_files

__all__ = ["build_description", "model_description"]

_TYPES: Final = {
    2: {"real": "Real", "integer": "Integer", "boolean": "Boolean"},
    3: {"real": "Float64", "integer": "Int32", "boolean": "Boolean"},
}
_MESSAGES: Final = {
    "Warning": "Settings that a step could not use",
    "Discard": "Why a value was refused",
    "Error": "Why a call was refused or a step failed",
}
"""Statuses that come with a message, and what it says."""

_BASE: Final = {"kilogram": "kg", "meter": "m", "second": "s", "radian": "rad"}

_registry: Final[Any] = cache(pint.UnitRegistry)


def _base_units(unit: str) -> dict[str, str]:
    """Exponents of kg, m, s, rad in a unit like ``N.s2/m2``; InputError if it has a factor."""
    expression = re.sub(r"([a-z])(-?[0-9])", r"\1**\2", unit, flags=re.IGNORECASE)
    base = _registry().Quantity(expression.replace(".", "*")).to_base_units()
    if base.magnitude != 1:
        raise InputError(f"unit '{unit}' is not made of kg, m, s and rad alone")
    return {_BASE[name]: str(int(power)) for name, power in base.unit_items()}


def _text(root: Element) -> bytes:
    indent(root)
    text: bytes = tostring(root, encoding="utf-8", xml_declaration=True)
    return text + b"\n"


def _add_files(parent: Element, tag: str, names: Sequence[str]) -> None:
    for name in names:
        SubElement(parent, tag, name=name)


def model_description(definition: FmuDefinition, token: str) -> bytes:
    """``modelDescription.xml``."""
    two = definition.version == 2
    head = {
        "fmiVersion": f"{definition.version}.0",
        "modelName": definition.name,
        "guid" if two else "instantiationToken": token,
        "description": definition.description,
        "author": "BayesRace contributors",
        "license": "MIT; parts of other authors: see documentation/licenses",
        "generationTool": "BayesRace",
        "variableNamingConvention": "flat",
    }
    root = Element("fmiModelDescription", head)
    state = "FMUstate" if two else "FMUState"
    interface = {
        "modelIdentifier": definition.identifier,
        "canBeInstantiatedOnlyOncePerProcess": "false",
        f"canGetAndSet{state}": "true",
        f"canSerialize{state}": _number(definition.serialises, "boolean"),
    }
    if definition.states:
        abilities = ("providesDirectionalDerivatives", "providesAdjointDerivatives")
        SubElement(root, "ModelExchange", interface | dict.fromkeys(abilities, "true"))
    else:
        interface["canHandleVariableCommunicationStepSize"] = "true"
        parent = SubElement(root, "CoSimulation", interface)
        if two:
            parent.set("canNotUseMemoryManagementFunctions", "true")
            _add_files(SubElement(parent, "SourceFiles"), "File", linked_files(definition, ".c"))
    units = SubElement(root, "UnitDefinitions")
    for unit in sorted({v.unit for v in definition.all_variables if v.unit is not None}):
        SubElement(SubElement(units, "Unit", name=unit), "BaseUnit", _base_units(unit))
    categories = SubElement(root, "LogCategories")
    for status, what in _MESSAGES.items():
        SubElement(categories, "Category", name=f"logStatus{status}", description=what)
    step = repr(definition.default_step_s)
    SubElement(root, "DefaultExperiment", startTime="0", stopTime="10", stepSize=step)
    _variables(root, definition)
    _structure(root, definition)
    return _text(root)


def _number(value: float, kind: str) -> str:
    if kind == "boolean":
        return "true" if value else "false"
    return str(int(value)) if kind == "integer" else repr(float(value))


def _named(variable: Variable, reference: int) -> dict[str, str]:
    attributes = {
        "name": variable.name,
        "valueReference": str(reference),
        "description": variable.description,
        "causality": variable.causality,
        "variability": variable.variability,
    }
    if variable.causality not in ("input", "independent"):  # FMI gives these no 'initial'
        attributes["initial"] = "calculated" if variable.start is None else "exact"
    return attributes


def _typed(variable: Variable) -> dict[str, str]:
    numbers = {name: getattr(variable, name) for name in ("min", "max", "nominal", "start")}
    given = {n: v for n, v in numbers.items() if v is not None and isfinite(v)}
    unit = {} if variable.unit is None else {"unit": variable.unit}
    return unit | {name: _number(value, variable.kind) for name, value in given.items()}


def _variables(root: Element, definition: FmuDefinition) -> None:
    parent = SubElement(root, "ModelVariables")
    for reference, variable in enumerate(definition.all_variables):
        kind = _TYPES[definition.version][variable.kind]
        named, typed = _named(variable, reference), _typed(variable)
        if definition.version == 2:
            SubElement(SubElement(parent, "ScalarVariable", named), kind, typed)
            continue
        element = SubElement(parent, kind, named | typed)
        if variable.derivative_of is not None:
            element.set("derivative", str(definition.states.index(variable.derivative_of)))


def _structure(root: Element, definition: FmuDefinition) -> None:
    """Unknowns and what they depend on: by index, from 1, in FMI 2.0, else by reference."""
    two = definition.version == 2
    place = {v.name: str(i) for i, v in enumerate(definition.variables, start=int(two))}
    outputs = [v for v in definition.variables if v.causality == "output"]
    derivatives = [v for v in definition.variables if v.derivative_of is not None]
    # before the run, calculated outputs are constants, derivatives may depend on all that is set
    given = tuple(v.name for v in definition.variables if v.start is not None)
    initial = [(v, ()) for v in outputs if v.start is None] + [(v, given) for v in derivatives]
    structure = SubElement(root, "ModelStructure")
    for tag, unknowns in (
        ("Output", [(v, v.dependencies) for v in outputs]),
        ("ContinuousStateDerivative", [(v, v.dependencies) for v in derivatives]),
        ("InitialUnknown", initial),
    ):
        if not unknowns:
            continue
        parent = SubElement(structure, f"{tag}s") if two else structure
        for variable, known in unknowns:
            at = {"index" if two else "valueReference": place[variable.name]}
            element = SubElement(parent, "Unknown" if two else tag, at)
            if known is not None:
                element.set("dependencies", " ".join(place[name] for name in known))


def build_description(definition: FmuDefinition, options: Sequence[str]) -> bytes:
    """``sources/buildDescription.xml`` of FMI 3.0; ``options``: of the compiler."""
    root = Element("fmiBuildDescription", fmiVersion="3.0")
    parent = SubElement(root, "BuildConfiguration", modelIdentifier=definition.identifier)
    files = SubElement(parent, "SourceFileSet", language="C11", compilerOptions=" ".join(options))
    _add_files(files, "SourceFile", linked_files(definition, ".c"))
    _add_files(parent, "Library", linked_files(definition, ".a"))
    SubElement(parent, "Library", name="m", external="true")
    return _text(root)
