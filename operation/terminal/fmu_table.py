"""What an FMU's model description contains, on the terminal."""

import math
from collections.abc import Iterator
from typing import Any, Final

from rich import box
from rich.console import Console, ConsoleOptions, RenderableType
from rich.table import Table
from rich.text import Text

from bayesrace.operation.terminal import printable
from bayesrace.plant.fmu.inspection import items_of, range_of, steps_s, unit_of

__all__ = ["FmuTable"]

_SECTIONS: Final = {
    "inputs": ("input",),
    "outputs": ("output",),
    "parameters": ("parameter", "structuralParameter", "calculatedParameter"),
    "locals": ("local",),
}
_COLUMNS: Final = ("variable", "type", "unit", "start", "range", "description")


class FmuTable:
    """An FMU's interfaces, platforms and variables, for rich to print; inputs come first.

    Local variables, of which some tools write thousands, are counted; ``all_`` lists them too.
    """

    def __init__(self, description: Any, platforms: str, *, all_: bool = False) -> None:
        """``description``: fmpy's."""
        self._fmu, self._platforms, self._all = description, platforms, all_

    def __rich_console__(
        self, console: Console, options: ConsoleOptions
    ) -> Iterator[RenderableType]:
        yield from _head(self._fmu, self._platforms)
        yield self._table()
        hidden = sum(one.causality == "local" for one in self._fmu.modelVariables)
        if hidden and not self._all:
            yield Text(f"and {hidden} local variable(s)", style="dim")

    def _table(self) -> Table:
        sections = {
            title: [_cells(one) for one in self._fmu.modelVariables if one.causality in causalities]
            for title, causalities in _SECTIONS.items()
            if self._all or title != "locals"
        }
        rows = [cells for section in sections.values() for cells in section]
        # Room goes to the names: what no variable has gets no column.
        shown = [i for i in range(len(_COLUMNS)) if any(cells[i].plain for cells in rows)]
        table = Table(box=box.SIMPLE_HEAD, padding=(0, 1), pad_edge=False, show_edge=False)
        table.add_column("", style="bold")
        for i in shown:
            right = _COLUMNS[i] == "start"
            table.add_column(_COLUMNS[i], justify="right" if right else "left", overflow="fold")
        for title, section in sections.items():
            for k, cells in enumerate(section):
                table.add_row("" if k else title, *(cells[i] for i in shown))
            table.add_section()
        return table


def _head(fmu: Any, platforms: str) -> Iterator[Text]:
    simulation, step_s = fmu.coSimulation, next(filter(None, steps_s(fmu)), None)
    names = {"coSimulation": "Co-Simulation", "modelExchange": "Model Exchange"}
    names |= {"scheduledExecution": "Scheduled Execution"}
    interfaces = " and ".join(text for name, text in names.items() if getattr(fmu, name))
    version = f" · FMI {printable(fmu.fmiVersion)} {interfaces}"
    yield Text.assemble((printable(fmu.modelName), "bold"), version)
    if fmu.description:
        yield Text(printable(fmu.description))
    any_step = simulation and simulation.canHandleVariableCommunicationStepSize
    words: list[str | None] = [
        f"for {printable(platforms)}",
        fmu.generationTool and f"by {printable(fmu.generationTool)}",
        f"step {step_s:g} s" if step_s else None,
        "any step" if any_step else "one fixed step",
        simulation and simulation.needsExecutionTool and "needs the tool it comes from",
    ]
    yield Text(" · ".join(filter(None, words)))
    if simulation is None:
        yield Text("the plant runs Co-Simulation FMUs only: not this one", style="red")


def _cells(variable: Any) -> list[Text]:
    unit = variable.unit or ""
    # A unit that is not known has to be in the map.
    style = "yellow" if unit not in ("", "-") and unit_of(unit) is None else ""
    return [
        Text(printable(variable.name)),
        Text(variable.type + ("[]" if variable.dimensions else "")),
        Text(printable(unit), style=style),
        Text(_short(variable.start)),
        Text(_range(variable)),
        Text(printable(variable.description or "")),
    ]


def _short(start: str | None) -> str:
    try:
        return "–" if start is None else f"{float(start):.6g}"
    except ValueError:
        return printable(start or "")


def _range(variable: Any) -> str:
    if items := items_of(variable):
        return printable(", ".join(items))
    lowest, highest = range_of(variable)
    if math.isinf(lowest):
        return "" if math.isinf(highest) else f"≤ {highest:g}"
    return f"≥ {lowest:g}" if math.isinf(highest) else f"{lowest:g} … {highest:g}"
