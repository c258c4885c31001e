"""The built-in car as an FMU, packed once for all tests of a session."""

import functools
import tempfile
from pathlib import Path
from typing import Literal

from bayesrace.vehicles import get_car
from codegen.fmu import pack
from plant.fmu.export import car_fmu

__all__ = ["packed_car"]

_FOLDER = tempfile.TemporaryDirectory(prefix="car-fmu-")


@functools.cache
def packed_car(version: Literal[2, 3] = 3) -> Path:
    """Co-Simulation FMU of that FMI version; the file lives as long as this process."""
    return pack(car_fmu(get_car("orca"), version), Path(_FOLDER.name) / f"car{version}.fmu")
