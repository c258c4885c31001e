"""The controller's inputs, and bounds on their differences as commands are given them."""

from typing import Final

import numpy as np

from bayesrace.errors import InputError

__all__ = ["INPUTS", "UNITS", "input_bounds"]

INPUTS: Final = "d", "delta_rate"
UNITS: Final = "", " [rad/s]"
"""Behind their names."""


def input_bounds(option: str, text: str) -> dict[str, float]:
    """Bounds by input, of one or both, from ``d=0.1,delta_rate=1``; InputError for anything
    else."""
    found: dict[str, float] = {}
    for part in filter(None, text.split(",")):
        name, _, number = part.partition("=")
        try:
            found[name.strip()] = float(number)
        except ValueError:
            found[name.strip()] = -1.0
    if found.keys() - set(INPUTS) or not all(0 <= one < np.inf for one in found.values()):
        raise InputError(f"{option} {text}: give d, delta_rate or both, as d=0.1,delta_rate=1")
    return found
