"""The FMU file: descriptions, sources that rebuild it, binaries, documentation, licences.

The texts are those of the templates beside this module: the model description of FMI 2.0 and 3.0,
the build description of FMI 3.0, the page of documentation; those of an SSP are rendered alike.
"""

import re
import shlex
import tempfile
import zipfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import distribution
from math import isfinite
from pathlib import Path
from typing import Any, Final, NamedTuple

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from bayesrace.codegen.fmu.build import (
    FLAGS,
    FmuDefinition,
    Variable,
    arguments,
    fmi_headers,
    linked_files,
    sources_of,
    write_sources,
)
from bayesrace.codegen.host_files import HEAD, IDENTITY_BYTES, WEIGHTS_FILE, weights_file
from bayesrace.codegen.platforms import PLATFORMS, Platform, get_platform, host_platform
from bayesrace.errors import InputError
from bayesrace.files import replacing
from bayesrace.gp.weights import Weights

__all__ = [
    "exchange_weights", "licence_files", "pack", "rendered", "third_parties", "units_of",
    "write_archive",
]  # fmt: skip

_LARGEST: Final = 1 << 30
_TYPES: Final = {
    2: {"real": "Real", "integer": "Integer", "boolean": "Boolean"},
    3: {"real": "Float64", "integer": "Int32", "boolean": "Boolean"},
}
_BASE: Final = {
    "kg": {"kg": 1}, "m": {"m": 1}, "s": {"s": 1}, "rad": {"rad": 1},
    "N": {"kg": 1, "m": 1, "s": -2}, "1": {},
}  # fmt: skip
"""Exponents of base units."""


class Part(NamedTuple):
    """Something in an FMU that another project owns.

    ``package``: the installed one that it comes from; ``where``: in the FMU; ``text``: the licence
    with its copyright lines. THIRD_PARTY_NOTICES.md names the same parts.
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


def third_parties(definition: FmuDefinition, targets: Sequence[Platform]) -> list[Part]:
    """The parts of an FMU with binaries for ``targets``."""

    def text(package: str, path: str) -> str:
        return Path(str(distribution(package).locate_file(f"{package}/{path}"))).read_text("utf-8")

    fmi = fmi_headers(definition.version)[0].read_text("utf-8")
    casadi = text("casadi", "include/casadi/core/runtime/casadi_low.hpp")
    where = f"sources/fmi{definition.version}*.h"
    parts = [
        Part("FMI headers", "fmpy", "BSD-2-Clause", where, _comment(fmi, "Copyright")),
        Part(
            *("CasADi runtime", "casadi", "MIT-0", "parts of sources/*_model.c"),
            _comment(casadi, "MIT No Attribution"),
        ),
    ]
    if any(name.startswith("daqp/") for name in definition.sources):
        daqp = text("casadi", "include/licenses/daqp-external/LICENSE")
        library = "sources/libdaqpstat.a, " if definition.libraries else ""
        where = f"{library}sources/daqp, the binary"
        parts.append(Part("DAQP", "casadi", "MIT", where, daqp))
    zig = [target.name for target in targets if "ziglang" in target.compiler().command]
    if names := ", ".join(zig):
        licence = text("ziglang", "LICENSE")
        parts.append(Part("Zig compiler runtime", "ziglang", "MIT", names, licence))
    if names := ", ".join(name for name in zig if name.endswith("windows")):
        mingw, licence = text("ziglang", "lib/libc/mingw/COPYING"), "ZPL-2.1 and public domain"
        parts.append(Part("MinGW-w64 runtime", "ziglang", licence, names, mingw))
    return parts


def _comment(source: str, beginning: str) -> str:
    """The comment of a C file from the line with ``beginning`` on."""
    found = re.search(rf"[^\n]*{beginning}.*?(?=\*/|\n\n\n)", source, re.DOTALL)
    if found is None:
        raise InputError(f"a C file lacks its licence ('{beginning}'): install its package again")
    return re.sub(r"(?m)^[ */]+", "", found[0])


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


def rendered(template: str, **values: Any) -> bytes:
    """A template's text with these values, escaped as XML and HTML need it."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True,
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    text = environment.get_template(f"{template}.j2").render(**values)
    return f"{text}\n".encode()


