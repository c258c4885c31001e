"""The compiled model that the controller predicts with, for one set of weights."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from bayesrace.errors import InputError
from bayesrace.gp.weights import GpWeights
from bayesrace.vehicles.parameters import CarParameters
from controller.native_step import NativeStep
from controller.settings import MpcSettings
from controller.weights.samples import Sample

__all__ = ["OneStepModel", "plausible_samples"]

_Floats = npt.NDArray[np.float64]


class OneStepModel:
    """Predicts with one set of weights; None: without correction.

    InputError if they are for another model, too large, or overflow.
    """

    def __init__(self, artefact: Path, car: CarParameters, weights: GpWeights | None) -> None:
        self.weights = weights
        self._step = NativeStep(artefact, car, MpcSettings())
        self.step_s = self._step.manifest.step_s
        if weights is not None:
            self._step.set_weights(weights)

    def velocities(self, samples: Sequence[Sample]) -> _Floats:
        """Predicted vx, vy, omega (n, 3) at the samples' ends; NaN where the model has no value."""
        predicted = np.full((len(samples), 3), np.nan)
        x_next = np.zeros(7)
        for row, sample in zip(predicted, samples, strict=True):
            try:
                row[:] = self._step.predict(sample.x, sample.u, sample.duration_s, x_next)[3:6]
            except InputError:  # a state that is absurd, or that the weights make absurd
                continue
        return predicted

    def errors(self, samples: Sequence[Sample]) -> _Floats:
        """One-step errors (n, 3) as velocities after one Ts; infinite without a prediction."""
        after = np.array([sample.x_next[3:6] for sample in samples]).reshape(-1, 3)
        scale = self.step_s / np.array([[sample.duration_s] for sample in samples]).reshape(-1, 1)
        errors: _Floats = (after - self.velocities(samples)) * scale
        return np.where(np.isfinite(errors), errors, np.inf)


def plausible_samples(car: CarParameters, step_s: float, count: int) -> list[Sample]:
    """States and inputs over the whole range of the car, always the same ones."""
    uniform = np.random.default_rng(5).uniform(-1, 1, (count, 6))
    vx, slip, turn, steer, push, rate = uniform.T
    vx = 0.5 * (vx + 1) * _top_speed_mps(car)
    omega = turn * vx * np.tan(car.delta_max_rad) / car.wheelbase_m
    delta, zero = steer * car.delta_max_rad, np.zeros(count)
    x = np.column_stack([zero, zero, zero, vx, 0.3 * slip * vx, omega, delta])
    d = car.d_min + 0.5 * (push + 1) * (car.d_max - car.d_min)
    u = np.column_stack([d, rate * car.delta_rate_max_radps])
    return [Sample(0, step_s, x[k], u[k], x[k]) for k in range(count)]


def _top_speed_mps(car: CarParameters) -> float:
    """Where drive and resistance are equal: (cm1 - cm2 v) d_max = cr0 + cr2 v^2."""
    a, b, c = car.cr2, car.cm2 * car.d_max, car.cr0 - car.cm1 * car.d_max
    roots = np.roots([a, b, c]) if a else np.array([-c / b])
    speeds = [float(root.real) for root in roots if abs(root.imag) < 1e-9 and root.real > 0]
    return max(speeds, default=1.0)
