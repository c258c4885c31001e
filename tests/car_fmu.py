"""The built-in car as an FMU of each version and kind, made once for all tests."""

from functools import cache
from pathlib import Path
from typing import Final, Literal

from fmpy import extract

from bayesrace.cache import cpu_identity, software
from bayesrace.codegen.compiler import FLAGS, find_compiler
from bayesrace.codegen.fmu import car_fmu, pack
from bayesrace.vehicles import get_car
from tests.shared import shared_folder

__all__ = ["packed_car", "unpacked_car"]

_SOURCES: Final = (
    ".",
    "vehicles",
    "codegen",
    "codegen/fmu",
    "codegen/fmu/native",
)

Version = Literal[2, 3]
Kind = Literal["cs", "me"]


def packed_car(version: Version = 3, kind: Kind = "cs") -> Path:
    """The FMU for this platform."""
    return _folder(version, kind, None) / "car.fmu"


def unpacked_car(
    version: Version = 3, kind: Kind = "cs", platforms: tuple[str, ...] | None = None
) -> Path:
    """The same as a folder named after the version; ``platforms``: others than this one."""
    return _folder(version, kind, platforms) / str(version)


@cache
def _folder(version: Version, kind: Kind, platforms: tuple[str, ...] | None) -> Path:
    compiler = find_compiler()
    made_by = [*compiler.command, compiler.version, *FLAGS, cpu_identity()]
    packages = ("casadi", "fmpy", *(("ziglang",) if platforms else ()))
    parts = [str(version), kind, str(platforms), *made_by, *software(_SOURCES, packages)]

    def make(folder: Path) -> None:
        fmu = pack(car_fmu(get_car("orca"), version, kind), folder / "car.fmu", platforms)
        extract(str(fmu), unzipdir=str(folder / str(version)))

    return shared_folder("car-fmu", parts, make)
