"""Variables of an FMU and their units, independent of the FMI version."""

import math
import re
from dataclasses import dataclass
from typing import Final, Literal

from bayesrace.errors import InputError

__all__ = ["Causality", "Variable", "base_units"]

Causality = Literal["input", "output", "parameter", "local"]
Kind = Literal["real", "integer", "boolean"]
Variability = Literal["continuous", "discrete", "fixed", "tunable"]
Initial = Literal["exact", "calculated"]

_IDENTIFIER: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


@dataclass(frozen=True)
class Variable:
    """One scalar variable; its value reference is its place in the definition.

    An input, a parameter, a state and an output that may be set before the run have a ``start``;
    an output without one is calculated. Booleans are 0 or 1. In C the variable is
    ``instance->value[FMU_V_<name>]``.
    """

    name: str
    causality: Causality
    description: str
    kind: Kind = "real"
    unit: str | None = None
    """Modelica style, such as ``m/s`` or ``kg.m2``; ``1`` for a pure number; real ones only."""
    start: float | None = None
    min: float | None = None
    max: float | None = None
    exclusive: bool = False
    """The value must not be equal to ``min`` or ``max`` either (FMI cannot say that)."""
    tunable: bool = False
    """A parameter that may also be set during the run (default: until initialisation ends)."""
    nominal: float | None = None
    derivative_of: str | None = None
    """Model Exchange: the state that this variable is the derivative of."""
    dependencies: tuple[str, ...] | None = ()
    """Outputs and derivatives: variables that it depends on directly (None: on all)."""
    initial_dependencies: tuple[str, ...] | None = ()
    """The same at initialisation, where parameters and start values count as well."""

    def __post_init__(self) -> None:
        if not _IDENTIFIER.fullmatch(self.name):
            raise InputError(f"variable '{self.name}': the name must be a C identifier")
        if self.start is None and self.causality in ("input", "parameter"):
            raise InputError(f"variable '{self.name}': an {self.causality} needs a start value")
        if self.start is not None and not math.isfinite(self.start):
            raise InputError(f"variable '{self.name}': the start value {self.start} is not finite")
        if self.unit is not None:
            base_units(self.unit)

    @property
    def variability(self) -> Variability:
        """As FMI calls it."""
        if self.causality == "parameter":
            return "tunable" if self.tunable else "fixed"
        return "continuous" if self.kind == "real" else "discrete"

    @property
    def initial(self) -> Initial:
        """As FMI calls it."""
        return "calculated" if self.start is None else "exact"


_BASE: Final[dict[str, dict[str, int]]] = {
    "1": {},
    "kg": {"kg": 1},
    "m": {"m": 1},
    "s": {"s": 1},
    "rad": {"rad": 1},
    "N": {"kg": 1, "m": 1, "s": -2},
    "Hz": {"s": -1},
}

_ATOM: Final = re.compile(r"(1|[A-Za-z]+)(-?[0-9]+)?")


def base_units(unit: str) -> dict[str, int]:
    """Exponents of kg, m, s, rad in a unit such as ``N.s2/m2`` (all of them SI, factor 1).

    InputError for a unit that is not made of those known here.
    """
    exponents: dict[str, int] = {}
    above, *below = unit.split("/")
    for sign, factors in ((1, above), *((-1, factor) for factor in below)):
        for factor in factors.strip("()").split("."):
            atom = _ATOM.fullmatch(factor)
            if atom is None or atom[1] not in _BASE:
                raise InputError(f"unit '{unit}': '{factor}' is unknown; add it to {__name__}")
            for base, exponent in _BASE[atom[1]].items():
                power = sign * exponent * int(atom[2] or 1)
                exponents[base] = exponents.get(base, 0) + power
    return {base: power for base, power in sorted(exponents.items()) if power}
