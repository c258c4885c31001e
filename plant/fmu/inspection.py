"""An FMU file: its description read, a map to fill in written, its content unpacked; units.

Every fault of the file is an InputError. Pint knows the names of units that an FMU declares or a
map names. It takes an angle for a plain number; here the two differ, because a duty cycle in
degrees is a mistake.
"""

import json
import math
import re
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePosixPath
from string import Template
from typing import Any, Final

from fmpy import platform, platform_tuple, read_model_description, sharedLibraryExtension
from fmpy.simulation import settable_in_instantiated

from bayesrace.errors import InputError
from bayesrace.plant.fmu.wiring import COMMANDS, STATES

__all__ = [
    "FREQUENCY", "Unit", "blank_map", "extract", "inspect", "is_readable", "is_real", "is_settable",
    "items_of", "library", "platforms", "range_of", "steps_s", "to_si", "unit_of",
]  # fmt: skip

_MOST_BYTES: Final = 2 << 30
"""Unpacked; an archive that claims more is damaged or an attack on the disk."""

_LARGEST_XML: Final = 16_000_000
"""Bytes of a model description; a hundred thousand variables."""

_SPELLED: Final = re.compile(r"(?:[^\W\d]+|[°%·²³()\s]|\*(?!\*)|/|\^-?\d(?!\d)|1(?=\s*/|$))+")
"""Units, products and powers of one digit: pint computes what it is given, 9^9^9 for days."""

FREQUENCY: Final = {"second": -1.0}
"""Powers of a unit such as 1/min, which leaves open what it counts."""

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
        if one.causality == "input" and _agrees(one, COMMANDS.get(one.name)):
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


def _agrees(variable: Any, unit: str | None) -> bool:
    """Whether it is a single real number in just this unit."""
    own, ours = unit_of(variable.unit), unit_of(unit)
    same = own and ours and (own.factor, own.powers) == (ours.factor, ours.powers)
    return bool(same and is_real(variable) and not variable.dimensions)


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
