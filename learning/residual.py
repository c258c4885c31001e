"""The one-step error of the discretised nominal model: what the GP learns."""

import numpy as np
from numpy.typing import NDArray

from bayesrace.errors import InputError
from bayesrace.gp.weights import OUTPUTS
from bayesrace.integrators import Discretisation
from bayesrace.vehicles.models import STATES, e_kinematic
from learning.dataset import Dataset

__all__ = ["NOMINAL", "identity", "residual"]

NOMINAL = e_kinematic
"""The model that is corrected."""

_ROWS = [STATES.index(name) for name in OUTPUTS]


def identity(dataset: Dataset, discretisation: Discretisation) -> str:
    """Identity of the discretised nominal model of the dataset's car."""
    return discretisation.identity(NOMINAL(dataset.car).name, dataset.car)


def residual(dataset: Dataset, discretisation: Discretisation) -> NDArray[np.float64]:
    """x_{k+1} - F(x_k, u_k) for vx [m/s], vy [m/s], omega [rad/s]; shape (n, 3).

    F is the nominal model under ``discretisation``, the same object that predicts in the
    controller. InputError if its step is not the dataset's.
    """
    if abs(discretisation.step_s - dataset.step_s) > 1e-9:
        raise InputError(
            f"the samples are {dataset.step_s:g} s apart, the discretisation steps "
            f"{discretisation.step_s:g} s; use the step that the log was recorded with"
        )
    if len(dataset) == 0:
        return np.zeros((0, len(OUTPUTS)))
    step = discretisation.discretise(NOMINAL(dataset.car))
    predicted = np.asarray(step(dataset.x.T, dataset.u.T), dtype=np.float64).T
    return dataset.x_next[:, _ROWS] - predicted[:, _ROWS]
