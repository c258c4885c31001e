"""Comparison of weights with a drive that they were not trained on.

Over one step, the prediction is compared with the residual (:func:`validate`). Over a controller's
horizon, the model is stepped from a driven state on with the inputs that acted, without any
correction on the way (:func:`mismatch`); the difference at the end is the error of the controller's
plan. The paper draws the same (its figures of model mismatch with and without GPs).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from threadpoolctl import threadpool_limits

from bayesrace.arrays import Flags, Floats, Rows
from bayesrace.errors import InputError
from bayesrace.gp.expression import corrected_function, evaluate_mean
from bayesrace.gp.weights import OUTPUTS, GpWeights
from bayesrace.integrators import Discretisation
from bayesrace.learning.dataset import NOMINAL, Dataset, identity, residual
from bayesrace.learning.gaussian_process import Covariance, Posterior
from bayesrace.learning.subset import evenly
from bayesrace.learning.target import NORMAL_95, PredictionErrors

__all__ = ["HORIZON", "Validation", "mismatch", "predictive_sigma", "unbroken", "validate"]

HORIZON: Final = 20
"""Stages of the controller's default horizon."""

_MAX_STARTS: Final = 2000
"""Predictions per horizon at most, evenly spread over the samples."""


@dataclass(frozen=True, eq=False)
class Validation:
    """Residual of the nominal model, predicted mean and standard deviation, each (n, 3), SI units.

    ``sigma`` includes the learned noise. ``metrics``: per output ``rmse`` and ``uncorrected_rmse``
    (with and without the GP), ``r2``, ``coverage`` of the 95 % interval, ``log_density``.
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


def predictive_sigma(weights: GpWeights, z: Floats) -> Floats:
    """Predictive standard deviation (m, 3) at features ``z`` (m, 6), noise included, SI units."""
    columns = []
    for output in weights.outputs:
        covariance = Covariance(
            output.kernel, output.signal_variance, output.length_scales, output.noise_variance
        )
        # The uncertainty does not depend on the targets.
        _, sigma = Posterior(covariance, output.inputs, np.zeros(output.count)).predict(z)
        columns.append(output.y_scale * sigma)
    return np.column_stack(columns)


def validate(weights: GpWeights, dataset: Dataset, discretisation: Discretisation) -> Validation:
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
    with np.errstate(all="ignore"):
        metrics = {
            output: PredictionErrors(truth[:, i] - mean[:, i], sigma[:, i]).metrics(truth[:, i])
            for i, output in enumerate(OUTPUTS)
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
    weights: GpWeights | None,
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
