"""Weights that are well-formed and wrong: what a bad job, or an enemy, might send."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

import numpy as np

from bayesrace.gp.weights import GpOutput, Weights

__all__ = ["SPOILT", "spoilt"]

Outputs = tuple[GpOutput, GpOutput, GpOutput]


def _scaled(output: GpOutput, factor: float) -> GpOutput:
    return replace(output, alpha=output.alpha * factor, y_mean=output.y_mean * factor)


def _moved(output: GpOutput, by: float) -> GpOutput:
    return replace(output, y_mean=output.y_mean + by)


def _all(factor: float) -> Callable[[Outputs], Outputs]:
    return lambda o: (_scaled(o[0], factor), _scaled(o[1], factor), _scaled(o[2], factor))


SPOILT: Final[dict[str, Callable[[Outputs], Outputs]]] = {
    "flip vx": lambda o: (_scaled(o[0], -1), o[1], o[2]),
    "flip vy": lambda o: (o[0], _scaled(o[1], -1), o[2]),
    "flip omega": lambda o: (o[0], o[1], _scaled(o[2], -1)),
    "flip all": _all(-1),
    "swap vx vy": lambda o: (o[1], o[0], o[2]),
    "swap vy omega": lambda o: (o[0], o[2], o[1]),
    "scale 3": _all(3),
    "offset vx": lambda o: (_moved(o[0], 0.05), o[1], o[2]),
    "offset omega": lambda o: (o[0], o[1], _moved(o[2], 0.5)),
}
"""What is done to vx, vy, omega."""


def spoilt(weights: Weights, what: str) -> Weights:
    """The same, spoilt, under a name that says so, and without the samples that would tell."""
    version = f"{weights.version}-{what.replace(' ', '-')}"
    none: Any = {"sample_features": np.zeros((0, 6)), "sample_residuals": np.zeros((0, 3))}
    return replace(weights, version=version, outputs=SPOILT[what](weights.outputs), **none)
