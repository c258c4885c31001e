"""How well weights predict the residual of a drive that they were not trained on."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, solve_triangular

from bayesrace.errors import InputError
from bayesrace.gp.expression import evaluate_mean, kernel_matrix
from bayesrace.gp.weights import OUTPUTS, GpOutput, GpWeights
from bayesrace.integrators import Discretisation
from learning.dataset import Dataset
from learning.residual import identity, residual

__all__ = ["Validation", "predictive_sigma", "validate", "with_metrics"]

Floats = NDArray[np.float64]

_NORMAL_95 = 1.959963984540054


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


def _output_sigma(output: GpOutput, z: Floats) -> Floats:
    prior = output.signal_variance + output.noise_variance
    if output.count == 0:
        return np.full(len(z), output.y_scale * np.sqrt(prior))
    signal = output.signal_variance
    own = signal * kernel_matrix(output.kernel, output.inputs, output.inputs, output.length_scales)
    own[np.diag_indices_from(own)] += output.noise_variance
    try:
        factor, _ = cho_factor(own, lower=True)
    except np.linalg.LinAlgError as error:
        raise InputError("GP weights: covariance of the inputs is singular; train again") from error
    cross = signal * kernel_matrix(output.kernel, output.inputs, z, output.length_scales)
    explained = solve_triangular(factor, cross, lower=True, check_finite=False)
    variance = prior - np.einsum("ij,ij->j", explained, explained)
    sigma: Floats = output.y_scale * np.sqrt(np.maximum(variance, output.noise_variance))
    return sigma


def predictive_sigma(weights: GpWeights, z: Floats) -> Floats:
    """Predictive standard deviation (m, 3) at features ``z`` (m, 6), noise included, SI units.

    sigma^2 = y_scale^2 (s^2 + noise - s^4 k' (s^2 K + noise I)^-1 k).
    """
    return np.column_stack([_output_sigma(output, z) for output in weights.outputs])


def _metrics(residual: Floats, mean: Floats, sigma: Floats) -> dict[str, float]:
    error = residual - mean
    spread = float(np.sum((residual - residual.mean()) ** 2))
    score = (error / sigma) ** 2 + np.log(2 * np.pi * sigma**2)
    return {
        "rmse": float(np.sqrt(np.mean(error**2))),
        "uncorrected_rmse": float(np.sqrt(np.mean(residual**2))),
        "r2": 1.0 - float(np.sum(error**2)) / spread if spread > 0 else 0.0,
        "coverage": float(np.mean(np.abs(error) <= _NORMAL_95 * sigma)),
        "log_density": float(-0.5 * score.mean()),
    }


def validate(weights: GpWeights, dataset: Dataset, discretisation: Discretisation) -> Validation:
    """Compares prediction and residual on ``dataset``.

    InputError without samples, or if the weights are for another discretised model.
    """
    name = identity(dataset, discretisation)
    if weights.discretisation != name:
        raise InputError(f"weights are for {weights.discretisation}, the samples for {name}")
    if len(dataset) == 0:
        raise InputError("validation: no samples left; drive longer")
    z, truth = dataset.features, residual(dataset, discretisation)
    mean, sigma = evaluate_mean(weights, z), predictive_sigma(weights, z)
    metrics = {
        name: _metrics(truth[:, i], mean[:, i], sigma[:, i]) for i, name in enumerate(OUTPUTS)
    }
    return Validation(truth, mean, sigma, metrics)


def with_metrics(weights: GpWeights, validation: Validation) -> GpWeights:
    """The same weights carrying the validation's metrics under the outputs' names."""
    return replace(weights, metrics={**weights.metrics, **validation.metrics})
