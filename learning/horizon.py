"""Drift of predictions from a drive, over one step and over a controller's horizon.

From a driven state on, the model is stepped with the inputs that acted, without any correction on
the way (open loop). The difference at the end is the error of the controller's plan. The paper
draws the same (its figures of model mismatch with and without GPs).
"""

from typing import Final

import numpy as np

from bayesrace.arrays import Floats, Rows
from bayesrace.gp.corrected import corrected_function
from bayesrace.gp.weights import GpWeights
from bayesrace.integrators import Discretisation
from learning.dataset import Dataset
from learning.residual import NOMINAL

__all__ = ["HORIZON", "mismatch", "unbroken"]

HORIZON: Final = 20
"""Stages of the controller's default horizon."""

_MAX_STARTS: Final = 2000
"""Predictions per horizon at most, evenly spread over the samples."""


def unbroken(dataset: Dataset, steps: int) -> Rows:
    """Rows at which ``steps`` consecutive samples of one drive begin."""
    if len(dataset) < steps:
        return np.zeros(0, dtype=np.int64)
    joined = (dataset.x_next[:-1] == dataset.x[1:]).all(axis=1)
    before = np.concatenate(([0], np.cumsum(joined)))
    return np.flatnonzero(before[steps - 1 :] - before[: len(before) - steps + 1] == steps - 1)


def mismatch(
    dataset: Dataset,
    discretisation: Discretisation,
    weights: GpWeights | None,
    steps: int = HORIZON,
) -> Floats:
    """Driven minus predicted states after ``steps`` steps, open loop, (m, 7), SI units.

    One row for each sample that ``steps`` consecutive ones begin with, or for evenly chosen ones.
    ``weights`` None: the nominal model. InputError for weights of another discretised model.
    """
    step = corrected_function(NOMINAL(dataset.car), discretisation, weights)
    first = unbroken(dataset, steps)
    if len(first) > _MAX_STARTS:
        first = first[np.linspace(0, len(first) - 1, _MAX_STARTS).astype(np.int64)]
    if len(first) == 0:
        return np.zeros((0, 7))
    x = dataset.x[first].T
    for k in range(steps):
        x = np.asarray(step(x, dataset.u[first + k].T), dtype=np.float64)
    return dataset.x_next[first + steps - 1] - x.T
