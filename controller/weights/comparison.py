"""Weights compared by root mean square one-step errors on the same samples."""

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.controller.weights.settings import WATCHED, GateSettings
from bayesrace.gp.weights import OUTPUTS, UNITS
from bayesrace.messages import Scalar
from bayesrace.vehicles.parameters import CarParameters

__all__ = ["Comparison", "compare", "slack_of"]

_LARGEST = 1e12
"""Errors that are not finite count as this large."""


class Comparison(NamedTuple):
    """One-step errors of new weights and others over the same samples."""

    worse: str
    """Outputs for which the new weights are worse, by :class:`GateSettings`; empty: none."""
    text: str
    data: dict[str, Scalar]
    """The number of ``samples``, and errors such as ``error_new_vx``."""


def slack_of(car: CarParameters, step_s: float) -> Floats:
    """What errors may differ by in any case (3,): the resolution of measurements."""
    return np.array(car.tuning.gate.resolution) * step_s


def compare(
    settings: GateSettings,
    slack: Floats,
    samples: int,
    new: Sequence[float] | Floats,
    old: Sequence[float] | Floats,
    nominal: Sequence[float] | Floats,
) -> Comparison:
    """New weights against old ones, and against none, by their errors (3,) on so many samples."""
    rmse = {
        what: np.minimum(np.asarray(errors, dtype=np.float64), _LARGEST)
        for what, errors in (("new", new), ("old", old), ("nominal", nominal))
    }
    # The excess over a whole window is what counts: fewer samples must be worse by as much in all.
    few = max(WATCHED / max(samples, 1), 1.0)
    allowed = settings.worse_factor * rmse["old"] + settings.worse_share * rmse["nominal"]
    # As large as can be on both sides is worse, too.
    fine = (rmse["new"] <= allowed + few * slack) & (rmse["new"] < _LARGEST)
    worse = " and ".join(name for name, good in zip(OUTPUTS, fine, strict=True) if not good)
    data: dict[str, Scalar] = {"samples": samples}
    for (what, errors), (j, name) in product(rmse.items(), enumerate(OUTPUTS)):
        data[f"error_{what}_{name}"] = float(errors[j])
    changes = ", ".join(
        f"{name} {rmse['old'][j]:.4g} to {rmse['new'][j]:.4g} {UNITS[name]}"
        for j, name in enumerate(OUTPUTS)
    )
    return Comparison(worse, f"one-step errors over {samples} samples go from {changes}", data)
