"""What an FMU is; its C, and its binaries: the host's by its own compiler, others cross-compiled.

The C is the model's, the FMI layer of its version (``native``), FMI's headers, and the generated
``fmu_config.h``.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from math import inf, isfinite
from pathlib import Path
from typing import Final, Literal
from uuid import UUID

import fmpy

from bayesrace.codegen.platforms import Platform

__all__ = [
    "FLAGS", "NATIVE", "FmuDefinition", "Variable", "arguments", "fmi_headers", "linked_files",
    "sources_of", "write_sources",
]  # fmt: skip

NATIVE: Final = Path(__file__).parent / "native"
"""The hand-written C."""

FLAGS: Final = ("-std=gnu11", "-O2", "-ffp-contract=off", "-fvisibility=hidden")
"""Portable, and the same arithmetic on every platform: no fused multiply-add."""


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


def fmi_headers(version: int) -> list[Path]:
    """FMI's own headers, from the installed fmpy."""
    return sorted((Path(fmpy.__file__).parent / "c-code").glob(f"fmi{version}*.h"))


def sources_of(definition: FmuDefinition) -> tuple[str, dict[str, bytes]]:
    """Instantiation token, and the files of ``sources/`` that a compiler reads: name to content.

    The token stands for everything that is compiled or read at run time.
    """
    names = ("fmu.h", "fmi.h", "fmi.c", f"fmi{definition.version}.c")
    layer = [NATIVE / name for name in names]
    files = {path.name: path.read_bytes() for path in (*layer, *fmi_headers(definition.version))}
    files = {**definition.sources, **files}
    files["exports.map"] = b"{ global: fmi2*; fmi3*; local: *; };\n"
    hashed = {**files, **definition.resources, "": _config_header(definition, "")}
    digest = hashlib.sha256()
    for name, content in sorted(hashed.items()):
        digest.update(f"{name} {len(content)} ".encode() + content)
    token = f"{{{UUID(bytes=digest.digest()[:16])}}}"
    return token, files | {"fmu_config.h": _config_header(definition, token)}


def linked_files(sources: Mapping[str, bytes]) -> list[str]:
    """What the compiler is given, in order: C files, then libraries."""
    return [name for end in (".c", ".a") for name in sorted(sources) if name.endswith(end)]


def write_sources(sources: Mapping[str, bytes], folder: Path) -> list[str]:
    """Fills ``folder`` with all that is compiled; returns what the compiler is given."""
    for name, content in sources.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return linked_files(sources)


def _row(v: Variable) -> str:
    """The variable as the arguments of a macro; see ``fmu_variable`` in ``native/fmu.h``."""
    role = "FIXED" if v.start is not None else "CALCULATED"
    if v.causality == "input" or v.tunable:
        role = "INPUT" if v.causality == "input" else "TUNABLE"
    low = repr(float(v.min)) if isfinite(v.min) else "-INFINITY"
    high = repr(float(v.max)) if isfinite(v.max) else "INFINITY"
    start, nominal, opened = float(v.start or 0.0), float(v.nominal or 1.0), int(v.exclusive)
    return f"V({v.name}, {v.kind.upper()}, {role}, {start!r}, {low}, {high}, {opened}, {nominal!r})"


def _config_header(definition: FmuDefinition, token: str) -> bytes:
    """``fmu_config.h``: version, token, constants, and the variables as rows of a macro."""
    macros = {
        "FMU_FMI": definition.version,
        "FMU_IDENTIFIER": f'"{definition.identifier}"',
        "FMU_TOKEN": f'"{token}"',
        "FMU_STATES": len(definition.states),
        "FMU_SERIALISES": int(definition.serialises),
        **definition.constants,
    }
    lines = [
        "/* generated */\n#ifndef FMU_CONFIG_H\n#define FMU_CONFIG_H",
        *(f"#define {name} {value}" for name, value in macros.items()),
        "#define FMU_VARIABLES(V) \\",
        *(f"    {_row(variable)} \\" for variable in definition.all_variables),
        "\n#define FMU_PLACE(name, ...) FMU_V_##name,",
        "enum { FMU_VARIABLES(FMU_PLACE) FMU_VALUES };\n#endif\n",
    ]
    return "\n".join(lines).encode()


def arguments(target: Platform, linked: Sequence[str], out: str, flags: Sequence[str]) -> list[str]:
    """What follows the compiler's name, in a folder that holds ``linked`` (libraries last)."""
    line = [*FLAGS, *flags, "-shared", *(["-fPIC"] if target.suffix != ".dll" else [])]
    line += ["-I.", *linked, "-lm", "-o", out]
    if target.suffix == ".so":
        # only FMI's own functions, also where libraries bring others; and nothing left undefined
        line += ["-Wl,--version-script=exports.map", "-Wl,-z,defs"]
    return line
