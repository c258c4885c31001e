"""Shows a timing study: on the terminal, as a picture and as JSON."""

from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.figure import Figure
from rich.console import Console
from rich.text import Text

from bayesrace.files import write_whole
from bayesrace.operation.report.style import (
    INK,
    MUTED,
    PICTURE_WIDTH,
    WARNING,
    figure_style,
    write_png,
)
from bayesrace.operation.terminal.terminal import plain_table
from bayesrace.studies.evidence.timing.study import PHASES, Study

__all__ = ["print_study", "write_study"]

_COLOURS: Final = dict(
    zip(PHASES, ("#009E73", "#56B4E9", "#0072B2", "#E69F00", "#CC79A7"), strict=True)
)
"""Okabe and Ito's."""


def print_study(study: Study, console: Console) -> None:
    """A row for each phase, the hardest starts, the statement."""
    result = study.result
    table = plain_table("phase [ms]", "p50", "p99", "p99.9", "max", "level", padding=0)
    for one in result.times:
        level = f"{one.usable.upper:.3g}" if one.usable else "rejected" if one.tail else ""
        table.add_row(one.name, *(f"{v:.3f}" for v in (one.p50, one.p99, one.p999, one.max)), level)
    console.print(table)
    counts = ", ".join(f"{count} {name}" for name, count in result.cycles.items())
    console.print(Text(f"{counts} cycles; N = {result.horizon}. Hardest starts, without budget:"))
    for text in result.worst:
        console.print(Text(f"  {text}"))
    if result.not_counted:
        console.print(Text(f"Instructions are not counted: {result.not_counted}."))
    else:
        table = plain_table("million instructions", "p50", "max", padding=0)
        for counted in result.instructions:
            table.add_row(counted.name, f"{1e-6 * counted.p50:.3f}", f"{1e-6 * counted.most:.3f}")
        console.print(table)
    console.print(Text(result.statement))


def write_study(study: Study, folder: Path) -> None:
    """``timing.json``, ``timing.png`` and ``times.npz``, all times by problems and phase."""
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / "timing.json", study.result.model_dump_json(indent=1) + "\n")
    np.savez_compressed(folder / "times.npz", **study.values)  # type: ignore[arg-type]
    _plot(folder / "timing.png", study)


def _plot(path: Path, study: Study) -> None:
    """How many cycles take longer, by phase; the fit beyond; the limit."""
    result = study.result
    with figure_style():
        figure = Figure(figsize=(PICTURE_WIDTH, 4.6), layout="constrained")
        panels = figure.subplots(1, 2, sharex=True, sharey=True)
        for axes, name in zip(panels, ("recorded", "adversarial"), strict=True):
            for phase, colour in _COLOURS.items():
                ms = np.sort(study.values[f"{name} {phase}"])
                share = 1 - np.arange(len(ms)) / len(ms)
                axes.step(ms, share, where="pre", color=colour, label=phase)
            for one in result.times:
                if one.name.startswith(name) and (tail := one.usable):
                    x = np.geomspace(tail.threshold, tail.upper, 200)
                    colour = _COLOURS[one.name.split()[1]]
                    axes.plot(x, tail.survival(x), ":", color=colour)
                    axes.plot(tail.upper, tail.exceedance, "o", color=colour)
            axes.axvline(result.limit_ms, color=WARNING, linewidth=1)
            axes.set(xscale="log", yscale="log", xlabel="processor time [ms]")
            axes.set_title(name, color=INK, loc="left")
        panels[0].set_ylabel("share of cycles that take longer")
        panels[0].legend(frameon=False)
        title = f"{result.car}, N = {result.horizon}, limit {result.limit_ms:g} ms; dotted: the fit"
        figure.suptitle(title, color=MUTED, x=0.995, ha="right")
        write_png(figure, path)
