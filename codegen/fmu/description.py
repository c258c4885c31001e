"""The XML of an FMU: model description (FMI 2.0 and 3.0) and build description (FMI 3.0)."""

import re
from collections.abc import Mapping, Sequence
from functools import cache
from math import isfinite
from typing import Any, Final
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import pint

from bayesrace.errors import InputError
from codegen.fmu.build import FLAGS
from codegen.fmu.definition import FmuDefinition

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


def _add(parent: Element, tag: str, many: Sequence[Mapping[str, str]]) -> None:
    for attributes in many:
        SubElement(parent, tag, dict(attributes))


def _named(names: Sequence[str], end: str) -> list[dict[str, str]]:
    return [{"name": name} for name in names if name.endswith(end)]


def model_description(definition: FmuDefinition, token: str, linked: Sequence[str]) -> bytes:
    """``modelDescription.xml``; ``linked``: what the compiler is given."""
    two = definition.version == 2
    root = Element(
        "fmiModelDescription",
        {
            "fmiVersion": f"{definition.version}.0",
            "modelName": definition.name,
            "guid" if two else "instantiationToken": token,
            "description": definition.description,
            "author": "BayesRace contributors",
            "license": "MIT; parts of other authors: see documentation/licenses",
            "generationTool": "BayesRace",
            "variableNamingConvention": "flat",
        },
    )
    state = "FMUstate" if two else "FMUState"
    abilities = {
        "modelIdentifier": definition.identifier,
        "canBeInstantiatedOnlyOncePerProcess": "false",
        f"canGetAndSet{state}": "true",
        f"canSerialize{state}": _number(definition.serialises, "boolean"),
    }
    if definition.states:
        SubElement(root, "ModelExchange", abilities, providesDirectionalDerivatives="true")
    else:
        abilities["canHandleVariableCommunicationStepSize"] = "true"
        parent = SubElement(root, "CoSimulation", abilities)
        if two:
            parent.set("canNotUseMemoryManagementFunctions", "true")
            _add(SubElement(parent, "SourceFiles"), "File", _named(linked, ".c"))
    units = SubElement(root, "UnitDefinitions")
    for unit in sorted({v.unit for v in definition.all_variables if v.unit is not None}):
        SubElement(SubElement(units, "Unit", name=unit), "BaseUnit", _base_units(unit))
    messages = [{"name": f"logStatus{name}", "description": t} for name, t in _MESSAGES.items()]
    _add(SubElement(root, "LogCategories"), "Category", messages)
    step = repr(definition.default_step_s)
    SubElement(root, "DefaultExperiment", startTime="0", stopTime="10", stepSize=step)
    _variables(SubElement(root, "ModelVariables"), definition)
    _structure(SubElement(root, "ModelStructure"), definition)
    return _text(root)


def _number(value: float, kind: str) -> str:
    if kind == "boolean":
        return "true" if value else "false"
    return str(int(value)) if kind == "integer" else repr(float(value))


def _variables(parent: Element, definition: FmuDefinition) -> None:
    for reference, variable in enumerate(definition.all_variables):
        kind = _TYPES[definition.version][variable.kind]
        named = {
            "name": variable.name,
            "valueReference": str(reference),
            "description": variable.description,
            "causality": variable.causality,
            "variability": variable.variability,
        }
        if variable.causality not in ("input", "independent"):  # FMI gives these no 'initial'
            named["initial"] = "calculated" if variable.start is None else "exact"
        typed = {} if variable.unit is None else {"unit": variable.unit}
        for name in ("min", "max", "nominal", "start"):
            value = getattr(variable, name)
            if value is not None and isfinite(value):
                typed[name] = _number(value, variable.kind)
        if definition.version == 2:
            SubElement(SubElement(parent, "ScalarVariable", named), kind, typed)
        else:
            if variable.derivative_of is not None:
                typed["derivative"] = str(definition.states.index(variable.derivative_of))
            SubElement(parent, kind, named | typed)


def _structure(structure: Element, definition: FmuDefinition) -> None:
    """Unknowns and what they depend on: by index, from 1, in FMI 2.0, else by reference."""
    two = definition.version == 2
    place = {v.name: str(i) for i, v in enumerate(definition.variables, start=int(two))}
    outputs = [v for v in definition.variables if v.causality == "output"]
    derivatives = [v for v in definition.variables if v.derivative_of is not None]
    # before the run, calculated outputs are constants, derivatives may depend on all that is set
    given = tuple(v.name for v in definition.variables if v.start is not None)
    for tag, unknowns in (
        ("Output", [(v, v.dependencies) for v in outputs]),
        ("ContinuousStateDerivative", [(v, v.dependencies) for v in derivatives]),
        (
            "InitialUnknown",
            [(v, ()) for v in outputs if v.start is None] + [(v, given) for v in derivatives],
        ),
    ):
        rows = [
            {"index" if two else "valueReference": place[v.name]}
            | ({} if known is None else {"dependencies": " ".join(place[name] for name in known)})
            for v, known in unknowns
        ]
        if rows:
            parent = SubElement(structure, f"{tag}s") if two else structure
            _add(parent, "Unknown" if two else tag, rows)


def build_description(definition: FmuDefinition, linked: Sequence[str]) -> bytes:
    """``sources/buildDescription.xml`` of FMI 3.0."""
    root = Element("fmiBuildDescription", fmiVersion="3.0")
    parent = SubElement(root, "BuildConfiguration", modelIdentifier=definition.identifier)
    options = " ".join((*FLAGS, *definition.flags))
    files = SubElement(parent, "SourceFileSet", language="C11", compilerOptions=options)
    _add(files, "SourceFile", _named(linked, ".c"))
    _add(parent, "Library", [*_named(linked, ".a"), {"name": "m", "external": "true"}])
    return _text(root)
