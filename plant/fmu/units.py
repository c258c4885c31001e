"""Units that an FMU declares or a map names, as factors to SI; angles count as a dimension.

Pint knows the names; angles are told apart from numbers here because a duty cycle in degrees is a
mistake, though both have no dimension for pint. An FMU's own definition of a unit (FMI 2.0.2,
2.2.2; FMI 3.0, 2.4.3) stands for names that pint does not know.
"""

import math
import re
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

from bayesrace.errors import InputError

__all__ = ["Unit", "UnitDefinition", "contradicts", "parse_quantity", "to_si", "unit_of"]

_BASES: Final = ("gram", "meter", "second", "ampere", "kelvin", "mole", "candela", "radian")
_RAD: Final = _BASES.index("radian")
_KILOGRAM: Final = 1e-3

_LONGEST_NAME: Final = 60
_SPELLED: Final = re.compile(r"(?:[^\W\d]+|[°%·²³()\s]|\*(?!\*)|/|\^-?\d(?!\d)|1(?=\s*/|$))+")
"""Units, products and powers of one digit: pint computes what it is given, 9^9^9 for days."""


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit by name: so many SI units of these exponents (kg m s A K mol cd rad)."""

    name: str
    factor: float
    exponents: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class UnitDefinition:
    """What an FMU says of a unit: exponents (kg m s A K mol cd rad), factor and offset to SI."""

    exponents: tuple[int, ...]
    factor: float = 1.0
    offset: float = 0.0


@cache
def _registry() -> Any:
    import pint  # half a second, for those who drive an FMU

    registry: Any = pint.UnitRegistry()
    registry.define("@alias kilometer_per_hour = kmph")  # or it reads as thousands of mph
    registry.define("@alias turn = rev")
    return registry


def _pint_spelling(name: str) -> str:
    """Products and powers as FMI tools write them (N.m, m/s2, rad.s-1) in pint's spelling."""
    spelled = name.strip().replace(".", "*")
    return re.sub(r"([^\W\d_])(-?\d+)", r"\1^\2", spelled)


@cache
def _by_name(name: str) -> Unit | None:
    spelled = _pint_spelling(name)
    if len(name) > _LONGEST_NAME or not _SPELLED.fullmatch(spelled):
        return None
    try:
        one = _registry().Quantity(1.0, spelled).to_root_units()
        factor = float(one.magnitude)
        powers = {str(base): float(power) for base, power in one.unit_items()}
    except Exception:  # pint raises what its tokenizer, parser and converters raise
        return None
    if set(powers) - set(_BASES) or not math.isfinite(factor):
        return None
    exponents = tuple(powers.get(base, 0.0) for base in _BASES)
    return Unit(name, factor * _KILOGRAM ** exponents[0], exponents)


def unit_of(name: str | None, definition: UnitDefinition | None = None) -> Unit | None:
    """The unit called ``name``, which the FMU defines so; None if it says nothing known.

    A definition that leaves out that an angle is one, or says nothing at all, as some tools write
    them, does not overrule the name.
    """
    if name is None or name.strip() in ("", "-"):
        return None
    known = _by_name(name)
    if definition is None:
        return known
    if definition.offset != 0.0 or not math.isfinite(definition.factor) or definition.factor == 0.0:
        return None  # temperatures: none of ours
    defined = Unit(name, definition.factor, tuple(float(power) for power in definition.exponents))
    if known is None:
        return defined
    says_nothing = definition.factor == 1.0 and not any(definition.exponents)
    same = defined.exponents[:_RAD] == known.exponents[:_RAD]
    close = math.isclose(defined.factor, known.factor, rel_tol=1e-4)
    # Where they agree, the name's factor has all digits.
    return known if says_nothing or (same and close) else defined


def to_si(unit: Unit, wanted: str) -> float:
    """Factor that turns a value in ``unit`` into one in the SI unit ``wanted``.

    Raises InputError for another dimension, and for an angle per time that does not say which.
    """
    si = _by_name(wanted)
    assert si is not None, wanted  # noqa: S101  our own units are known
    if unit.exponents == si.exponents:
        return unit.factor / si.factor
    plain = unit.exponents[:_RAD] == si.exponents[:_RAD]
    if plain and si.exponents[_RAD] and not unit.exponents[_RAD]:
        if unit.factor == si.factor:
            return 1.0  # radians, as SI has them: 1 and 1/s
        which = '"rpm" or "rad/min"' if si.exponents[2] else '"turn" or "rad"'
        raise InputError(
            f"'{unit.name}' may count turns or radians: say unit = {which} or the like"
        )
    raise InputError(f"'{unit.name}' does not convert to {_spoken(wanted)}")


def _spoken(unit: str) -> str:
    return "a plain number" if unit == "1" else f"'{unit}'"


def contradicts(named: Unit, declared: Unit) -> bool:
    """Whether the map's unit cannot be what the FMU declares.

    A declared frequency that leaves open what it counts (1/min) allows any angle per time.
    """
    if named.exponents == declared.exponents:
        return not math.isclose(named.factor, declared.factor, rel_tol=1e-4)
    open_ = (
        declared.exponents[2] == -1.0
        and not declared.exponents[_RAD]
        and named.exponents[:_RAD] == declared.exponents[:_RAD]
    )
    return not open_


def parse_quantity(text: str) -> tuple[float, Unit]:
    """Number and unit of a text such as ``90 deg``; InputError if it is not one."""
    match = re.fullmatch(r"\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(.*)", text)
    unit = unit_of(match[2]) if match else None
    try:
        if match and unit:
            return float(match[1]), unit
    except ValueError:
        pass
    raise InputError(f"'{text}' is not a number with a unit, such as '90 deg'")
