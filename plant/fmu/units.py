"""Units that an FMU declares or a map names, as factors to SI; an angle counts as a dimension.

Pint knows the names. It takes an angle for a plain number; here the two differ, because a duty
cycle in degrees is a mistake. The FMU's own definition of a unit (FMI 2.0.2, 2.2.2; FMI 3.0,
2.4.3) holds for names that pint does not know.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

from bayesrace.errors import InputError

__all__ = ["Unit", "contradicts", "parse_quantity", "to_si", "unit_of"]

_BASES: Final = {
    "gram": "kg", "meter": "m", "second": "s", "ampere": "A", "kelvin": "K", "mole": "mol",
    "candela": "cd", "radian": "rad",
}  # fmt: skip
"""Pint's base units in FMI's words."""

_SPELLED: Final = re.compile(r"(?:[^\W\d]+|[°%·²³()\s]|\*(?!\*)|/|\^-?\d(?!\d)|1(?=\s*/|$))+")
"""Units, products and powers of one digit: pint computes what it is given, 9^9^9 for days."""


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit by name: ``factor`` SI units of these powers of FMI's base units, kg to rad."""

    name: str
    factor: float
    powers: Mapping[str, float]

    @property
    def plain(self) -> dict[str, float]:
        """The powers without that of the angle."""
        return {base: power for base, power in self.powers.items() if base != "rad"}


@cache
def _registry() -> Any:
    import pint  # takes half a second, and the built-in car needs none of it

    registry: Any = pint.UnitRegistry()
    registry.define("@alias kilometer_per_hour = kmph")  # or it reads as thousands of mph
    registry.define("@alias turn = rev")
    return registry


@cache
def _by_name(name: str) -> Unit | None:
    """The unit as pint knows it, in the spellings of FMI tools too: N.m, m/s2, rad.s-1."""
    spelled = re.sub(r"([^\W\d_])(-?\d+)", r"\1^\2", name.strip().replace(".", "*"))
    if len(name) > 60 or not _SPELLED.fullmatch(spelled):
        return None
    try:
        one = _registry().Quantity(1.0, spelled).to_root_units()
        powers = {_BASES[str(base)]: float(power) for base, power in one.unit_items()}
        factor = float(one.magnitude) * 1e-3 ** powers.get("kg", 0.0)
    except Exception:  # pint raises what its tokenizer, parser and converters raise
        return None
    return Unit(name, factor, powers) if math.isfinite(factor) else None


def unit_of(name: str | None, definition: Any = None) -> Unit | None:
    """The unit called ``name``; None if it is not known.

    ``definition``: fmpy's ``BaseUnit`` if the FMU defines the unit. Some tools write definitions
    that leave out the angle, or everything; these do not overrule the name.
    """
    if name is None or name.strip() in ("", "-"):
        return None
    known = _by_name(name)
    if definition is None:
        return known
    factor = definition.factor
    if definition.offset != 0.0 or not math.isfinite(factor) or factor == 0.0:
        return None  # temperatures: no quantity of the car
    powers = {
        base: float(power) for base in _BASES.values() if (power := getattr(definition, base))
    }
    defined = Unit(name, factor, powers)
    if known is None:
        return defined
    empty = factor == 1.0 and not powers
    same = defined.plain == known.plain and math.isclose(factor, known.factor, rel_tol=1e-4)
    return known if empty or same else defined  # where both agree, the name's factor is exact


def to_si(unit: Unit, wanted: str) -> float:
    """Factor from a value in ``unit`` to one in the SI unit ``wanted``.

    Raises InputError for another dimension, and for a frequency that may count turns or radians.
    """
    si = _by_name(wanted)
    assert si is not None, wanted  # noqa: S101  the car's own units are known
    open_ = unit.plain == si.plain and "rad" not in unit.powers
    if unit.powers == si.powers or (open_ and unit.factor == si.factor):
        return unit.factor / si.factor  # 1 and 1/s are radians, as SI has them
    if open_:
        which = '"rpm" or "rad/min"' if si.plain else '"turn" or "rad"'
        raise InputError(
            f"'{unit.name}' may count turns or radians: say unit = {which} or the like"
        )
    target = "a plain number" if wanted == "1" else f"'{wanted}'"
    raise InputError(f"'{unit.name}' does not convert to {target}")


def contradicts(named: Unit, declared: Unit) -> bool:
    """Whether the map's unit cannot be the one that the FMU declares.

    A declared frequency (1/min), which leaves open what it counts, allows any angle per time.
    """
    if named.powers == declared.powers:
        return not math.isclose(named.factor, declared.factor, rel_tol=1e-4)
    frequency = declared.powers.get("s") == -1.0 and "rad" not in declared.powers
    return named.plain != declared.plain or not frequency


def parse_quantity(text: str) -> tuple[float, Unit]:
    """Number and unit of a text such as ``90 deg``; InputError if it is not one."""
    match = re.fullmatch(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*)", text)
    unit = unit_of(match[2]) if match else None
    if match is None or unit is None:
        raise InputError(f"'{text}' is not a number with a unit, such as '90 deg'")
    return float(match[1]), unit
