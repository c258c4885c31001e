"""The texts of an FMU, by the templates beside this module: the model description of FMI 2.0 and
3.0, the build description of FMI 3.0, the page of documentation."""

import re
from collections.abc import Sequence
from functools import cache
from math import isfinite
from pathlib import Path
from typing import Any, Final

import pint
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from bayesrace.errors import InputError
from codegen.fmu.build import FLAGS
from codegen.fmu.definition import FmuDefinition, Variable

__all__ = ["build_description", "model_description", "rendered"]

_TYPES: Final = {
    2: {"real": "Real", "integer": "Integer", "boolean": "Boolean"},
    3: {"real": "Float64", "integer": "Int32", "boolean": "Boolean"},
}
_BASE: Final = {"kilogram": "kg", "meter": "m", "second": "s", "radian": "rad"}

_registry: Final[Any] = cache(pint.UnitRegistry)


def rendered(template: str, definition: FmuDefinition, **values: Any) -> bytes:
    """A template's text with these values, escaped as XML and HTML need it."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True,
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    text = environment.get_template(f"{template}.j2").render(fmu=definition, **values)
    return f"{text}\n".encode()


def model_description(definition: FmuDefinition, token: str, linked: Sequence[str]) -> bytes:
    """``modelDescription.xml``; ``linked``: what the compiler is given."""
    units = sorted({v.unit for v in definition.all_variables if v.unit is not None})
    return rendered(
        "modelDescription.xml",
        definition,
        token=token,
        files=[name for name in linked if name.endswith(".c")],
        units={unit: _base_units(unit) for unit in units},
        variables=[_described(definition, *one) for one in enumerate(definition.all_variables)],
        structure=_structure(definition),
    )


def build_description(definition: FmuDefinition, linked: Sequence[str]) -> bytes:
    """``sources/buildDescription.xml`` of FMI 3.0."""
    files, libraries = ([name for name in linked if name.endswith(end)] for end in (".c", ".a"))
    flags = (*FLAGS, *definition.flags)
    return rendered(
        "buildDescription.xml", definition, files=files, libraries=libraries, flags=flags
    )


def _base_units(unit: str) -> dict[str, int]:
    """Exponents of kg, m, s, rad in a unit like ``N.s2/m2``; InputError if it has a factor."""
    expression = re.sub(r"([a-z])(-?[0-9])", r"\1**\2", unit, flags=re.IGNORECASE)
    base = _registry().Quantity(expression.replace(".", "*")).to_base_units()
    if base.magnitude != 1:
        raise InputError(f"unit '{unit}' is not made of kg, m, s and rad alone")
    return {_BASE[name]: int(power) for name, power in base.unit_items()}


def _number(value: float, kind: str) -> str:
    if kind == "boolean":
        return "true" if value else "false"
    return str(int(value)) if kind == "integer" else repr(float(value))


def _described(
    definition: FmuDefinition, reference: int, variable: Variable
) -> tuple[str, dict[str, Any], dict[str, Any]]:
    """A variable's type, and its attributes: those of every type, and those of its own."""
    common = {
        "name": variable.name,
        "valueReference": reference,
        "description": variable.description,
        "causality": variable.causality,
        "variability": variable.variability,
    }
    if variable.causality not in ("input", "independent"):  # FMI gives these no 'initial'
        common["initial"] = "calculated" if variable.start is None else "exact"
    typed: dict[str, Any] = {"unit": variable.unit}  # what is None is left out
    for name in ("min", "max", "nominal", "start"):
        value = getattr(variable, name)
        if value is not None and isfinite(value):
            typed[name] = _number(value, variable.kind)
    if variable.derivative_of is not None:
        typed["derivative"] = definition.states.index(variable.derivative_of)
    return _TYPES[definition.version][variable.kind], common, typed


def _structure(definition: FmuDefinition) -> dict[str, list[dict[str, Any]]]:
    """Unknowns and what they depend on: by index, from 1, in FMI 2.0, else by reference."""
    two = definition.version == 2
    place = {v.name: i for i, v in enumerate(definition.variables, start=int(two))}
    outputs = [v for v in definition.variables if v.causality == "output"]
    derivatives = [v for v in definition.variables if v.derivative_of is not None]
    # before the run, calculated outputs are constants, derivatives may depend on all that is set
    given = tuple(v.name for v in definition.variables if v.start is not None)

    def row(unknown: Variable, known: Sequence[str] | None) -> dict[str, Any]:
        dependencies = None if known is None else " ".join(str(place[name]) for name in known)
        where = "index" if two else "valueReference"
        return {where: place[unknown.name], "dependencies": dependencies}

    return {
        "Output": [row(v, v.dependencies) for v in outputs],
        "ContinuousStateDerivative": [row(v, v.dependencies) for v in derivatives],
        "InitialUnknown": [row(v, ()) for v in outputs if v.start is None]
        + [row(v, given) for v in derivatives],
    }
