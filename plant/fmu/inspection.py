"""An FMU file: its description read, a map to fill in written, its content unpacked; units.

Every fault of the file is an InputError.
"""

import json
import math
import re
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from string import Template
from typing import Any, Final

from fmpy import platform, platform_tuple, read_model_description, sharedLibraryExtension
from fmpy.simulation import settable_in_instantiated

from bayesrace.errors import InputError
from bayesrace.plant.fmu.wiring import COMMANDS, STATES
from bayesrace.units import factor_of

__all__ = [
    "blank_map", "extract", "inspect", "is_readable", "is_real", "is_settable",
    "items_of", "library", "platforms", "range_of", "steps_s",
]  # fmt: skip

_MOST_BYTES: Final = 2 << 30
"""Unpacked; an archive that claims more is damaged or an attack on the disk."""

_LARGEST_XML: Final = 16_000_000
"""Bytes of a model description; a hundred thousand variables."""

_CONTROL: Final = re.compile(r"[\x00-\x1f\x7f\x85\u2028\u2029]+")

_MAP: Final = Template("""\
# Map of the FMU '$name' to the car; docs/fmu.md has the form. Names and units that agree
# with ours are entered. Fill in the lines that the car needs, and remove their '#'.

[fmu]
# step_s = $step_s  # communication step; must divide the plant's period
# placed = true  # if it starts at an origin of its own
# derived = ["omega", "delta"]  # if it does not give them

[inputs]  # from: d, throttle, brake, delta_rate, delta; or a constant
$input
[outputs]  # world_vx and world_vy, or speed and slip, can stand in place of vx and vy
$output
[start]  # outputs whose start can be set are started without being named here
# start_x = { from = "x", unit = "m" }

[parameters]
$parameter""")


def is_real(variable: Any) -> bool:
    """Whether it is a real number, or an array of them."""
    return variable.type in ("Real", "Float32", "Float64")


def is_readable(variable: Any) -> bool:
    """Whether it can be read while the FMU runs."""
    return variable.causality in ("output", "local")


def is_settable(variable: Any) -> bool:
    """Whether its start value can be set before initialisation."""
    return bool(settable_in_instantiated(variable) and variable.variability != "constant")


def items_of(variable: Any) -> dict[str, int]:
    """An enumeration's names and values."""
    items = variable.declaredType.items if variable.declaredType else ()
    return {str(item.name): int(_number(item.value, 0.0)) for item in items}


def range_of(variable: Any) -> tuple[float, float]:
    """The lowest and the highest value that it declares."""
    return _number(variable.min, -math.inf), _number(variable.max, math.inf)


def _number(text: Any, otherwise: float) -> float:
    """A number as the description has it; ``otherwise`` if there is none that is finite."""
    try:
        value = float(text)
    except (TypeError, ValueError):
        return otherwise
    return value if math.isfinite(value) else otherwise


