"""Exports the car and its controller as FMUs, FMI 2.0 or 3.0, for other tools.

In the order of their use: :mod:`.car` and :mod:`.controller` say what the FMU is, as a
:class:`FmuDefinition` (:mod:`.definition`); :mod:`.description` writes its XML and :mod:`.sources`
its C around the hand-written files in ``native``; :mod:`.platforms` compiles it; :mod:`.licences`
names what others have written of it; :func:`pack` makes the file. :mod:`.weights` exchanges the
weights of a packed controller.

In ``native``, ``fmu.h`` says what the C of a model implements; ``fmu_*.c`` and ``fmi2.c`` or
``fmi3.c`` are the same for every model.
"""

from codegen.fmu.archive import pack, write_sources
from codegen.fmu.car import car_fmu
from codegen.fmu.controller import controller_fmu
from codegen.fmu.definition import FmuDefinition, Variable
from codegen.fmu.platforms import host_platform

__all__ = [
    "FmuDefinition",
    "Variable",
    "car_fmu",
    "controller_fmu",
    "host_platform",
    "pack",
    "write_sources",
]
