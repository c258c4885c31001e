"""The one-step error of the discretised nominal model: what the GP learns, and knows."""

import re
from typing import Final

import numpy as np
from pydantic import ValidationError

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.gp.expression import evaluate_mean
from bayesrace.gp.weights import OUTPUTS, GpWeights
from bayesrace.integrators import Discretisation
from bayesrace.learning.dataset import Dataset
from bayesrace.vehicles.models import STATES, e_kinematic
from bayesrace.vehicles.parameters import CarParameters

__all__ = ["NOMINAL", "discretisation_of", "identity", "recalled", "residual"]

NOMINAL = e_kinematic
"""The model that is corrected."""

_ROWS: Final = [STATES.index(name) for name in OUTPUTS]
_IDENTITY: Final = re.compile(
    r"[^/]+/(?P<scheme>\w+)x(?P<substeps>\d{1,4})-(?P<pose>\w+)/(?P<step_s>[\d.e-]{1,16})s/[^/]+"
)


def identity(dataset: Dataset, discretisation: Discretisation) -> str:
    """Identity of the discretised nominal model of the dataset's car."""
    return discretisation.identity(NOMINAL(dataset.car).name, dataset.car)


def discretisation_of(name: str, car: CarParameters) -> Discretisation:
    """The discretisation that an identity names, such as a manifest's or that of weights.

    InputError if it is not one of the nominal model of ``car``: other parameters, another model.
    """
    found = _IDENTITY.fullmatch(name)
    try:
        discretisation = Discretisation.model_validate_strings(found.groupdict() if found else name)
    except ValidationError:
        raise InputError(f"'{name}' names no discretised model; train again") from None
    if discretisation.identity(NOMINAL(car).name, car) != name:
        raise InputError(
            f"'{name}' is not the {NOMINAL(car).name} model of the car '{car.name}' as this "
            "program knows it; train again, or name its car"
        )
    return discretisation


def residual(dataset: Dataset, discretisation: Discretisation) -> Floats:
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


def recalled(weights: GpWeights, car: CarParameters) -> Dataset:
    """What weights know at their own training inputs, as samples of ``car``, which is theirs.

    For where the drives that they were learned from are not at hand. Each sample is a step of the
    nominal model from the origin, plus the mean: learned from again they give nearly the same
    means. InputError if the model is not known here.
    """
    discretisation = discretisation_of(weights.discretisation, car)
    every = np.vstack([output.inputs for output in weights.outputs])
    _, first = np.unique(every, axis=0, return_index=True)
    z = every[np.sort(first)]
    x, u = np.hstack((np.zeros((len(z), 3)), z[:, :4])), z[:, 4:]
    x_next = np.zeros_like(x)
    if len(z):
        step = discretisation.discretise(NOMINAL(car))
        x_next[:] = np.asarray(step(x.T, u.T), dtype=np.float64).T
        x_next[:, 3:6] += evaluate_mean(weights, z)
    return Dataset(car, discretisation.step_s, x, u, x_next)
