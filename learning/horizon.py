"""How far predictions drift from what was driven: over one step and over a controller's horizon.

From a driven state on, the model is stepped with the inputs that acted; nothing is corrected on the
way (open loop). What is left at the end is what the controller's plan would be wrong by. The paper
draws the same (its figures of model mismatch with and without GPs).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesrace.errors import InputError
from bayesrace.gp.corrected import corrected_function
from bayesrace.gp.weights import GpWeights
from bayesrace.integrators import Discretisation
from learning.dataset import Dataset
from learning.residual import NOMINAL, identity

__all__ = ["HORIZON", "MAX_STARTS", "Mismatch", "mismatch", "unbroken"]

Floats = NDArray[np.float64]

HORIZON = 20
"""Stages of the controller's default horizon."""

MAX_STARTS = 2000
"""Predictions per horizon at most, evenly spread over the samples."""


@dataclass(frozen=True, eq=False)
class Mismatch:
    """Driven minus predicted after ``steps`` steps, one row a prediction."""

    steps: int
    position_m: Floats
    """Distance, (m,)."""
    heading_rad: Floats
    """Signed, (m,)."""
    velocities: Floats
    """Signed, (m, 3): vx [m/s], vy [m/s], omega [rad/s]."""

    def __len__(self) -> int:
        return len(self.position_m)


def unbroken(dataset: Dataset, steps: int) -> NDArray[np.int64]:
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
) -> Mismatch:
    """Open-loop predictions from every driven state that has ``steps`` more behind it.

    ``weights`` None: the nominal model. InputError for weights of another discretised model.
    """
    if weights is not None and weights.discretisation != identity(dataset, discretisation):
        raise InputError(
            f"weights are for {weights.discretisation}, the samples for "
            f"{identity(dataset, discretisation)}"
        )
    first = unbroken(dataset, steps)
    if len(first) > MAX_STARTS:
        first = first[np.linspace(0, len(first) - 1, MAX_STARTS).astype(np.int64)]
    if len(first) == 0:
        return Mismatch(steps, np.zeros(0), np.zeros(0), np.zeros((0, 3)))
    step = corrected_function(NOMINAL(dataset.car), discretisation, weights)
    x = dataset.x[first].T
    for k in range(steps):
        x = np.asarray(step(x, dataset.u[first + k].T), dtype=np.float64)
    error = dataset.x_next[first + steps - 1] - x.T
    return Mismatch(steps, np.hypot(error[:, 0], error[:, 1]), error[:, 2], error[:, 3:6])
