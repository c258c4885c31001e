"""Packs a model in C with its variables into an FMU, FMI 2.0 or 3.0.

:class:`FmuDefinition` says what the FMU is, :func:`pack` writes the file. The C side of the
interface is ``native/fmu_model.h``.
"""

from codegen.fmu.archive import pack, write_sources
from codegen.fmu.definition import FmuDefinition
from codegen.fmu.platforms import PLATFORMS, host_platform
from codegen.fmu.variables import Variable

__all__ = ["PLATFORMS", "FmuDefinition", "Variable", "host_platform", "pack", "write_sources"]
