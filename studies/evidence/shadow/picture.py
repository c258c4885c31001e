"""The picture of a shadow: where on the track it would have done otherwise, and how far the plans
of both were off."""

from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from bayesrace.operation.report.style import INK, PICTURE_WIDTH, WARNING, figure_style, write_png
from bayesrace.studies.evidence.shadow.comparison import INPUTS, apart, plan_errors
from bayesrace.studies.evidence.shadow.cycles import Beside

__all__ = ["draw"]

_AFTER_S: Final = np.arange(0.02, 0.41, 0.02)
_UNITS: Final = "", " [rad/s]"


def draw(one: Beside, title: str, path: Path) -> None:
    """Writes it as PNG."""
    with figure_style():
        figure = Figure((PICTURE_WIDTH, 3.6), layout="constrained")
        *maps, plans = figure.subplots(1, 3, width_ratios=(1, 1, 0.9))
        for axes, differences, name, unit in zip(maps, apart(one).T, INPUTS, _UNITS, strict=True):
            axes.plot(one.came[:, 0], one.came[:, 1], color="#d0d0ca", lw=0.6, zorder=1)
            order = np.argsort(differences)  # the largest on top
            x, y = one.x[order, :2].T
            drawn = axes.scatter(x, y, c=differences[order], s=7, cmap="plasma_r", zorder=2)
            figure.colorbar(drawn, ax=axes, shrink=0.8)
            axes.set_aspect("equal")
            axes.set_axis_off()
            axes.set_title(f"{name} apart{unit}", fontsize="small")
        for side, name, colour in (
            (one.driving, "controller", INK),
            (one.shadow, "shadow", WARNING),
        ):
            errors = [1e3 * plan_errors(one, side, after_s)[:, 0] for after_s in _AFTER_S]
            known = [at for at, found in enumerate(errors) if np.isfinite(found).any()]
            for share, style in ((50, "-"), (99, ":")):
                off_mm = [np.nanpercentile(errors[at], share) for at in known]
                label = f"{name}, p{share}"
                plans.plot(_AFTER_S[known], off_mm, color=colour, ls=style, label=label)
        plans.set(xlabel="time after the plan's beginning [s]", ylabel="plan off [mm]")
        plans.set_ylim(bottom=0)
        plans.legend(fontsize="x-small")
        figure.suptitle(title, fontsize="small")
        write_png(figure, path)
