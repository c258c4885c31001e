"""A map to fill in: names and units that agree exactly are entered, the rest is left blank."""

import json
import re
from string import Template
from typing import Any, Final

from plant.fmu.inspection import is_readable, is_real, steps_s
from plant.fmu.units import unit_of
from plant.fmu.wiring import COMMANDS, STATES

__all__ = ["blank_map"]

_CONTROL: Final = re.compile(r"[\x00-\x1f\x7f\x85\u2028\u2029]+")

_MAP: Final = Template("""\
# Map of the FMU '$name' to the car; docs/fmu.md has the form. Names and units that agree
# with ours are entered. Fill in the lines that the car needs, and remove their '#'.

[fmu]
# step_s = $step_s  # communication step; must divide the plant's period
# placed = true  # if it starts at an origin of its own

[inputs]  # from: d, throttle, brake, delta_rate, delta; or a constant
$input
[outputs]
$output
[derive]  # what the FMU does not give and follows from other outputs
# psi = { cos = "", sin = "" }  # or { quaternion = { w = "", x = "", y = "", z = "" } }
# velocity = { world_x = "", world_y = "" }  # or { speed = "", slip = "" }
# omega = "psi"
# delta = "delta_rate"

[start]  # outputs whose start can be set are started without being named here
# start_x = { from = "x", unit = "m" }

[parameters]
$parameter""")


def blank_map(fmu: Any) -> str:
    """TOML of a map for this FMU. What is left to fill in is a comment: it always parses."""
    variables = {one.name: one for one in fmu.modelVariables}
    lines = {"input": "", "parameter": "", "output": ""}
    for one in variables.values():
        if one.causality == "input" and _agrees(one, COMMANDS.get(one.name)):
            lines["input"] += f'{one.name} = "{one.name}"\n'
        elif one.causality in ("input", "parameter"):
            lines[one.causality] += f"# {_CONTROL.sub(' ', _blank(one))}\n"
    for name, unit in STATES.items():
        one = variables.get(name)
        same = one and is_readable(one) and _agrees(one, unit)
        blank = f'# {name} = {{ variable = "", unit = "{unit}" }}'
        lines["output"] += f'{name} = "{name}"\n' if same else f"{blank}\n"
    step_s = next(filter(None, steps_s(fmu)), 0.001)
    return _MAP.substitute(lines, name=_CONTROL.sub(" ", str(fmu.modelName)), step_s=step_s)


def _agrees(variable: Any, unit: str | None) -> bool:
    """Whether it is a single real number in just this unit."""
    own, ours = unit_of(variable.unit), unit_of(unit)
    same = own and ours and (own.factor, own.powers) == (ours.factor, ours.powers)
    return bool(same and is_real(variable) and not variable.dimensions)


def _blank(variable: Any) -> str:
    """An input to be driven, or a constant at its start value."""
    name, unit = (json.dumps(one or "") for one in (variable.name, variable.unit))
    value = json.dumps(variable.start) if variable.type == "String" else variable.start or "0"
    about = f"[{variable.unit}] " if variable.unit else ""
    if variable.causality == "input" and is_real(variable):
        value = f'{{ from = "", unit = {unit} }}'
    return f"{name} = {value}  # {about}{variable.description or ''}".rstrip(" #")
