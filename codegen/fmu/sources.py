"""The C of an FMU: the FMI layer of its version, FMI's headers, and the generated fmu_config.h."""

import hashlib
from math import isfinite
from pathlib import Path
from typing import Final
from uuid import UUID

import fmpy

from codegen.fmu.definition import FmuDefinition, Variable

__all__ = ["NATIVE", "all_sources", "fmi_headers", "linked_files", "token_of"]

NATIVE: Final = Path(__file__).parent / "native"


def fmi_headers(version: int) -> list[Path]:
    """FMI's own headers, from the installed fmpy."""
    return sorted((Path(fmpy.__file__).parent / "c-code").glob(f"fmi{version}*.h"))


def _fixed(definition: FmuDefinition) -> dict[str, bytes]:
    """Every file of ``sources/`` that does not depend on the token."""
    layer = [*NATIVE.glob("fmu*.[ch]"), NATIVE / f"fmi{definition.version}.c"]
    files = [*sorted(layer), *fmi_headers(definition.version)]
    exports = {"exports.map": b"{ global: fmi2*; fmi3*; local: *; };\n"}
    return {**definition.sources, **{path.name: path.read_bytes() for path in files}, **exports}


def token_of(definition: FmuDefinition) -> str:
    """Instantiation token: stands for everything that is compiled or read at run time."""
    files = {**_fixed(definition), **definition.resources, "": _config_header(definition, "")}
    digest = hashlib.sha256()
    for name, content in sorted(files.items()):
        digest.update(f"{name} {len(content)} ".encode() + content)
    return f"{{{UUID(bytes=digest.digest()[:16])}}}"


def all_sources(definition: FmuDefinition) -> dict[str, bytes]:
    """The files of ``sources/`` that a compiler reads: name to content."""
    header = _config_header(definition, token_of(definition))
    return {**_fixed(definition), "fmu_config.h": header}


def linked_files(definition: FmuDefinition, *endings: str) -> list[str]:
    """Those that the compiler is given, of these endings in this order."""
    names = sorted(_fixed(definition))
    return [name for ending in endings for name in names if name.endswith(ending)]


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
        "/* generated */",
        "#ifndef FMU_CONFIG_H",
        "#define FMU_CONFIG_H",
        *(f"#define {name} {value}" for name, value in macros.items()),
        "#define FMU_VARIABLES(V) \\",
        *(f"    {_row(variable)} \\" for variable in definition.all_variables),
        "",
        "#define FMU_PLACE(name, ...) FMU_V_##name,",
        "enum { FMU_VARIABLES(FMU_PLACE) FMU_VALUES };",
        "#endif\n",
    ]
    return "\n".join(lines).encode()
