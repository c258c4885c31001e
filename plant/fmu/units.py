"""Units that an FMU declares or a map names, as factors to SI; an angle counts as a dimension.

Pint knows the names. It takes an angle for a plain number; here the two differ, because a duty
cycle in degrees is a mistake.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

from bayesrace.errors import InputError

__all__ = ["FREQUENCY", "Unit", "parse_quantity", "to_si", "unit_of"]

_SPELLED: Final = re.compile(r"(?:[^\W\d]+|[°%·²³()\s]|\*(?!\*)|/|\^-?\d(?!\d)|1(?=\s*/|$))+")
"""Units, products and powers of one digit: pint computes what it is given, 9^9^9 for days."""

FREQUENCY: Final = {"second": -1.0}
"""Powers of a unit such as 1/min, which leaves open what it counts."""


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit by name, as a multiple of powers of pint's base units, radian among them."""

    name: str
    factor: float
    powers: Mapping[str, float]

    def agrees(self, other: "Unit") -> bool:
        """Whether both measure the same, an angle left open by one of them included."""
        plain = [{k: v for k, v in one.powers.items() if k != "radian"} for one in (self, other)]
        return plain[0] == plain[1] and math.isclose(self.factor, other.factor, rel_tol=1e-4)


@cache
def _registry() -> Any:
    import pint  # takes half a second, and the built-in car needs none of it

    registry: Any = pint.UnitRegistry()
    registry.define("@alias kilometer_per_hour = kmph")  # or it reads as thousands of mph
    registry.define("@alias turn = rev")
    return registry


@cache
def unit_of(name: str | None) -> Unit | None:
    """The unit called ``name``, also as FMI tools spell it (N.m, m/s2, rad.s-1); None if it is not
    known."""
    spelled = re.sub(r"([^\W\d_])(-?\d+)", r"\1^\2", (name or "").strip().replace(".", "*"))
    if not name or len(name) > 60 or not _SPELLED.fullmatch(spelled):
        return None
    try:
        one = _registry().Quantity(1.0, spelled).to_root_units()
        powers = {str(base): float(power) for base, power in one.unit_items()}
        factor = float(one.magnitude)
    except Exception:  # pint raises what its tokenizer, parser and converters raise
        return None
    return Unit(name, factor, powers) if math.isfinite(factor) else None


def to_si(unit: Unit, wanted: str) -> float:
    """Factor from a value in ``unit`` to one in the SI unit ``wanted``.

    Raises InputError for another dimension, and for a frequency that may count turns or radians.
    """
    si = unit_of(wanted)
    assert si is not None, wanted  # noqa: S101  the car's own units are known
    same = "radian" not in unit.powers and unit.agrees(si)  # 1 and 1/s are radians, as SI has them
    if unit.powers == si.powers or (same and "Hz" not in unit.name):
        return unit.factor / si.factor
    if unit.powers == FREQUENCY and wanted == "rad/s":
        raise InputError(
            f'\'{unit.name}\' may count turns or radians: say unit = "rpm", "rad/min" or the like'
        )
    target = "a plain number" if wanted == "1" else f"'{wanted}'"
    raise InputError(f"'{unit.name}' does not convert to {target}")


def parse_quantity(text: str) -> tuple[float, Unit]:
    """Number and unit of a text such as ``90 deg``; InputError if it is not one."""
    match = re.fullmatch(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*)", text)
    unit = unit_of(match[2]) if match else None
    if match is None or unit is None:
        raise InputError(f"'{text}' is not a number with a unit, such as '90 deg'")
    return float(match[1]), unit
