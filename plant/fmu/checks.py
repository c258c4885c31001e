"""One entry of a map against the one variable that it names; InputError says what to write instead.

Units become factors here, and constants get the type of their variable.
"""

import difflib
import math
from collections.abc import Mapping

import numpy as np

from bayesrace.errors import InputError
from plant.fmu.inspection import Variable
from plant.fmu.map_file import Driven, Pick, Value
from plant.fmu.units import contradicts, parse_quantity, to_si, unit_of

__all__ = ["a", "constant", "conversion", "find", "offset_of", "scalar"]


def find(variables: Mapping[str, Variable], name: str) -> Variable:
    """The FMU's variable ``name``; InputError with names like it if there is none."""
    if name in variables:
        return variables[name]
    by_lower = {known.lower(): known for known in variables}
    near = difflib.get_close_matches(name.lower(), by_lower, n=3, cutoff=0.6)
    names = ", ".join(f"'{by_lower[one]}'" for one in near)
    raise InputError(f"the FMU has no variable '{name}'" + (f"; near: {names}" if near else ""))


def scalar(variables: Mapping[str, Variable], name: str) -> Variable:
    """The same, a single real number."""
    variable = find(variables, name)
    if not variable.scalar:
        what = "an array" if variable.array else f"of type {variable.fmi_type}"
        raise InputError(f"'{name}' is {what}; a single real number is needed")
    return variable


def a(causality: str) -> str:
    """The causality in a sentence, with its article."""
    words = causality.replace("Parameter", " parameter")
    return f"{'an' if causality in ('input', 'output') else 'a'} {words}"


def conversion(
    entry: Pick | Driven, variable: Variable, wanted: str, *, outwards: bool = False
) -> tuple[float, float]:
    """(scale, offset) from the FMU's variable to our unit, or ``outwards`` from ours to it."""
    declared = variable.unit
    if entry.scale is None:
        factor = _factor(entry, variable, wanted)
        scale = 1.0 / factor if outwards else factor
    else:
        scale = entry.scale
        if scale == -1.0 and declared and declared.factor != 1.0:
            raise InputError(
                f"scale = -1 takes '{variable.name}' as a plain number though the FMU declares "
                f"'{declared.name}'; for the other direction write sign = -1"
            )
    offset = offset_of(entry.offset, wanted, abs(scale) if outwards else 1.0)
    return entry.sign * scale, offset


def _factor(entry: Pick | Driven, variable: Variable, wanted: str) -> float:
    named, declared = unit_of(entry.unit), variable.unit
    if entry.unit is not None and named is None:
        raise InputError(f"unit '{entry.unit}' is not known; give `scale` instead of it")
    if named and declared and contradicts(named, declared):
        raise InputError(
            f"the map says '{variable.name}' is in '{named.name}', the FMU declares "
            f"'{declared.name}'; leave the unit out, or give `scale` if the FMU is wrong"
        )
    unit = named or declared
    if unit is not None:
        try:
            return to_si(unit, wanted)
        except InputError as error:
            raise InputError(f"the unit of '{variable.name}', {error}") from None
    if variable.unit_name not in (None, "", "-"):
        raise InputError(
            f"'{variable.name}' has the unit '{variable.unit_name}', which is not known; give "
            "`unit`, or `scale` instead of it"
        )
    return 1.0  # neither names a unit: SI


def offset_of(offset: float | str, wanted: str, factor: float = 1.0) -> float:
    """An offset as a number; a text is in a unit of its own and converts to ``wanted``."""
    if not isinstance(offset, str):
        return offset
    try:
        number, unit = parse_quantity(offset)
        return number * to_si(unit, wanted) * factor
    except InputError as error:
        raise InputError(f"offset: {error}") from None


def constant(variable: Variable, value: Value) -> Value:
    """``value`` in the variable's type; InputError if it is of another or out of range."""
    result = None if variable.array else _typed(variable, value)
    if result is None:
        items = f" with {', '.join(variable.items)}" if variable.items else ""
        raise InputError(
            f"{value!r} does not suit '{variable.name}', which is of type "
            f"{variable.fmi_type}{items}"
        )
    if isinstance(result, str) or variable.lowest <= result <= variable.highest:
        return result
    raise InputError(
        f"{value!r} is outside {variable.lowest:g} to {variable.highest:g}, which "
        f"'{variable.name}' allows"
    )


def _typed(variable: Variable, value: Value) -> Value | None:
    """The value in the variable's type; None if it has no such value."""
    kind = variable.kind
    if isinstance(value, str):
        if kind == "real":
            return _in_its_unit(variable, value)
        return value if kind == "string" else variable.items.get(value)
    if kind == "boolean":
        return bool(value) if value in (0, 1) else None
    if isinstance(value, bool):
        return None
    if kind in ("integer", "enumeration"):
        whole = math.isfinite(value) and value == int(value)
        return int(value) if whole and _holds(variable.fmi_type, int(value)) else None
    return float(value) if kind == "real" else None


def _holds(fmi_type: str, value: int) -> bool:
    """Whether the type's width has this number: Integer, UInt8, Enumeration …"""
    width = {"Integer": "int32", "Enumeration": "int64"}.get(fmi_type, fmi_type.lower())
    return bool(np.iinfo(width).min <= value <= np.iinfo(width).max)


def _in_its_unit(variable: Variable, text: str) -> float:
    number, unit = parse_quantity(text)
    own = variable.unit
    if own is None:
        raise InputError(f"'{variable.name}' declares no unit: give a plain number, not '{text}'")
    if own.powers != unit.powers:
        raise InputError(f"'{text}' does not convert to '{own.name}'")
    return number * unit.factor / own.factor
