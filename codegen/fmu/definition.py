"""What an FMU is before it is packed: everything that XML, C and archive are made from."""

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from math import inf
from pathlib import Path
from typing import Final, Literal

__all__ = ["NATIVE", "FmuDefinition", "Variable"]

NATIVE: Final = Path(__file__).parent / "native"
"""The hand-written C."""


@dataclass(frozen=True)
class Variable:
    """One scalar variable; its value reference is its place in the definition.

    An input, a parameter, a state and an output that may be set before the run have a ``start``;
    an output without one is calculated. In C the variable is ``instance->value[FMU_V_<name>]``.
    """

    name: str
    causality: Literal["input", "output", "parameter", "local", "independent"]
    description: str
    _: KW_ONLY
    kind: Literal["real", "integer", "boolean"] = "real"
    unit: str | None = None
    """Modelica style, such as ``m/s`` or ``kg.m2``; ``1`` for a pure number; real ones only."""
    start: float | None = None
    min: float = -inf
    max: float = inf
    exclusive: bool = False
    """The value must not be equal to ``min`` or ``max`` either (FMI cannot say that)."""
    tunable: bool = False
    """A parameter that may also be set during the run (default: until initialisation ends)."""
    nominal: float | None = None
    derivative_of: str | None = None
    """Model Exchange: the state that this variable is the derivative of."""
    dependencies: tuple[str, ...] | None = ()
    """Outputs and derivatives: variables that it depends on directly (None: on all)."""

    @property
    def variability(self) -> Literal["continuous", "discrete", "fixed", "tunable"]:
        """As FMI calls it."""
        if self.causality == "parameter":
            return "tunable" if self.tunable else "fixed"
        return "continuous" if self.kind == "real" else "discrete"


TIME: Final = Variable("time", "independent", "simulation time", unit="s")


@dataclass(frozen=True, kw_only=True)
class FmuDefinition:
    """An FMU of FMI 2.0 or 3.0, ready for :func:`bayesrace.codegen.fmu.pack`.

    ``name``: shown to people; ``identifier``: of the binaries, in C; ``description``: one line.
    """

    name: str
    identifier: str
    description: str
    version: Literal[2, 3]
    variables: tuple[Variable, ...]
    """In the order of their value references. Of Model Exchange: the states first, at the end their
    derivatives in the same order."""
    sources: Mapping[str, bytes]
    """C files that implement the model of ``fmu.h``, with headers, by the path below ``sources/``.
    A static library of the host platform (``*.a``) is linked; then no other can be built for."""
    flags: tuple[str, ...] = ()
    """Compiler flags after those of every FMU."""
    constants: Mapping[str, float] = field(default_factory=dict)
    """Further macros of ``fmu_config.h``."""
    resources: Mapping[str, bytes] = field(default_factory=dict)
    """Files of the ``resources/`` folder."""
    documentation: str = ""
    """Of the documentation page, HTML."""
    default_step_s: float = 0.02
    serialises: bool = True
    """A saved state can become bytes for another instance: model memory holds no pointers."""

    @property
    def states(self) -> tuple[str, ...]:
        """Continuous states: some if the FMU is for Model Exchange, else none."""
        return tuple(v.derivative_of for v in self.variables if v.derivative_of is not None)

    @property
    def all_variables(self) -> tuple[Variable, ...]:
        """The variables, and time as the last."""
        return (*self.variables, TIME)

    @property
    def libraries(self) -> bool:
        """Whether static libraries are among the sources."""
        return any(name.endswith(".a") for name in self.sources)
