"""Writes the FMU file: descriptions, sources that rebuild it, binaries, documentation."""

import shlex
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Final

from bayesrace.errors import InputError
from bayesrace.files import replacing
from codegen.fmu.definition import FmuDefinition
from codegen.fmu.description import build_description, model_description
from codegen.fmu.licences import Part, licence_files, third_parties
from codegen.fmu.platforms import (
    FLAGS,
    PLATFORMS,
    arguments,
    compile_binary,
    get_platform,
    host_platform,
)
from codegen.fmu.sources import all_sources, linked_files, token_of

__all__ = ["pack", "write_sources"]

_STYLE: Final = "body{font:15px/1.5 sans-serif;max-width:60em;margin:2em auto}"


def _page(definition: FmuDefinition, parts: Sequence[Part]) -> str:
    """``documentation/index.html``, with the one command that makes the Linux binary."""
    kind = "Model Exchange" if definition.states else "Co-Simulation"
    linux = PLATFORMS["x86_64-linux"]
    binary = f"{definition.identifier}.so"
    line = arguments(linux, linked_files(definition, ".c", ".a"), binary, definition.flags)
    return f"""<!DOCTYPE html><html lang="en"><meta charset="utf-8"><style>{_STYLE}</style>
<title>{escape(definition.name)}</title><h1>{escape(definition.name)}</h1>
<p>{escape(definition.description)}. FMI {definition.version}.0 for {kind}.</p>
{definition.documentation}
<h2>Building it again</h2>
<p>In the folder <code>sources</code>, with any C11 compiler; elsewhere than on Linux without the
<code>-Wl</code> options:</p>
<pre>{escape(shlex.join(["cc", *line]))}</pre>
<p>The result belongs into <code>binaries/{linux.folder(definition.version)}</code>; other platforms
have other folders there.</p>
<h2>Licences</h2>
<p>BayesRace is under the MIT licence. Parts of this FMU are by other authors; all texts are in
<a href="licenses/license.txt">licenses</a>:</p>
<ul>{"".join(f"<li>{escape(str(part))}</li>" for part in parts)}</ul></html>
"""


def write_sources(definition: FmuDefinition, folder: Path) -> list[str]:
    """Fills ``folder`` with all that is compiled; returns what the compiler is given, in order."""
    for name, content in all_sources(definition).items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return linked_files(definition, ".c", ".a")


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
            f"{foreign}: export it there"
        )
    parts = third_parties(definition, targets)
    sources = all_sources(definition)
    contents = {
        "modelDescription.xml": model_description(definition, token_of(definition)),
        "documentation/index.html": _page(definition, parts).encode(),
        **licence_files(parts),
        **{f"sources/{name}": content for name, content in sources.items()},
        **{f"resources/{name}": content for name, content in definition.resources.items()},
    }
    if definition.version == 3:
        options = (*FLAGS, *definition.flags)
        contents["sources/buildDescription.xml"] = build_description(definition, options)
    with tempfile.TemporaryDirectory(prefix="fmu-") as temporary:
        folder = Path(temporary) / "sources"
        linked = write_sources(definition, folder)
        for target in targets:
            library = Path(temporary) / f"{definition.identifier}{target.suffix}"
            compile_binary(target, folder, linked, library, definition.flags)
            place = f"binaries/{target.folder(definition.version)}/{library.name}"
            contents[place] = library.read_bytes()
    _write(out, contents)
    return out


def _write(out: Path, contents: Mapping[str, bytes]) -> None:
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
        raise InputError(f"cannot write the FMU to {out}: {error.strerror}") from None