def _model_description(definition: FmuDefinition, token: str, linked: Sequence[str]) -> bytes:
    """``modelDescription.xml``; ``linked``: what the compiler is given."""
    return rendered(
        "modelDescription.xml",
        fmu=definition,
        token=token,
        files=[name for name in linked if name.endswith(".c")],
        units=units_of(definition.all_variables),
        variables=[_described(definition, *one) for one in enumerate(definition.all_variables)],
        structure=_structure(definition),
    )


def _build_description(definition: FmuDefinition, linked: Sequence[str]) -> bytes:
    """``sources/buildDescription.xml`` of FMI 3.0."""
    files, libraries = ([name for name in linked if name.endswith(end)] for end in (".c", ".a"))
    flags = (*FLAGS, *definition.flags)
    return rendered(
        "buildDescription.xml", fmu=definition, files=files, libraries=libraries, flags=flags
    )


def units_of(variables: Iterable[Variable]) -> dict[str, dict[str, int]]:
    """Units in use, each with its exponents of base units; InputError for others than of
    kg, m, s and rad."""
    names = {v.unit for v in variables if v.unit is not None}
    return {name: _base_units(name) for name in sorted(names)}


def _base_units(unit: str) -> dict[str, int]:
    """Exponents of kg, m, s, rad in a unit like ``N.s2/m2``; InputError if it has others."""
    exponents = dict.fromkeys(("kg", "m", "rad", "s"), 0)
    for over, name, power in re.findall(r"(/?)([A-Za-z]+|1)([0-9]*)", unit):
        if name not in _BASE:
            raise InputError(f"unit '{unit}' is not made of {', '.join(_BASE)} alone")
        for base, exponent in _BASE[name].items():
            exponents[base] += exponent * int(power or 1) * (-1 if over else 1)
    return {base: exponent for base, exponent in exponents.items() if exponent}


def _number(value: float, kind: str) -> str:
    if kind == "boolean":
        return "true" if value else "false"
    return str(int(value)) if kind == "integer" else repr(float(value))


def _described(
    definition: FmuDefinition, reference: int, variable: Variable
) -> tuple[str, dict[str, Any], dict[str, Any]]:
    """A variable's type, and its attributes: those of every type, and those of its own."""
    common = {
        "name": variable.name,
        "valueReference": reference,
        "description": variable.description,
        "causality": variable.causality,
        "variability": variable.variability,
    }
    if variable.causality not in ("input", "independent"):  # FMI gives these no 'initial'
        common["initial"] = "calculated" if variable.start is None else "exact"
    typed: dict[str, Any] = {"unit": variable.unit}  # what is None is left out
    for name in ("min", "max", "nominal", "start"):
        value = getattr(variable, name)
        if value is not None and isfinite(value):
            typed[name] = _number(value, variable.kind)
    if variable.derivative_of is not None:
        typed["derivative"] = definition.states.index(variable.derivative_of)
    return _TYPES[definition.version][variable.kind], common, typed


def _structure(definition: FmuDefinition) -> dict[str, list[dict[str, Any]]]:
    """Unknowns and what they depend on: by index, from 1, in FMI 2.0, else by reference."""
    two = definition.version == 2
    place = {v.name: i for i, v in enumerate(definition.variables, start=int(two))}
    outputs = [v for v in definition.variables if v.causality == "output"]
    derivatives = [v for v in definition.variables if v.derivative_of is not None]
    # before the run, calculated outputs are constants, derivatives may depend on all that is set
    given = tuple(v.name for v in definition.variables if v.start is not None)

    def row(unknown: Variable, known: Sequence[str] | None) -> dict[str, Any]:
        dependencies = None if known is None else " ".join(str(place[name]) for name in known)
        where = "index" if two else "valueReference"
        return {where: place[unknown.name], "dependencies": dependencies}

    return {
        "Output": [row(v, v.dependencies) for v in outputs],
        "ContinuousStateDerivative": [row(v, v.dependencies) for v in derivatives],
        "InitialUnknown": [row(v, ()) for v in outputs if v.start is None]
        + [row(v, given) for v in derivatives],
    }


