"""What a map says of one variable, checked against what the FMU says of it."""

import difflib
import math
from collections.abc import Iterable, Sequence
from typing import Any

from bayesrace.errors import InputError
from plant.fmu.inspection import Variable
from plant.fmu.map_file import Driven, Pick
from plant.fmu.units import Unit, contradicts, parse_quantity, to_si, unit_of

__all__ = ["Checks", "Value", "a", "listed"]

Value = float | int | bool | str


class Checks:
    """Looks variables up and converts between their units and ours; collects all problems."""

    def __init__(self, variables: Sequence[Variable]) -> None:
        self.variables = {variable.name: variable for variable in variables}
        self.problems: list[str] = []

    def find(self, name: str, where: str) -> Variable | None:
        """The FMU's variable ``name``; None after telling that there is none."""
        variable = self.variables.get(name)
        if variable is None:
            by_lower = {known.lower(): known for known in self.variables}
            near = difflib.get_close_matches(name.lower(), by_lower, n=3, cutoff=0.6)
            names = ", ".join(f"'{by_lower[one]}'" for one in near)
            hint = f"; near: {names}" if near else ""
            self.problems.append(f"{where}: the FMU has no variable '{name}'{hint}")
        return variable

    def real(self, name: str, where: str) -> Variable | None:
        """The same, a real number."""
        variable = self.find(name, where)
        if variable is None:
            return None
        if variable.kind != "real" or variable.array:
            what = "an array" if variable.array else f"of type {variable.fmi_type}"
            self.problems.append(f"{where}: '{name}' is {what}; a single real number is needed")
            return None
        return variable

    def _si_factor(
        self, entry: Pick | Driven, variable: Variable, wanted: str, where: str
    ) -> float | None:
        """Factor from the variable's unit to ``wanted``; None after telling why there is none."""
        named = unit_of(entry.unit)
        if entry.unit is not None and named is None:
            self.problems.append(
                f"{where}: unit '{entry.unit}' is not known; give `scale` instead of it"
            )
            return None
        declared = variable.unit
        if named and declared and contradicts(named, declared):
            self.problems.append(
                f"{where}: the map says '{variable.name}' is in '{named.name}', the FMU declares "
                f"'{declared.name}'; leave the unit out, or give `scale` if the FMU is wrong"
            )
            return None
        if named is None and declared is None and variable.unit_name not in (None, "", "-"):
            self.problems.append(
                f"{where}: '{variable.name}' has the unit '{variable.unit_name}', which is not "
                "known; give `unit`, or `scale` instead of it"
            )
            return None
        return self._factor(named or declared, variable, wanted, where)

    def _factor(
        self, unit: Unit | None, variable: Variable, wanted: str, where: str
    ) -> float | None:
        if unit is None:
            return 1.0  # nothing is said: SI
        try:
            return to_si(unit, wanted)
        except InputError as error:
            self.problems.append(f"{where}: the unit of '{variable.name}', {error}")
            return None

    def conversion(
        self, entry: Pick | Driven, variable: Variable, wanted: str, where: str, *, outwards: bool
    ) -> tuple[float, float]:
        """(scale, offset), from the FMU to us, or ``outwards`` from us to the FMU."""
        if entry.scale is None:
            factor = self._si_factor(entry, variable, wanted, where) or 1.0
            scale = 1.0 / factor if outwards else factor
        else:
            scale = entry.scale
            declared = variable.unit
            if scale == -1.0 and declared and declared.factor != 1.0:
                self.problems.append(
                    f"{where}: scale = -1 takes '{variable.name}' as a plain number though the FMU "
                    f"declares '{declared.name}'; for the other direction write sign = -1"
                )
        offset = entry.offset
        if isinstance(offset, str):
            offset = self.offset(offset, wanted, where) * (abs(scale) if outwards else 1.0)
        return entry.sign * scale, offset

    def offset(self, text: str, wanted: str, where: str) -> float:
        """An offset with a unit, in ours."""
        try:
            number, unit = parse_quantity(text)
            return number * to_si(unit, wanted)
        except InputError as error:
            self.problems.append(f"{where}: offset: {error}")
            return 0.0

    def fix(self, variable: Variable, value: Any, where: str, into: dict[str, Value]) -> None:
        """A constant, converted to the variable's type."""
        try:
            into[variable.name] = _constant(variable, value)
        except InputError as error:
            self.problems.append(f"{where}: {error}")


def _constant(variable: Variable, value: Value) -> Value:
    """``value`` in the variable's type; InputError if it is of another or out of range."""
    kind = variable.kind
    fault = InputError(
        f"{value!r} does not suit '{variable.name}', which is of type {variable.fmi_type}"
        + (f" with {listed(variable.items)}" if variable.items else "")
    )
    result = _typed(variable, value)
    if result is None or variable.array:
        raise fault
    if kind not in ("real", "integer", "enumeration") or isinstance(result, str):
        return result
    if not variable.lowest <= result <= variable.highest:
        raise InputError(
            f"{value!r} is outside {variable.lowest:g} to {variable.highest:g}, "
            f"which '{variable.name}' allows"
        )
    return result


def _typed(variable: Variable, value: Value) -> Value | None:
    kind = variable.kind
    if kind == "string":
        return value if isinstance(value, str) else None
    if kind == "real" and isinstance(value, str):
        return _in_its_unit(variable, value)
    if kind == "enumeration" and isinstance(value, str):
        return variable.items.get(value)
    if isinstance(value, str):
        return None
    if kind == "boolean":
        return bool(value) if value in (0, 1) else None
    if isinstance(value, bool):
        return None
    if kind in ("integer", "enumeration"):
        return int(value) if math.isfinite(value) and value == int(value) else None
    return float(value) if kind == "real" else None


def _in_its_unit(variable: Variable, text: str) -> float:
    number, unit = parse_quantity(text)
    own = variable.unit
    if own is None:
        raise InputError(f"'{variable.name}' declares no unit: give a plain number, not '{text}'")
    if own.exponents != unit.exponents:
        raise InputError(f"'{text}' does not convert to '{own.name}'")
    return number * unit.factor / own.factor


def a(causality: str) -> str:
    """The causality in a sentence, with its article."""
    spoken = {
        "calculatedParameter": "a calculated parameter",
        "structuralParameter": "a structural parameter",
        "input": "an input",
        "output": "an output",
    }
    return spoken.get(causality, f"a {causality}")


def listed(names: Iterable[str]) -> str:
    """The names in a sentence."""
    return ", ".join(names)
