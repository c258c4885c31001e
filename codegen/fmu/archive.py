"""Writes the FMU file: descriptions, sources that rebuild it, binaries, documentation."""

import hashlib
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from importlib.metadata import distribution
from pathlib import Path
from typing import Final

from bayesrace.errors import InputError
from bayesrace.files import replacing
from codegen.fmu.definition import FmuDefinition
from codegen.fmu.description import build_description, icon_description, model_description
from codegen.fmu.icon import car_icon
from codegen.fmu.page import documentation_page, readme
from codegen.fmu.platforms import EXPORTS, FLAGS, Platform, compile_binary, get_platform
from codegen.fmu.platforms import host_platform as _host
from codegen.fmu.tables import config_header, tables_header

__all__ = ["pack", "write_sources"]

_NATIVE: Final = Path(__file__).parent / "native"

_SHARED: Final = ("fmu_layer.c", "fmu_layer.h", "fmu_model.h", "fmu_saved.c")
_LAYER: Final = {2: ("fmi2.c",), 3: ("fmi3.c", "fmi3_absent.c")}
_HEADERS: Final = {
    2: ("fmi2Functions.h", "fmi2FunctionTypes.h", "fmi2TypesPlatform.h"),
    3: ("fmi3Functions.h", "fmi3FunctionTypes.h", "fmi3PlatformTypes.h"),
}

_DATE: Final = (1980, 1, 1, 0, 0, 0)
"""Of every file, so that the same FMU is the same file."""


def _fmi_headers() -> Path:
    import fmpy

    return Path(fmpy.__file__).parent / "c-code"


def _tree(folder: Path) -> Iterator[Path]:
    return (path for path in sorted(folder.rglob("*")) if path.is_file())


def _fixed_sources(definition: FmuDefinition) -> dict[str, bytes]:
    """Every file of ``sources/`` that does not depend on the token."""
    files = {name: (_NATIVE / name).read_bytes() for name in _SHARED + _LAYER[definition.version]}
    for name in _HEADERS[definition.version]:
        files[name] = (_fmi_headers() / name).read_bytes()
    files["fmu_tables.h"] = tables_header(definition).encode()
    files["exports.map"] = EXPORTS.encode()
    given = {path.name: path.read_bytes() for path in (*definition.sources, *definition.archives)}
    given |= {name: text.encode() for name, text in definition.texts.items()}
    for below, folder in definition.trees.items():
        given |= {
            f"{below}/{path.relative_to(folder).as_posix()}": path.read_bytes()
            for path in _tree(folder)
        }
    taken = sorted(files.keys() & given.keys() | given.keys() & {"fmu_config.h", "README.txt"})
    if taken:
        raise InputError(f"FMU '{definition.name}': the packer writes {', '.join(taken)} itself")
    return files | given


def _token(definition: FmuDefinition, files: dict[str, bytes], compiled: list[str]) -> str:
    """Instantiation token: names what was compiled and the resources it was exported with."""
    digest = hashlib.sha256(model_description(definition, "", compiled))
    digest.update(config_header(definition, "").encode())
    for name, content in sorted((files | dict(definition.resources)).items()):
        digest.update(name.encode() + b"\0" + content + b"\0")
    text = digest.hexdigest()
    return f"{{{text[:8]}-{text[8:12]}-{text[12:16]}-{text[16:20]}-{text[20:32]}}}"


def _contents(definition: FmuDefinition) -> tuple[dict[str, bytes], list[str]]:
    """Every file of the archive but the binaries; and what the compiler is given, in order."""
    files = _fixed_sources(definition)
    compiled = sorted(name for name in files if name.endswith(".c") and "/" not in name)
    linked = [*compiled, *(path.name for path in definition.archives)]
    token = _token(definition, files, compiled)
    files["fmu_config.h"] = config_header(definition, token).encode()
    files["README.txt"] = readme(definition, linked).encode()
    icon = car_icon()
    contents = {
        "modelDescription.xml": model_description(definition, token, compiled),
        "documentation/index.html": documentation_page(definition, linked).encode(),
    }
    if licence := distribution("bayesrace").read_text("licenses/LICENSE"):
        contents["documentation/licenses/license.txt"] = licence.encode()
    if definition.version == 2:
        contents["model.png"] = icon
    else:
        options = " ".join((*FLAGS, *definition.flags))
        archives = [path.name for path in definition.archives]
        files["buildDescription.xml"] = build_description(definition, compiled, options, archives)
        contents["terminalsAndIcons/terminalsAndIcons.xml"] = icon_description()
        contents["terminalsAndIcons/icon.png"] = icon
    contents |= {f"sources/{name}": content for name, content in files.items()}
    contents |= {f"resources/{name}": content for name, content in definition.resources.items()}
    return contents, linked


def _write_sources(contents: dict[str, bytes], folder: Path) -> None:
    for name, content in contents.items():
        if name.startswith("sources/"):
            path = folder / name.removeprefix("sources/")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)


def write_sources(definition: FmuDefinition, folder: Path) -> list[str]:
    """Fills ``folder`` with all that is compiled; returns what the compiler is given, in order."""
    contents, linked = _contents(definition)
    _write_sources(contents, folder)
    return linked


def _targets(definition: FmuDefinition, platforms: Sequence[str] | None) -> list[Platform]:
    host = _host()
    targets = [host] if platforms is None else [get_platform(name) for name in platforms]
    if not targets:
        raise InputError("an FMU needs at least one platform")
    foreign = [target.name for target in targets if target != host]
    if definition.archives and foreign:
        raise InputError(
            f"'{definition.name}' links a library of this machine and cannot be built for "
            f"{', '.join(foreign)}: export it there"
        )
    return targets


def pack(definition: FmuDefinition, out: Path, platforms: Sequence[str] | None = None) -> Path:
    """Writes the FMU to ``out`` with a binary for each platform (default: this machine's).

    The file appears complete or not at all. Raises InputError for a platform that cannot be built
    for or a place that cannot be written to, CompileError with the compiler's words.
    """
    targets = _targets(definition, platforms)
    contents, linked = _contents(definition)
    with tempfile.TemporaryDirectory(prefix="fmu-") as temporary:
        folder = Path(temporary) / "sources"
        _write_sources(contents, folder)
        for target in targets:
            library = Path(temporary) / f"{definition.identifier}{target.suffix}"
            compile_binary(target, folder, linked, library, definition.flags)
            place = f"binaries/{target.folder(definition.version)}/{library.name}"
            contents[place] = library.read_bytes()
    _write(out, contents)
    return out


def _write(out: Path, contents: dict[str, bytes]) -> None:
    first = "modelDescription.xml"
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with (
            replacing(out) as partial,
            zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as archive,
        ):
            for name in sorted(contents, key=lambda name: (name != first, name)):
                entry = zipfile.ZipInfo(name, date_time=_DATE)
                entry.compress_type = zipfile.ZIP_DEFLATED
                entry.external_attr = 0o100644 << 16
                entry.create_system = 3
                archive.writestr(entry, contents[name])
    except OSError as error:
        raise InputError(f"cannot write the FMU to {out}: {error.strerror}") from None
