"""The picture of a replayed drive: inputs along time, and how far they are apart."""

from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.figure import Figure

from bayesrace.operation.report.style import (
    INK,
    PICTURE_WIDTH,
    WARNING,
    figure_style,
    write_png,
)
from bayesrace.studies.evidence.replay.comparison import INPUTS, Replayed

__all__ = ["draw"]

_LEAST: Final = 1e-18
"""Drawn in place of a difference of 0, which has no logarithm."""
_UNITS: Final = ("", " [rad/s]")


def draw(replayed: Replayed, path: Path) -> None:
    """Writes it as PNG; runs follow each other on one axis of time."""
    rows = replayed.rows
    with figure_style():
        figure = Figure((PICTURE_WIDTH, 6.5), layout="constrained")
        axes = figure.subplots(4, 1, sharex=True, height_ratios=(2, 1, 2, 1))
        steps = np.diff(rows["time_s"], prepend=rows["time_s"][:1])
        begins = steps < 0
        time_s = np.cumsum(np.where(begins, 0.02, steps))
        apart = np.abs(rows["u"] - rows["recorded"])
        parted = np.flatnonzero(apart.any(axis=1))
        for i, name in enumerate(INPUTS):
            inputs, differences = axes[2 * i], axes[2 * i + 1]
            inputs.plot(time_s, rows["recorded"][:, i], color=INK, label="recorded")
            inputs.plot(time_s, rows["u"][:, i], color="#0072B2", ls="--", label="replayed")
            inputs.set_ylabel(name + _UNITS[i])
            differences.semilogy(time_s, np.maximum(apart[:, i], _LEAST), color=WARNING)
            differences.set_ylabel("difference")
            differences.set_ylim(_LEAST / 2, 10)
            for one in (inputs, differences) if len(parted) else ():
                one.axvline(time_s[parted[0]], color=WARNING, lw=0.8, ls=":")
            for at in time_s[begins]:
                inputs.axvline(at, color=INK, lw=0.5)
        axes[0].legend(loc="upper right", ncols=2)
        axes[0].set_title(f"{replayed.name}: {replayed.quality}", fontsize="small", wrap=True)
        axes[-1].set_xlabel("time driven [s]")
        write_png(figure, path)
