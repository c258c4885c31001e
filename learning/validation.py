"""Comparison of weights with the residual of a drive that they were not trained on."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from bayesrace.arrays import Flags, Floats
from bayesrace.errors import InputError
from bayesrace.gp.expression import evaluate_mean
from bayesrace.gp.weights import OUTPUTS, GpOutput, GpWeights
from bayesrace.integrators import Discretisation
from learning.dataset import Dataset
from learning.posterior import Covariance, Posterior
from learning.residual import identity, residual
from learning.scores import NORMAL_95, PredictionErrors

__all__ = ["Validation", "predictive_sigma", "validate"]


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


def _output_sigma(output: GpOutput, z: Floats) -> Floats:
    covariance = Covariance(
        output.kernel, output.signal_variance, output.length_scales, output.noise_variance
    )
    # The uncertainty does not depend on the targets.
    _, sigma = Posterior(covariance, output.inputs, np.zeros(output.count)).predict(z)
    return output.y_scale * sigma


def predictive_sigma(weights: GpWeights, z: Floats) -> Floats:
    """Predictive standard deviation (m, 3) at features ``z`` (m, 6), noise included, SI units."""
    return np.column_stack([_output_sigma(output, z) for output in weights.outputs])


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
