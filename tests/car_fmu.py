"""The built-in car as an FMU of each version and kind, made once for all tests of a session."""

import tempfile
from pathlib import Path
from typing import Literal

from fmpy import extract

from bayesrace.vehicles import get_car
from codegen.fmu import pack
from plant.fmu.export import car_fmu

__all__ = ["packed_car", "unpacked_car"]

_FOLDER = tempfile.TemporaryDirectory(prefix="car-fmu-")


def packed_car(version: Literal[2, 3] = 3, kind: Literal["cs", "me"] = "cs") -> Path:
    """The FMU for this platform; the file lives as long as this process."""
    out = Path(_FOLDER.name) / f"car{version}-{kind}.fmu"
    return out if out.exists() else pack(car_fmu(get_car("orca"), version, kind), out)


def unpacked_car(version: Literal[2, 3] = 3, kind: Literal["cs", "me"] = "cs") -> Path:
    """The same as a folder."""
    fmu = packed_car(version, kind)
    folder = fmu.with_suffix("")
    if not folder.exists():
        extract(str(fmu), unzipdir=str(folder))
    return folder
