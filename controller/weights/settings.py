"""When weights are worse than others: thresholds, with the reason for each, and the comparison of
root mean square one-step errors on the same samples. docs/learning.md explains the tests."""

from collections.abc import Sequence
from itertools import product
from typing import Final, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from bayesrace.arrays import Floats
from bayesrace.gp.weights import OUTPUTS, UNITS
from bayesrace.messages import Scalar
from bayesrace.vehicles.parameters import CarParameters

__all__ = ["SAMPLES", "WATCHED", "Comparison", "GateSettings", "compare", "slack_of"]

SAMPLES: Final = 512
"""BRSAMPLES in controller/native/bayesrace_mpc.h: what a controller keeps."""

WATCHED: Final = 100
"""BR_WATCHED there: the newest of these, on which weights are compared while they are watched."""


class GateSettings(BaseModel):
    """When new weights are refused, and when they are rolled back.

    One-step errors are compared as velocities after one Ts. The new weights are worse if for any
    output

        error_new > worse_factor * error_old + worse_share * error_nominal + resolution * Ts * few

    with RMSEs over the same samples and ``nominal`` the model without correction. ``resolution``
    and the bound on corrections depend on the car: :class:`bayesrace.vehicles.tuning.GateTuning`.
    ``few`` is 100, the samples that the watch compares on, over the number of samples, and at
    least 1: a handful of samples, as after a standing start, must be far worse.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    worse_factor: float = Field(1.2, ge=1, description="errors may grow by this factor, and")
    worse_share: float = Field(
        0.1, ge=0, description="by this share of the nominal error: good weights learned again "
        "differ by several times their error, which is small beside it",
    )  # fmt: skip
    plausible_states: int = Field(
        500, ge=0, le=10_000, description="states over the car's range, for the bound"
    )
    least_samples: int = Field(
        50, ge=1, le=SAMPLES, description="with fewer of the newest 512, only on probation"
    )
    watch_s: float = Field(10.0, ge=0, le=3600, description="driving after which weights stay")
    watch_least: int = Field(
        5, ge=1, le=WATCHED, description="samples: no rollback for one outlier"
    )
    watch_cycles: int = Field(
        25, ge=1, le=5000, description="cycles, nearly all of them without a solution, after which "
        "weights are rolled back: a car that stands has no error to compare",
    )  # fmt: skip
    slow_share: float = Field(
        0.7, gt=0, le=1, description="of the fastest speed that was watched: the limit where going "
        "back would be no better",
    )  # fmt: skip


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
