"""Figure of an identified car: measured and modelled accelerations over speed and command."""

from pathlib import Path

from matplotlib.figure import Figure

from bayesrace.learning.identification import Comparison
from bayesrace.operation.look import look
from bayesrace.operation.report.style import INK, MUTED, PICTURE_WIDTH, figure_style, write_png
from bayesrace.vehicles import Car

__all__ = ["write_comparison"]


def write_comparison(found: Comparison, car: Car, path: Path) -> None:
    """Writes the figure as PNG: along the car over speed and over the command, and to its left."""
    unit, colour = car.drive.unit, look("bayesrace").colour
    over_speed = "along the car", "speed [m/s]", found.speed_mps, 0
    over_command = "along the car", f"{car.drive.command} [{unit}]", found.command, 0
    across = "to its left", "modelled [m/s²]", found.modelled[:, 1], 1
    with figure_style():
        figure = Figure(figsize=(PICTURE_WIDTH, 4.0), layout="tight")
        for axes, (what, label, x, row) in zip(
            figure.subplots(1, 3), (over_speed, over_command, across), strict=True
        ):
            axes.plot(x, found.measured[:, row], ".", color=MUTED, markersize=4, label="measured")
            axes.plot(x, found.modelled[:, row], ".", color=colour, markersize=3, label="modelled")
            axes.axhline(0, color=INK, linewidth=0.5)
            axes.set(xlabel=label, ylabel="acceleration [m/s²]", title=what)
        axes.legend(loc="best")
        write_png(figure, path)
