"""What people read in an FMU: its documentation page and how to rebuild it."""

import shlex
from collections.abc import Sequence
from html import escape
from typing import Final

from codegen.fmu.definition import FmuDefinition
from codegen.fmu.platforms import PLATFORMS, arguments
from codegen.fmu.variables import Variable

__all__ = ["documentation_page", "readme", "rebuild_line"]

_STYLE: Final = (
    "body{font:15px/1.5 sans-serif;max-width:60em;margin:2em auto;padding:0 1em}"
    "table{border-collapse:collapse}td,th{padding:.15em .7em;text-align:left;"
    "border-bottom:1px solid #ccc}code{background:#f2f2f2}pre{background:#f2f2f2;padding:1em;"
    "white-space:pre-wrap}"
)


def rebuild_line(definition: FmuDefinition, sources: Sequence[str]) -> str:
    """The one command that makes the Linux binary from the ``sources`` folder, within it."""
    line = arguments(
        PLATFORMS["x86_64-linux"], sources, f"{definition.identifier}.so", definition.flags
    )
    return shlex.join(["cc", *line])


def readme(definition: FmuDefinition, sources: Sequence[str]) -> str:
    """``sources/README.txt``."""
    folder = PLATFORMS["x86_64-linux"].folder(definition.version)
    return (
        f"{definition.name}: sources of the FMU\n\n"
        "In this folder, with any C11 compiler (elsewhere than on Linux without the -Wl options):\n"
        f"\n    {rebuild_line(definition, sources)}\n\n"
        f"The result belongs into binaries/{folder}/ of the FMU (FMI {definition.version}.0;\n"
        "other platforms have other folders there), under the same name.\n"
    )


def _bound(value: float | None, exclusive: bool, sign: str) -> str:
    if value is None:
        return ""
    return f"{sign} {value:g}" if exclusive else f"{value:g}"


def _row(variable: Variable) -> str:
    cells = (
        f"<code>{escape(variable.name)}</code>",
        escape(variable.causality),
        escape(variable.unit or ""),
        "" if variable.start is None else f"{variable.start:g}",
        escape(_bound(variable.min, variable.exclusive, ">")),
        escape(_bound(variable.max, variable.exclusive, "<")),
        escape(variable.description),
    )
    return f"<tr>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"


def documentation_page(definition: FmuDefinition, sources: Sequence[str]) -> str:
    """``documentation/index.html``."""
    kind = {"cs": "Co-Simulation", "me": "Model Exchange"}[definition.kind]
    titles = ("name", "causality", "unit", "start", "min", "max", "")
    return "\n".join(
        [
            "<!DOCTYPE html>",
            '<html lang="en"><head><meta charset="utf-8">',
            f"<title>{escape(definition.name)}</title><style>{_STYLE}</style></head><body>",
            f"<h1>{escape(definition.name)}</h1>",
            f"<p>{escape(definition.description)}. FMI {definition.version}.0 for {kind}.</p>",
            definition.documentation,
            "<h2>Variables</h2>",
            f"<table><tr>{''.join(f'<th>{title}</th>' for title in titles)}</tr>",
            *(_row(variable) for variable in definition.variables),
            "</table>",
            "<h2>Building it again</h2>",
            "<p>The folder <code>sources</code> has all it takes; there:</p>",
            f"<pre>{escape(rebuild_line(definition, sources))}</pre>",
            "</body></html>",
            "",
        ]
    )
