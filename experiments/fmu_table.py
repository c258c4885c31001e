"""What an FMU says of itself, on the terminal."""

import math
from collections.abc import Iterator, Sequence
from typing import Final, Literal

from rich import box
from rich.console import Console, ConsoleOptions, RenderableType
from rich.table import Table
from rich.text import Text

from experiments.printable import printable
from plant.fmu.inspection import FmuDescription, Variable

__all__ = ["FmuTable"]

_SECTIONS: Final = (
    ("inputs", ("input",)),
    ("outputs", ("output",)),
    ("parameters", ("parameter", "structuralParameter", "calculatedParameter")),
    ("locals", ("local",)),
)


_COLUMNS: Final = ("variable", "type", "unit", "start", "range", "description")


class FmuTable:
    """An FMU's interfaces, platforms and variables, for rich to print; inputs come first.

    Local variables, of which some tools write thousands, are counted; ``all_`` lists them too.
    """

    def __init__(self, description: FmuDescription, *, all_: bool = False) -> None:
        self._fmu = description
        self._all = all_

    def __rich_console__(
        self, console: Console, options: ConsoleOptions
    ) -> Iterator[RenderableType]:
        yield from self._head()
        rows = [
            (title, variable)
            for title, causalities in _SECTIONS
            for variable in self._fmu.variables
            if variable.causality in causalities and (self._all or title != "locals")
        ]
        yield _table(rows)
        hidden = sum(one.causality == "local" for one in self._fmu.variables)
        if hidden and not self._all:
            yield Text(f"and {hidden} local variable(s)", style="dim")

    def _head(self) -> Iterator[Text]:
        fmu = self._fmu
        interfaces = " and ".join(fmu.interfaces) or "no interface"
        yield Text.assemble(
            (printable(fmu.model_name), "bold"), f" · FMI {printable(fmu.fmi_version)} {interfaces}"
        )
        if fmu.description:
            yield Text(printable(fmu.description))
        words = [f"for {', '.join(map(printable, fmu.platforms)) or 'no platform: sources only'}"]
        if fmu.tool:
            words.append(f"by {printable(fmu.tool)}")
        if fmu.default_step_s is not None:
            words.append(f"step {fmu.default_step_s:g} s")
        words.append("any step" if fmu.variable_step else "one fixed step")
        if fmu.needs_tool:
            words.append("needs the tool it comes from")
        yield Text(" · ".join(words))
        if not fmu.co_simulation:
            yield Text("the plant runs Co-Simulation FMUs only: not this one", style="red")


def _table(rows: Sequence[tuple[str, Variable]]) -> Table:
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False, show_edge=False)
    cells = [_cells(variable) for _, variable in rows]
    # Room goes to the names: what no variable has gets no column.
    shown = [title for i, title in enumerate(_COLUMNS) if any(row[i].plain for row in cells)]
    table.add_column("", style="bold")
    for title in shown:
        justify: Literal["left", "right"] = "right" if title == "start" else "left"
        table.add_column(title, justify=justify, overflow="fold")
    before = None
    for (title, _), row in zip(rows, cells, strict=True):
        if before not in (None, title):
            table.add_section()
        values = [cell for name, cell in zip(_COLUMNS, row, strict=True) if name in shown]
        table.add_row(title if title != before else "", *values)
        before = title
    return table


def _cells(variable: Variable) -> list[Text]:
    kind = variable.fmi_type + ("[]" if variable.array else "")
    unit = variable.unit_name or ""
    # A unit that nobody understands is the map's to say.
    style = "yellow" if unit not in ("", "-") and variable.unit is None else ""
    return [
        Text(printable(variable.name)),
        Text(kind),
        Text(printable(unit), style=style),
        Text(_short(variable.start)),
        Text(_range(variable)),
        Text(printable(variable.description)),
    ]


def _short(start: str | None) -> str:
    if start is None:
        return "–"
    try:
        return f"{float(start):.6g}"
    except ValueError:
        return printable(start)


def _range(variable: Variable) -> str:
    if variable.items:
        return printable(", ".join(variable.items))
    lowest, highest = variable.lowest, variable.highest
    if math.isinf(lowest) and math.isinf(highest):
        return ""
    if math.isinf(highest):
        return f"≥ {lowest:g}"
    return f"≤ {highest:g}" if math.isinf(lowest) else f"{lowest:g} … {highest:g}"
