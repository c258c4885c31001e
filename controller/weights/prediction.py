"""What weights say of features, by the compiled model that drives with them."""

from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.gp.weights import OUTPUTS, GpWeights
from bayesrace.vehicles.parameters import CarParameters
from bayesrace.vehicles.parts import GRAVITY_MPS2
from controller.native_step import NativeStep
from controller.settings import MpcSettings

__all__ = ["Correction", "Samples", "plausible_features"]


class Samples(NamedTuple):
    """What the car did: features (n, 6), and the residuals (n, 3) of the nominal model."""

    features: Floats
    residuals: Floats


class Correction:
    """The correction that one set of weights makes; None: none."""

    def __init__(self, artefact: Path, car: CarParameters, weights: GpWeights | None) -> None:
        """InputError if the weights are for another model, too large, or overflow."""
        self.weights = weights
        self._nominal, self._corrected = (
            NativeStep(artefact, car, MpcSettings()) for _ in range(2)
        )
        self.step_s = self._nominal.manifest.step_s
        if weights is not None:
            self._corrected.set_weights(weights)

    def mean(self, features: Floats) -> Floats:
        """Of vx, vy, omega (n, 3), per step; NaN where the model has no value."""
        found = np.full((len(features), len(OUTPUTS)), np.nan)
        for row, one in zip(found, features, strict=True):
            x, u = np.concatenate([np.zeros(3), one[:4]]), one[4:]
            try:
                corrected = self._corrected.predict(x, u, self.step_s)[3:6].copy()
                row[:] = corrected - self._nominal.predict(x, u, self.step_s)[3:6]
            except InputError:  # a state that is absurd, or that the weights make absurd
                continue
        return found

    def errors(self, samples: Samples) -> Floats:
        """What is left of the residuals (n, 3); infinite where the model has no value."""
        left = samples.residuals - self.mean(samples.features)
        return np.where(np.isfinite(left), left, np.inf)


_MOST: Final = 15.0
"""Times its usable acceleration, no car corners: more than the 1:43 car at full lock and speed."""


def plausible_features(car: CarParameters, count: int) -> Floats:
    """Features (count, 6) over the whole range of the car, always the same ones."""
    vx, slip, turn, steer, push, rate = np.random.default_rng(5).uniform(-1, 1, (count, 6)).T
    vx = 0.5 * (vx + 1) * car.drive.top_speed_mps(car.d_max)
    sharpest = vx * np.tan(car.delta_max_rad) / car.wheelbase_m
    with np.errstate(divide="ignore"):
        omega = turn * np.minimum(sharpest, _MOST * car.friction * GRAVITY_MPS2 / vx)
    delta = steer * car.delta_max_rad
    d = car.d_min + 0.5 * (push + 1) * (car.d_max - car.d_min)
    return np.column_stack([vx, 0.3 * slip * vx, omega, delta, d, rate * car.delta_rate_max_radps])