def _page(definition: FmuDefinition, linked: Sequence[str], parts: Sequence[Part]) -> bytes:
    """``documentation/index.html``, with the one command that makes the Linux binary."""
    linux = PLATFORMS["x86_64-linux"]
    line = arguments(linux, linked, f"{definition.identifier}.so", definition.flags)
    folder = linux.folder(definition.version)
    return rendered(
        "index.html", fmu=definition, line=shlex.join(["cc", *line]), folder=folder, parts=parts
    )


def pack(definition: FmuDefinition, out: Path, platforms: Sequence[str] | None = None) -> Path:
    """Writes the FMU to ``out`` with a binary for each platform (default: this machine's).

    The file appears complete or not at all. Raises InputError for a platform that cannot be built
    for or a place that cannot be written to, CompileError with the compiler's words.
    """
    host = host_platform()
    targets = [host] if platforms is None else [get_platform(name) for name in platforms]
    foreign = ", ".join(target.name for target in targets if target != host)
    if not targets:
        raise InputError("an FMU needs at least one platform")
    if definition.libraries and foreign:
        raise InputError(
            f"'{definition.name}' links a library of this machine and cannot be built for "
            f"{foreign}: export it there, or give the artefact of 'bayesrace build --daqp'"
        )
    parts = third_parties(definition, targets)
    token, sources = sources_of(definition)
    linked = linked_files(sources)
    contents = {
        "modelDescription.xml": _model_description(definition, token, linked),
        "documentation/index.html": _page(definition, linked, parts),
        **licence_files(parts),
        **{f"sources/{name}": content for name, content in sources.items()},
        **{f"resources/{name}": content for name, content in definition.resources.items()},
    }
    if definition.version == 3:
        contents["sources/buildDescription.xml"] = _build_description(definition, linked)
    with tempfile.TemporaryDirectory(prefix="fmu-") as temporary:
        folder = Path(temporary) / "sources"
        write_sources(sources, folder)
        for target in targets:
            binary = Path(temporary) / f"{definition.identifier}{target.suffix}"
            line = arguments(target, linked, str(binary), definition.flags)
            target.compiler().run(*line, folder=folder)
            place = f"binaries/{target.folder(definition.version)}/{binary.name}"
            contents[place] = binary.read_bytes()
    write_archive(out, contents)
    return out


def write_archive(out: Path, contents: Mapping[str, bytes]) -> None:
    """The same contents give the same file: no entry has a time or the rights of this machine."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with replacing(out) as partial, zipfile.ZipFile(partial, "w") as archive:
            for name, content in contents.items():
                entry = zipfile.ZipInfo(name)
                entry.external_attr = 0o100644 << 16
                entry.create_system = 3
                archive.writestr(entry, content, zipfile.ZIP_DEFLATED)
    except OSError as error:
        raise InputError(f"cannot write {out}: {error.strerror}") from None


def exchange_weights(fmu: Path, weights: Weights | None, out: Path) -> None:
    """Writes ``fmu``, a controller's, with other weights to ``out`` (which may be ``fmu``).

    InputError if ``fmu`` is no controller's FMU, or the weights are for another model or have more
    points than the controller has room for.
    """
    name = f"resources/{WEIGHTS_FILE}"
    try:
        with zipfile.ZipFile(fmu) as archive:
            size = sum(info.file_size for info in archive.infolist())
            if size > _LARGEST:
                raise InputError(f"{fmu} would unpack to {size >> 20} MB: no FMU of a controller")
            contents = {info.filename: archive.read(info) for info in archive.infolist()}
    except (OSError, RuntimeError, EOFError, zlib.error, zipfile.BadZipFile) as error:
        raise InputError(f"{fmu} cannot be read as an FMU: {error}") from None
    before = contents.get(name)
    if before is None:
        raise InputError(f"{fmu} is not a controller's FMU: it holds no {name}")
    if len(before) < HEAD.size + IDENTITY_BYTES:
        raise InputError(f"{fmu}: {name} is cut off; export the FMU again")
    capacity = HEAD.unpack_from(before)[4]
    identity = before[HEAD.size :][:IDENTITY_BYTES].rstrip(b"\0").decode("utf-8", "replace")
    write_archive(out, contents | {name: weights_file(weights, identity, capacity)})
