"""What other authors have written of an FMU, and under which licence.

The texts are those of the installed packages that the parts come from. THIRD_PARTY_NOTICES.md names
the same parts.
"""

import re
from collections.abc import Sequence
from importlib.metadata import distribution
from pathlib import Path
from typing import NamedTuple

from bayesrace.errors import InputError
from codegen.fmu.definition import FmuDefinition
from codegen.fmu.platforms import Platform
from codegen.fmu.sources import fmi_headers

__all__ = ["Part", "licence_files", "third_parties"]


class Part(NamedTuple):
    """Something in an FMU that another project owns.

    ``package``: the installed one that it comes from; ``where``: in the FMU; ``text``: the licence
    with its copyright lines.
    """

    name: str
    package: str
    licence: str
    where: str
    text: str

    @property
    def file(self) -> str:
        """Name of the file with the text."""
        return f"{self.name.replace(' ', '-')}.txt"

    def __str__(self) -> str:
        """One line."""
        version = distribution(self.package).version
        return f"{self.name} ({self.package} {version}), {self.licence}: {self.where}"


def _folder(package: str) -> Path:
    return Path(str(distribution(package).locate_file(package)))


def _comment(path: Path, beginning: str) -> str:
    """The comment of a C file from the line with ``beginning`` on."""
    found = re.search(rf"[^\n]*{beginning}.*?(?=\*/|\n\n\n)", path.read_text("utf-8"), re.DOTALL)
    if found is None:
        raise InputError(f"{path} names no licence: install its package again")
    return re.sub(r"(?m)^[ */]+", "", found[0])


def third_parties(definition: FmuDefinition, targets: Sequence[Platform]) -> list[Part]:
    """The parts of an FMU with binaries for ``targets``."""
    casadi = _folder("casadi") / "include"
    fmi = _comment(fmi_headers(definition.version)[0], "Copyright")
    runtime = _comment(casadi / "casadi/core/runtime/casadi_low.hpp", "MIT No Attribution")
    where = f"sources/fmi{definition.version}*.h"
    parts = [
        Part("FMI headers", "fmpy", "BSD-2-Clause", where, fmi),
        Part("CasADi runtime", "casadi", "MIT-0", "parts of sources/*_model.c", runtime),
    ]
    if definition.libraries:
        text = (casadi / "licenses/daqp-external/LICENSE").read_text("utf-8")
        where = "sources/libdaqpstat.a, sources/daqp, the binary"
        parts.append(Part("DAQP", "casadi", "MIT", where, text))
    zig = [target.name for target in targets if "ziglang" in target.command()]
    if zig:
        text = (_folder("ziglang") / "LICENSE").read_text("utf-8")
        parts.append(Part("Zig compiler runtime", "ziglang", "MIT", ", ".join(zig), text))
    if windows := [name for name in zig if name.endswith("windows")]:
        text = (_folder("ziglang") / "lib/libc/mingw/COPYING").read_text("utf-8")
        licence = "ZPL-2.1 and public domain"
        parts.append(Part("MinGW-w64 runtime", "ziglang", licence, ", ".join(windows), text))
    return parts


def licence_files(parts: Sequence[Part]) -> dict[str, bytes]:
    """``documentation/licenses``: BayesRace's own in ``license.txt``, which names the others."""
    own = distribution("bayesrace").read_text("licenses/LICENSE") or "MIT License\n"
    note = (
        "Parts of this FMU are by other authors. Beside them, binaries hold start-up code of the\n"
        "compiler that built them, such as GCC's under the GCC Runtime Library Exception.\n"
    )
    names = "".join(f"- {part}; {part.file}\n" for part in parts)
    texts = {"license.txt": f"{own}\n{note}\n{names}", **{part.file: part.text for part in parts}}
    return {f"documentation/licenses/{name}": text.encode() for name, text in texts.items()}
