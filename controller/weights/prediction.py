"""What the compiled model predicts, and what the car did: one-step samples of recorded states."""

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.gp.weights import GpWeights
from bayesrace.vehicles.parameters import CarParameters
from bayesrace.vehicles.parts import GRAVITY_MPS2
from controller.native_step import NativeStep
from controller.settings import MpcSettings

__all__ = ["OneStepModel", "Sample", "Sampler", "StateRecord", "plausible_samples"]

_LONGEST: Final = 5.0
"""Sampling times that a sample lasts at most; where states come seldom, each makes one."""


class StateRecord(NamedTuple):
    """A state as the control thread has recorded it, with its ``number`` among all."""

    number: int
    epoch: int
    run: int
    seq: int
    time_s: float
    recorded_ns: int
    """Monotonic clock, the same in all processes of a machine."""
    x: tuple[float, ...]
    u_applied: tuple[float, ...]
    lockstep: bool
    fallen_back: bool | None = None
    """The input of the cycle before was the fallback's; None: the car was not driven."""


class Sample(NamedTuple):
    """The car went from ``x`` (7,) to ``x_next`` (7,) with the input ``u`` (2,), a mean."""

    recorded_ns: int
    duration_s: float
    x: Floats
    u: Floats
    x_next: Floats


class Sampler:
    """Joins consecutive states until they are a sampling time apart; a gap begins anew."""

    def __init__(self, step_s: float, car: CarParameters) -> None:
        """Leaves out samples that begin at standstill or in a spin: nothing is learned from them
        either, so they do not tell one set of weights from another."""
        self._step_s, self._gate = step_s, car.tuning.gate
        self._states: list[StateRecord] = []
        """Those of the sample that is not complete yet."""

    def add(self, state: StateRecord) -> Sample | None:
        """The sample that this state completes, if any."""
        if self._states:
            last = self._states[-1]
            expected = (last.epoch, last.run, last.seq + 1)
            if (state.epoch, state.run, state.seq) != expected or state.time_s <= last.time_s:
                self._states = []
        self._states.append(state)
        states, first = self._states, self._states[0]
        duration_s = state.time_s - first.time_s
        if duration_s < self._step_s * (1 - 1e-6):
            return None
        self._states = [state]
        vx, vy = first.x[3:5]
        spinning = abs(math.atan2(vy, vx)) > self._gate.spin_rad
        if vx < self._gate.moving_mps or spinning or duration_s > _LONGEST * self._step_s:
            return None
        steps = ((b.time_s - a.time_s) * np.array(b.u_applied) for a, b in pairwise(states))
        u = sum(steps, np.zeros(2)) / duration_s
        if abs(duration_s - self._step_s) < 1e-6 * self._step_s:
            duration_s = self._step_s  # for exactly one step the model takes no remainder
        return Sample(state.recorded_ns, duration_s, np.array(first.x), u, np.array(state.x))


class OneStepModel:
    """Predicts with one set of weights; None: without correction."""

    def __init__(self, artefact: Path, car: CarParameters, weights: GpWeights | None) -> None:
        """InputError if the weights are for another model, too large, or overflow."""
        self.weights = weights
        self._step = NativeStep(artefact, car, MpcSettings())
        self.step_s = self._step.manifest.step_s
        if weights is not None:
            self._step.set_weights(weights)

    def velocities(self, samples: Sequence[Sample]) -> Floats:
        """Predicted vx, vy, omega (n, 3) at the samples' ends; NaN where the model has no value."""
        predicted = np.full((len(samples), 3), np.nan)
        for row, (_, duration_s, x, u, _) in zip(predicted, samples, strict=True):
            try:
                row[:] = self._step.predict(x, u, duration_s)[3:6]
            except InputError:  # a state that is absurd, or that the weights make absurd
                continue
        return predicted

    def errors(self, samples: Sequence[Sample]) -> Floats:
        """One-step errors (n, 3) as velocities after one Ts; infinite without a prediction."""
        after = np.array([sample.x_next[3:6] for sample in samples]).reshape(-1, 3)
        duration_s = np.array([sample.duration_s for sample in samples])[:, None]
        errors: Floats = (after - self.velocities(samples)) * (self.step_s / duration_s)
        return np.where(np.isfinite(errors), errors, np.inf)


_MOST: Final = 15.0
"""Times its usable acceleration, no car corners: more than the 1:43 car at full lock and speed."""


def plausible_samples(car: CarParameters, step_s: float, count: int) -> list[Sample]:
    """States and inputs over the whole range of the car, always the same ones."""
    vx, slip, turn, steer, push, rate = np.random.default_rng(5).uniform(-1, 1, (count, 6)).T
    vx = 0.5 * (vx + 1) * car.drive.top_speed_mps(car.d_max)
    sharpest = vx * np.tan(car.delta_max_rad) / car.wheelbase_m
    with np.errstate(divide="ignore"):
        omega = turn * np.minimum(sharpest, _MOST * car.friction * GRAVITY_MPS2 / vx)
    pose, delta = np.zeros((count, 3)), steer * car.delta_max_rad
    x = np.column_stack([pose, vx, 0.3 * slip * vx, omega, delta])
    d = car.d_min + 0.5 * (push + 1) * (car.d_max - car.d_min)
    u = np.column_stack([d, rate * car.delta_rate_max_radps])
    return [Sample(0, step_s, x[k], u[k], x[k]) for k in range(count)]
