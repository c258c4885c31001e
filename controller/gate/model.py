"""The model that the controller predicts with, asked by the gatekeeper: the same compiled code."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from bayesrace.errors import InputError
from bayesrace.gp.weights import GpWeights
from bayesrace.vehicles.parameters import CarParameters
from controller.gate.samples import Sample
from controller.native_step import NativeStep
from controller.settings import MpcSettings

__all__ = ["OneStepModel", "plausible_samples"]

_Floats = npt.NDArray[np.float64]


class OneStepModel:
    """Predicts with one set of weights; None: without correction.

    InputError if they are for another model, too large, or overflow.
    """

    def __init__(self, artefact: Path, car: CarParameters, weights: GpWeights | None) -> None:
        self._step = NativeStep(artefact, car, MpcSettings())
        self.step_s = self._step.manifest.step_s
        if weights is not None:
            self._step.set_weights(weights)

    def velocities(self, samples: Sequence[Sample]) -> _Floats:
        """Predicted vx, vy, omega (n, 3) at the samples' ends; NaN where nothing is predicted."""
        predicted = np.full((len(samples), 3), np.nan)
        x_next = np.zeros(7)
        for row, sample in zip(predicted, samples, strict=True):
            try:
                row[:] = self._step.predict(sample.x, sample.u, sample.duration_s, x_next)[3:6]
            except InputError:  # a state that is absurd, or that the weights make absurd
                continue
        return predicted

    def errors(self, samples: Sequence[Sample]) -> _Floats:
        """One-step errors (n, 3) as velocities after one Ts; infinite where none is predicted."""
        if not samples:
            return np.zeros((0, 3))
        after = np.array([sample.x_next[3:6] for sample in samples])
        scale = self.step_s / np.array([sample.duration_s for sample in samples])
        errors: _Floats = (after - self.velocities(samples)) * scale[:, None]
        return np.where(np.isfinite(errors), errors, np.inf)


def plausible_samples(car: CarParameters, step_s: float, count: int) -> list[Sample]:
    """States and inputs all over what the car can do, always the same ones."""
    random = np.random.default_rng(5)
    top_mps = _top_speed_mps(car)
    samples = []
    for _ in range(count):
        vx, slip, turn, steer, push, rate = random.uniform(-1, 1, 6)
        vx = 0.5 * (vx + 1) * top_mps
        delta = steer * car.delta_max_rad
        omega = turn * vx * np.tan(car.delta_max_rad) / car.wheelbase_m
        x = np.array([0.0, 0.0, 0.0, vx, 0.3 * slip * vx, omega, delta])
        d = car.d_min + 0.5 * (push + 1) * (car.d_max - car.d_min)
        u = np.array([d, rate * car.delta_rate_max_radps])
        samples.append(Sample(0, 0, step_s, x, u, x))
    return samples


def _top_speed_mps(car: CarParameters) -> float:
    """Where drive and resistance are equal: (cm1 - cm2 v) d_max = cr0 + cr2 v^2."""
    a, b, c = car.cr2, car.cm2 * car.d_max, car.cr0 - car.cm1 * car.d_max
    roots = np.roots([a, b, c]) if a else np.array([-c / b])
    speeds = [float(root.real) for root in roots if abs(root.imag) < 1e-9 and root.real > 0]
    return max(speeds, default=1.0)
