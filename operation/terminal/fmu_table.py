"""What an FMU's model description contains, on the terminal."""

import math
from collections.abc import Iterator
from typing import Any, Final

from rich.console import Group
from rich.text import Text

from bayesrace.operation.terminal import printable
from bayesrace.operation.terminal.terminal import plain_table
from bayesrace.plant.fmu.inspection import items_of, range_of, steps_s

__all__ = ["fmu_table"]

_SECTIONS: Final = {
    "inputs": ("input",),
    "outputs": ("output",),
    "parameters": ("parameter", "structuralParameter", "calculatedParameter"),
    "locals": ("local",),
}
_COLUMNS: Final = ("variable", "type", "unit", "start", "range", "description")


def fmu_table(description: Any, platforms: str, *, all_: bool = False) -> Group:
    """An FMU's interfaces, platforms and variables, for rich to print; inputs come first.

    Local variables, of which some tools write thousands, are counted; ``all_`` lists them too.
    ``description``: fmpy's.
    """
    variables = description.modelVariables
    sections = {
        title: [_cells(one) for one in variables if one.causality in causalities]
        for title, causalities in _SECTIONS.items()
        if all_ or title != "locals"
    }
    rows = [cells for section in sections.values() for cells in section]
    # Room goes to the names: what no variable has gets no column.
    shown = [i for i in range(len(_COLUMNS)) if any(cells[i].plain for cells in rows)]
    table = plain_table("", *(_COLUMNS[i] for i in shown), left=1 + len(shown))
    for title, section in sections.items():
        for k, cells in enumerate(section):
            table.add_row("" if k else Text(title, style="bold"), *(cells[i] for i in shown))
        table.add_section()
    hidden = sum(one.causality == "local" for one in variables)
    more = [Text(f"and {hidden} local variable(s)", style="dim")] if hidden and not all_ else []
    return Group(*_head(description, platforms), table, *more)


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
    return [
        Text(printable(variable.name)),
        Text(variable.type + ("[]" if variable.dimensions else "")),
        Text(printable(variable.unit or "")),
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
