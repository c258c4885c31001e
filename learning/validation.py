"""The residual, what the discretised nominal model misses in one step; and weights judged by what
they leave of it on a drive that they were not trained on.

Over one step, the prediction is compared with the residual (:func:`validate`). Over a controller's
horizon, the model is stepped from a driven state on with the inputs that acted, without any
correction on the way (:func:`mismatch`); the difference at the end is the error of the controller's
plan. The paper draws the same (its figures of model mismatch with and without GPs).
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from pydantic import ValidationError
from threadpoolctl import threadpool_limits

from bayesrace.arrays import Flags, Floats, Rows
from bayesrace.errors import InputError
from bayesrace.gp.expression import corrected_function, evaluate_mean
from bayesrace.gp.weights import OUTPUTS, GpOutput, Weights
from bayesrace.integrators import Discretisation
from bayesrace.learning.dataset import Dataset
from bayesrace.learning.gaussian_process import Covariance, Posterior
from bayesrace.learning.subset import evenly
from bayesrace.learning.target import NORMAL_95, PredictionErrors
from bayesrace.vehicles.models import STATES, e_kinematic
from bayesrace.vehicles.parameters import Car

__all__ = ["HORIZON", "NOMINAL", "Validation", "discretisation_of", "identity", "mismatch"]
__all__ += ["posterior_of", "predictive_sigma", "recalled", "residual", "unbroken", "validate"]

HORIZON: Final = 20
"""Stages of the controller's default horizon."""

_MAX_STARTS: Final = 2000
"""Predictions per horizon at most, evenly spread over the samples."""

NOMINAL = e_kinematic
"""The model that is corrected."""

_ROWS: Final = [STATES.index(name) for name in OUTPUTS]
_IDENTITY: Final = re.compile(
    r"[^/]+/(?P<scheme>\w+)x(?P<substeps>\d{1,4})-(?P<pose>\w+)/(?P<step_s>[\d.e-]{1,16})s/[^/]+"
)


def identity(dataset: Dataset, discretisation: Discretisation) -> str:
    """Identity of the discretised nominal model of the dataset's car."""
    return discretisation.identity(NOMINAL(dataset.car).name, dataset.car)


def discretisation_of(name: str, car: Car) -> Discretisation:
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


def recalled(weights: Weights, car: Car) -> Dataset:
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


@dataclass(frozen=True, eq=False)
class Validation:
    """Residual of the nominal model, predicted mean and standard deviation, each (n, 3), SI units.

    ``sigma`` includes the learned noise, and what is not known of estimated states, which is no
    error. ``metrics``: per output ``rmse`` and ``uncorrected_rmse`` (with and without the GP),
    ``r2``, ``coverage`` of the 95 % interval, ``log_density``.
    """

    residual: Floats
    mean: Floats
    sigma: Floats
    metrics: Mapping[str, Mapping[str, float]]

    @property
    def error(self) -> Floats:
        """Residual that is left after the correction."""
        return self.residual - self.mean

    @property
    def band(self) -> Floats:
        """Half the width of the 95 % interval about the mean."""
        return NORMAL_95 * self.sigma

    def uncertain(self, threshold: float) -> Flags:
        """Samples (n,) whose largest standard deviation, over the outputs, is above this.

        The paper's mark, which compares m/s and rad/s with one number.
        """
        return np.asarray(self.sigma.max(axis=1) > threshold)


def posterior_of(output: GpOutput) -> Posterior:
    """The GP of an output, in units of scaled y; InputError if its covariance is singular."""
    covariance = Covariance(
        output.kernel, output.signal_variance, output.length_scales, output.noise_variance
    )
    found = Posterior(covariance, output.inputs, np.zeros(output.count))
    # The uncertainty does not depend on the targets, which weights do not hold.
    found.alpha = output.alpha
    return found


def predictive_sigma(weights: Weights, z: Floats) -> Floats:
    """Predictive standard deviation (m, 3) at features ``z`` (m, 6), noise included, SI units."""
    return np.column_stack(
        [output.y_scale * posterior_of(output).predict(z)[1] for output in weights.outputs]
    )


def validate(weights: Weights, dataset: Dataset, discretisation: Discretisation) -> Validation:
    """Compares prediction and residual on ``dataset``.

    InputError without samples, if the weights are for another discretised model, or if a metric is
    not finite.
    """
    name = identity(dataset, discretisation)
    if weights.discretisation != name:
        raise InputError(f"weights are for {weights.discretisation}, the samples for {name}")
    if len(dataset) == 0:
        raise InputError("validation: no samples left; drive longer")
    z, truth = dataset.features, residual(dataset, discretisation)
    # On a busy machine the threads of BLAS wait for each other longer than they work.
    with threadpool_limits(1):
        mean, sigma = evaluate_mean(weights, z), predictive_sigma(weights, z)
    if (noise := dataset.deviation[:, :3] ** 2).any():
        sigma = np.sqrt(sigma**2 + noise)
    columns = zip(OUTPUTS, truth.T, mean.T, sigma.T, noise.T, strict=True)
    with np.errstate(all="ignore"):
        metrics = {
            output: PredictionErrors(true - found, spread, known).metrics(true)
            for output, true, found, spread, known in columns
        }
    if not all(math.isfinite(value) for one in metrics.values() for value in one.values()):
        raise InputError(
            f"validation: weights '{weights.version}' predict what is not finite, or without any "
            "uncertainty; train again"
        )
    return Validation(truth, mean, sigma, metrics)


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
    weights: Weights | None,
    steps: int = HORIZON,
) -> Floats:
    """Driven minus predicted states after ``steps`` steps, open loop, (m, 7), SI units.

    One row for each sample that ``steps`` consecutive ones begin with, or for evenly chosen ones.
    ``weights`` None: the nominal model. InputError for weights of another discretised model.
    """
    step = corrected_function(NOMINAL(dataset.car), discretisation, weights)
    first = unbroken(dataset, steps)
    first = first[evenly(len(first), _MAX_STARTS)]
    if len(first) == 0:
        return np.zeros((0, 7))
    x = dataset.x[first].T
    for k in range(steps):
        x = np.asarray(step(x, dataset.u[first + k].T), dtype=np.float64)
    return dataset.x_next[first + steps - 1] - x.T
