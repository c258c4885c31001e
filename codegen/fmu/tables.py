"""The C side of a definition: ``fmu_config.h`` and ``fmu_tables.h``."""

from collections.abc import Iterable
from typing import Final

from codegen.fmu.definition import FmuDefinition
from codegen.fmu.variables import Variable

__all__ = ["config_header", "tables_header"]

_SAVES: Final = {"none": 0, "instance": 1, "serialised": 2}

_KINDS: Final = {"real": "FMU_REAL", "integer": "FMU_INTEGER", "boolean": "FMU_BOOLEAN"}


def _literal(value: float | int | str) -> str:
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    return repr(value)


def _guarded(guard: str, lines: Iterable[str]) -> str:
    head = ["/* generated */", f"#ifndef {guard}", f"#define {guard}", ""]
    return "\n".join([*head, *lines, "", "#endif", ""])


def config_header(definition: FmuDefinition, token: str) -> str:
    """Sizes, capabilities, the token and the place of every variable."""
    macros: dict[str, float | int | str] = {
        "FMU_IDENTIFIER": definition.identifier,
        "FMU_TOKEN": token,
        "FMU_CS": int(definition.kind == "cs"),
        "FMU_ME": int(definition.kind == "me"),
        "FMU_VALUES": len(definition.variables),
        "FMU_STATES": len(definition.states),
        "FMU_SAVES": _SAVES[definition.saves],
        "FMU_DERIVATIVES": int(definition.derivatives),
        **definition.constants,
    }
    lines = [f"#define {name} {_literal(value)}" for name, value in macros.items()]
    places = [f"    FMU_V_{v.name} = {i}," for i, v in enumerate(definition.variables)]
    return _guarded("FMU_CONFIG_H", [*lines, "", "enum {", *places, "};"])


def _role(variable: Variable) -> str:
    if variable.causality == "input":
        return "FMU_INPUT"
    if variable.causality == "parameter":
        return "FMU_TUNABLE" if variable.tunable else "FMU_FIXED"
    return "FMU_CALCULATED" if variable.start is None else "FMU_START"


def _bound(value: float | None, otherwise: str) -> str:
    return otherwise if value is None else repr(float(value))


def _row(variable: Variable, states: tuple[str, ...]) -> str:
    state = states.index(variable.name) if variable.name in states else -1
    derived = -1 if variable.derivative_of is None else states.index(variable.derivative_of)
    cells = [
        _literal(variable.name),
        _KINDS[variable.kind],
        _role(variable),
        repr(float(variable.start or 0.0)),
        _bound(variable.min, "-INFINITY"),
        _bound(variable.max, "INFINITY"),
        str(int(variable.exclusive)),
        str(state),
        str(derived),
    ]
    return f"    {{{', '.join(cells)}}},"


def tables_header(definition: FmuDefinition) -> str:
    """The table of variables; for Model Exchange also places and nominals of the states."""
    states = definition.states
    lines = [
        "#include <math.h>",
        '#include "fmu_layer.h"',
        "",
        "static const fmu_variable fmu_variables[FMU_VALUES] = {",
        *(_row(variable, states) for variable in definition.variables),
        "};",
    ]
    if states:
        by_name = {variable.name: variable for variable in definition.variables}
        places = ", ".join(f"FMU_V_{name}" for name in states)
        nominals = ", ".join(repr(float(by_name[name].nominal or 1.0)) for name in states)
        lines += [
            "static const uint32_t fmu_states[FMU_STATES] = {" + places + "};",
            "static const double fmu_nominals[FMU_STATES] = {" + nominals + "};",
        ]
    return _guarded("FMU_TABLES_H", lines)
