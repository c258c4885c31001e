"""Builds the FMU of ``tests/native/faulty_fmu.c``: a simple car with any fault asked for."""

import inspect
import re
import subprocess
import zipfile
from enum import IntEnum
from functools import cache
from pathlib import Path
from typing import Final

import fmpy
from fmpy.fmi2 import FMU2Slave
from fmpy.fmi3 import FMU3Slave

from bayesrace.cache import software
from bayesrace.codegen.compiler import find_compiler
from bayesrace.plant.fmu.host import FmuHost
from bayesrace.plant.fmu.inspection import inspect as inspect_fmu
from bayesrace.vehicles.models import STATES
from tests.shared import shared_folder

__all__ = [
    "PATIENCE_S", "STATES", "Mode", "faulty_fmu", "faulty_host", "faulty_library", "folder_of",
    "process_of",
]  # fmt: skip

SOURCE: Final = Path(__file__).parent / "native" / "faulty_fmu.c"
HEADERS: Final = Path(fmpy.__file__).parent / "c-code"
PATIENCE_S: Final = 20.0
"""For what takes a second at most on an idle machine."""

Mode = IntEnum(
    "Mode",
    "GOOD ABORT SEGFAULT EXIT HANG NOT_A_NUMBER FAIL REFUSE FLOOD_LOG FLOOD_STDOUT SLOW TERMINATE "
    "INIT_FAILS INIT_HANGS INIT_ABORTS HUGE_VALUE CLOSE_ALL EARLY SAY WORST SCRIBBLE ORPHAN",
    start=0,
)
"""What goes wrong; of these names the C file makes an enumeration."""


@cache
def faulty_library(version: int) -> Path:
    """The library; functions that the C file lacks answer "error"."""
    source, compiler = SOURCE.read_text(), find_compiler()
    slave = FMU3Slave if version == 3 else FMU2Slave
    called = [name for name, _ in inspect.getmembers(slave) if name.startswith(f"fmi{version}")]
    types = re.findall(r"^ACCESS\((\w+),", source, re.MULTILINE)
    there = {f"fmi{version}{macro}{kind}" for macro in ("Get", "Set") for kind in types}
    there |= set(re.findall(r"\b(fmi[23]\w+)\(", source))
    there |= {f"fmi{version}{name}" for name in re.findall(r"F\((\w+)\)\(", source)}
    stubs = "".join(
        f'__attribute__((visibility("default"))) int {name}(void) {{ return 3; }}\n'
        for name in called
        if name not in there
    )
    names = ",".join(name.upper() for name, *_ in _VARIABLES)
    enums = f"-DREFERENCE_NAMES={names}", f"-DMODES={','.join(Mode.__members__)}"
    flags = "-shared", "-fPIC", "-O1", f"-DFMI={version}", f"-I{HEADERS}", *enums
    line = [*compiler.command, *flags]

    def make(folder: Path) -> None:
        text = folder / "faulty.c"
        text.write_text(source + stubs)
        command = [*line, str(text), "-lm", "-o", str(folder / "faulty.so")]
        subprocess.run(command, check=True, capture_output=True, timeout=120)

    parts = [*line, compiler.version, source, stubs, *software((), ("fmpy",))]
    return shared_folder("faulty-fmu", parts, make) / "faulty.so"


def faulty_fmu(
    library: Path,
    out: Path,
    version: int = 2,
    *,
    guid: str = "good",
    attributes: str = 'canHandleVariableCommunicationStepSize="true"',
    platform: str = "",
) -> Path:
    """Packs the library into an FMU; the parameters ``mode`` and ``at_s`` say what goes wrong."""
    folder = platform or (fmpy.platform_tuple if version == 3 else fmpy.platform)
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("modelDescription.xml", _description(version, guid, attributes))
        archive.write(library, f"binaries/{folder}/faulty{fmpy.sharedLibraryExtension}")
    return out


def faulty_host(path: Path, outputs: tuple[str, ...] = STATES) -> FmuHost:
    """The FMU in a process of its own."""
    return FmuHost(
        path,
        inspect_fmu(path),
        ("d", "delta_rate"),
        outputs,
        timeout_s=PATIENCE_S,
        startup_s=PATIENCE_S,
    )


def process_of(host: FmuHost) -> subprocess.Popen[bytes]:
    """The process that the FMU runs in."""
    assert host._process is not None
    return host._process


def folder_of(process: subprocess.Popen[bytes]) -> Path:
    """The unpacked FMU of such a process."""
    return Path(f"/proc/{process.pid}/cwd").readlink()


_REAL = ("Real", "Float64")
_VARIABLES: Final[tuple[tuple[str, tuple[str, str], str, str | None], ...]] = (
    ("d", _REAL, "input", "0"),
    ("delta_rate", _REAL, "input", "0"),
    *((name, _REAL, "output", "0") for name in STATES),
    ("at_s", _REAL, "parameter", "0"),
    ("mode", _REAL, "parameter", "0"),
    ("gear", ("Integer", "UInt8"), "input", "0"),
    ("light", ("Boolean", "Boolean"), "input", "false"),
    ("gear_read", _REAL, "output", None),
    ("light_read", ("Real", "Float32"), "output", None),
    ("label", ("String", "String"), "parameter", ""),
    ("label_length", _REAL, "output", None),
    ("instances", _REAL, "output", None),
    ("soft", ("", "Float32"), "parameter", "1"),
    ("small", ("", "UInt8"), "parameter", "1"),
)
"""Name, types in FMI 2.0 and 3.0, causality and start value, in the order of value references."""


def _description(version: int, guid: str, attributes: str) -> str:
    """The model description."""
    lines = []
    for reference, (name, kinds, causality, start) in enumerate(_VARIABLES):
        kind = kinds[version - 2]
        how = f'name="{name}" valueReference="{reference}" causality="{causality}"'
        how += ' initial="exact"' * (causality == "output" and start is not None)
        value = "" if start is None else f' start="{start}"'
        if kind == "":
            continue
        if version == 2:
            how += ' variability="fixed"' * (causality == "parameter")
            how += ' variability="discrete"' * (kind in ("Integer", "Boolean"))
            lines.append(f"<ScalarVariable {how}><{kind}{value}/></ScalarVariable>")
        elif kind == "String":
            lines.append(f'<{kind} {how}><Start value="{start}"/></{kind}>')
        else:
            lines.append(f"<{kind} {how}{value}/>")
    if version == 3:
        lines.append('<Float64 name="time" valueReference="99" causality="independent"/>')
    token = "guid" if version == 2 else "instantiationToken"
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="{version}.0" modelName="faulty" {token}="{guid}">
<CoSimulation modelIdentifier="faulty" {attributes}/>
<ModelVariables>
{"".join(lines)}
</ModelVariables>
<ModelStructure/>
</fmiModelDescription>
"""
