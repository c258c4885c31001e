"""What an FMU is before it is packed: everything the XML, the C and the archive are made from."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from bayesrace.errors import InputError
from codegen.fmu.variables import Variable

__all__ = ["FmuDefinition"]


@dataclass(frozen=True)
class FmuDefinition:
    """An FMU of one FMI version and kind, ready for :func:`codegen.fmu.pack`.

    ``sources`` and ``texts`` together implement ``fmu_model.h``; ``fmu_config.h``, the FMI layers
    and the FMI headers are added by the packer. InputError for a definition that cannot be packed.
    """

    name: str
    """Model name shown to people."""
    identifier: str
    """C identifier: file name of the binaries."""
    description: str
    """One line."""
    version: Literal[2, 3]
    """FMI 2.0 or 3.0."""
    kind: Literal["cs", "me"]
    """Co-Simulation, or Model Exchange (FMI 3.0 only)."""
    variables: tuple[Variable, ...]
    """In the order of their value references; time, which every FMU has, comes on top."""
    sources: tuple[Path, ...]
    """Hand-written C files and headers; they go flat into ``sources/``."""
    texts: Mapping[str, str] = field(default_factory=dict)
    """Generated C files and headers: file name to content."""
    trees: Mapping[str, Path] = field(default_factory=dict)
    """Folders of headers to copy below ``sources/``: name there to folder."""
    archives: tuple[Path, ...] = ()
    """Static libraries of the host platform to link (then no other platform can be built); they
    are copied into ``sources/`` as well."""
    flags: tuple[str, ...] = ()
    """Compiler flags after the packer's own."""
    constants: Mapping[str, float | int | str] = field(default_factory=dict)
    """Further macros for ``fmu_config.h``: numbers as exact literals, text as a C string."""
    resources: Mapping[str, bytes] = field(default_factory=dict)
    """Files of the ``resources/`` folder: relative path to content."""
    documentation: str = ""
    """Body of the documentation page, HTML; the table of variables is added."""
    default_step_s: float = 0.02
    saves: Literal["none", "instance", "serialised"] = "serialised"
    """State get and set: not at all; within an instance (model memory may hold pointers into
    itself); or also as bytes for another instance (model memory holds no pointers)."""
    derivatives: bool = False
    """Model Exchange: directional and adjoint derivatives exist."""

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", self.identifier):
            raise InputError(f"FMU '{self.identifier}': the identifier must be a C identifier")
        if self.version not in (2, 3):
            raise InputError(f"FMI version {self.version} cannot be written; choose 2 or 3")
        if self.kind not in ("cs", "me"):
            raise InputError(f"FMU kind '{self.kind}' is unknown; choose cs or me")
        if self.version == 2 and self.kind == "me":
            raise InputError("Model Exchange is exported for FMI 3.0 only: use --version 3")
        names = [variable.name for variable in self.variables]
        repeated = {name for name in (*names, "time") if [*names, "time"].count(name) > 1}
        if repeated:
            raise InputError(f"FMU '{self.name}' has two variables named {sorted(repeated)}")
        known = set(names)
        for variable in self.variables:
            others = (*(variable.dependencies or ()), *(variable.initial_dependencies or ()))
            for other in (variable.derivative_of, *others):
                if other is not None and other not in known:
                    raise InputError(f"variable '{variable.name}' refers to unknown '{other}'")
        if self.states and self.kind == "cs":
            raise InputError("a Co-Simulation FMU declares no derivatives of states")

    @property
    def states(self) -> tuple[str, ...]:
        """Continuous states in the order of their derivatives; Model Exchange only."""
        return tuple(v.derivative_of for v in self.variables if v.derivative_of is not None)
