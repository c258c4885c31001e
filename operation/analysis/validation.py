"""``bayesrace validate``: weights judged on drives that they were not learned from."""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from pydantic import Field

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.gp.weights import Weights
from bayesrace.learning.dataset import Dataset, left_out
from bayesrace.learning.sources import read_samples
from bayesrace.learning.validation import HORIZON, Validation, discretisation_of, mismatch, validate
from bayesrace.operation.analysis.results import GpMetrics, ResultModel, gp_metrics
from bayesrace.operation.terminal import UNCERTAIN
from bayesrace.vehicles import Car, get_car

__all__ = ["DRIFTS", "HorizonResult", "Spread", "Validated", "ValidationResult", "validate_weights"]

DRIFTS: Final = "position_m", "heading_rad", "vx_mps", "vy_mps", "omega_radps"
"""Errors of a prediction, with their units."""


class Spread(ResultModel):
    """Of absolute errors over all predictions."""

    mean: float
    p95: float
    max: float


def _drift(errors: Floats) -> dict[str, Spread]:
    """From states driven minus predicted, (m, 7), m at least 1."""
    x, y, *others = errors.T[:6]
    found = {}
    for name, one in zip(DRIFTS, (np.hypot(x, y), *others), strict=True):
        size = np.abs(one)
        mean, p95, most = size.mean(), np.percentile(size, 95), size.max()
        found[name] = Spread(mean=float(mean), p95=float(p95), max=float(most))
    return found


class HorizonResult(ResultModel):
    """Open-loop predictions over some steps, without and with the correction."""

    steps: int
    predictions: int
    nominal: dict[str, Spread] = Field(description="of each of DRIFTS, at the end of the horizon")
    corrected: dict[str, Spread]


class ValidationResult(ResultModel):
    """What ``--json`` writes."""

    vx: GpMetrics
    vy: GpMetrics
    omega: GpMetrics
    one_step: HorizonResult | None
    horizon: HorizonResult | None = Field(description="null if no drive is long enough")
    weights_version: str
    car: str
    discretisation: str
    samples: int
    dropped: dict[str, int] = Field(description="samples left out, by reason")
    threshold: float
    uncertain: int = Field(description="samples whose largest sigma is above the threshold")
    learned_from: bool = Field(description="these are the samples that the weights learned from")


@dataclass(frozen=True, eq=False)
class Validated:
    """The numbers, and what they are made of."""

    result: ValidationResult
    validation: Validation
    dataset: Dataset


def validate_weights(
    weights: Weights,
    drives: list[Path],
    name: str = "",
    runs: tuple[int, ...] | None = None,
    threshold: float = UNCERTAIN,
    car: Car | None = None,
    *,
    limits: bool = True,
) -> Validated:
    """Judges weights on logs (MCAP) or arrays (``.npz``), filtered as for training.

    They are judged by what was true; by what was measured, if that is all that a log holds, as that
    of a real car. The discretisation is the one that the weights were learned with. ``car``:
    theirs, needed where it is not built in. ``limits``: leave out samples outside its limits.
    InputError for drives of another car or step, or without samples.
    """
    car = car or get_car(weights.car)
    discretisation = discretisation_of(weights.discretisation, car)
    measured, data = (
        read_samples(drives, car, name, discretisation, runs, truth, limits=limits).dataset
        for truth in (False, True)
    )
    if len(data) == 0:
        counts = left_out(data.dropped)
        raise InputError(f"validation: no samples left (left out: {counts}); drive longer")
    validation = validate(weights, data, discretisation)

    def over(steps: int) -> HorizonResult | None:
        plain, corrected = (mismatch(data, discretisation, w, steps) for w in (None, weights))
        if len(plain) == 0:
            return None
        return HorizonResult(
            steps=steps, predictions=len(plain), nominal=_drift(plain), corrected=_drift(corrected)
        )

    result = ValidationResult(
        **gp_metrics(validation.metrics),
        one_step=over(1),
        horizon=over(HORIZON),
        weights_version=weights.version,
        car=weights.car,
        discretisation=weights.discretisation,
        samples=len(data),
        dropped=dict(data.dropped),
        threshold=threshold,
        uncertain=int(validation.uncertain(threshold).sum()),
        learned_from=bool(weights.dataset_digest) and weights.dataset_digest == measured.digest(),
    )
    return Validated(result, validation, data)
