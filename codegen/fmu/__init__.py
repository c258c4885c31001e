"""Exports the car and its controller as FMUs, FMI 2.0 or 3.0, for other tools.

In the order of their use: :mod:`.car` and :mod:`.controller` say what the FMU is, as a
:class:`FmuDefinition`; :mod:`.build` writes its C around the hand-written files in ``native`` and
compiles it; :func:`pack` makes the file with its XML (:mod:`.archive`), and
:func:`exchange_weights` one with other weights; :func:`pack_loop` connects both (:mod:`.ssp`).

In ``native``, ``fmu.h`` says what the C of a model implements; ``fmi.c`` and ``fmi2.c`` or
``fmi3.c``, which call it, are the same for every model.
"""

from bayesrace.codegen.fmu.archive import exchange_weights, pack
from bayesrace.codegen.fmu.build import FmuDefinition, Variable
from bayesrace.codegen.fmu.car import car_fmu
from bayesrace.codegen.fmu.controller import controller_fmu
from bayesrace.codegen.fmu.ssp import pack_loop

__all__ = [
    "FmuDefinition", "Variable", "car_fmu", "controller_fmu", "exchange_weights", "pack",
    "pack_loop",
]  # fmt: skip