@contextmanager
def _opened(path: Path) -> Iterator[zipfile.ZipFile]:
    """The archive; InputError if the file is none, damaged, or encrypted."""
    if not path.is_file():
        raise InputError(f"no FMU at {path}; give the path of an .fmu file")
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except (OSError, RuntimeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(
            f"{path} is no FMU, or a damaged one ({error}); export or copy it again"
        ) from None


def steps_s(fmu: Any) -> list[float]:
    """Its own communication step and that of its experiment; 0 for one that it does not state."""
    own = fmu.coSimulation and fmu.coSimulation.fixedInternalStepSize
    return [_number(own, 0.0), _number(getattr(fmu.defaultExperiment, "stepSize", None), 0.0)]


def inspect(path: Path) -> Any:
    """The ``ModelDescription`` (fmpy) of an FMU 2.0 or 3.0, whatever its kind, without running it.

    What a variable does not declare itself is filled in from its declared type. InputError if the
    file is no FMU. Small offences against the schema are overlooked.
    """
    with _opened(path) as archive:
        sizes = {one.filename: one.file_size for one in archive.infolist()}
        size = sizes.get("modelDescription.xml")
        if size is None:
            raise InputError(f"{path} is an archive without a modelDescription.xml: no FMU")
        if size > _LARGEST_XML:
            raise InputError(
                f"{path}: its modelDescription.xml has {size / 1e6:.0f} MB, at most "
                f"{_LARGEST_XML / 1e6:.0f} are read: export it with fewer variables"
            )
        head = archive.open("modelDescription.xml").read(1 << 16)
    stated = re.search(rb"fmiVersion\s*=\s*[\"']([^\"']*)[\"']", head)
    version = stated.group(1).decode(errors="replace") if stated else "none"
    if version != "2.0" and not version.startswith("3."):
        raise InputError(
            f"{path} is for FMI version {version}; versions 2.0 and 3.0 are read: export it so"
        )
    try:
        fmu = read_model_description(str(path), validate=False)
    except Exception as error:  # fmpy fails with whatever the first wrong line leads to
        raise InputError(f"{path}: its modelDescription.xml cannot be read: {error}") from None
    for one in fmu.modelVariables:
        for attribute in ("unit", "min", "max"):
            if one.declaredType and getattr(one, attribute) is None:
                setattr(one, attribute, getattr(one.declaredType, attribute))
    return fmu


def blank_map(fmu: Any) -> str:
    """TOML of a map for this FMU. What is left to fill in is a comment: it always parses."""
    variables = {one.name: one for one in fmu.modelVariables}
    lines = {"input": "", "parameter": "", "output": ""}
    for one in variables.values():
        ours = one.causality == "input" and one.name in COMMANDS
        if ours and _agrees(one, COMMANDS[one.name]):
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


def _agrees(variable: Any, unit: str) -> bool:
    """Whether it is a single real number in just this unit."""
    same = factor_of(variable.unit, unit) == 1.0
    return same and is_real(variable) and not variable.dimensions


def _blank(variable: Any) -> str:
    """An input to be driven, or a constant at its start value."""
    name, unit = (json.dumps(one or "") for one in (variable.name, variable.unit))
    value = json.dumps(variable.start) if variable.type == "String" else variable.start or "0"
    about = f"[{variable.unit}] " if variable.unit else ""
    if variable.causality == "input" and is_real(variable):
        value = f'{{ from = "", unit = {unit} }}'
    return f"{name} = {value}  # {about}{variable.description or ''}".rstrip(" #")


def platforms(path: Path) -> str:
    """The platforms of its binaries, as the FMI version calls them: linux64, x86_64-linux, …"""
    with _opened(path) as archive:
        parts = [PurePosixPath(name.replace("\\", "/")).parts for name in archive.namelist()]
    there = sorted({part[1] for part in parts if len(part) > 2 and part[0] == "binaries"})
    has_sources = any(part[0] == "sources" for part in parts)
    sources = " (its sources are inside)" if has_sources else ""
    return f"{', '.join(there) or 'no platform at all'}{sources}"


def extract(path: Path, folder: Path) -> None:
    """Unpacks the FMU into an existing folder, and nowhere else; InputError if it cannot be."""
    with _opened(path) as archive:
        for name in archive.namelist():
            if name.startswith("/") or ".." in name.split("/") or "\\" in name or ":" in name:
                raise InputError(
                    f"{path} holds '{name[:200]}', a path that leads out of its folder: not "
                    "unpacked; do not use this file"
                )
        if sum(entry.file_size for entry in archive.infolist()) > _MOST_BYTES:
            raise InputError(f"{path} claims to unpack to more than {_MOST_BYTES >> 30} GiB")
        archive.extractall(folder)


def library(path: Path, folder: Path, fmu: Any) -> Path:
    """The shared library of the unpacked FMU for this computer.

    InputError that says which platforms the FMU is for, if it is not for this one.
    """
    name = f"{fmu.coSimulation.modelIdentifier}{sharedLibraryExtension}"
    # FMI 2.0 names Intel's platforms alone; for others the names of 3.0 are in use.
    fits = (platform_tuple, platform) if platform_tuple.startswith("x86") else (platform_tuple,)
    for fitting in fits:
        place: Path = folder / "binaries" / fitting / name
        if place.is_file():
            return place
    raise InputError(
        f"{path} is for {platforms(path)}, not for this computer, {platform_tuple}: export it with "
        f"binaries/{fits[-1]}/{name}"
    )
