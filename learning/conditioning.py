"""Weights conditioned on what instruments have read, in place of smoothed states.

Smoothed states err alike from one sample to the next, and what they err by depends on the model
that smoothed them: a GP that is trained on them has this error in its mean, however many there are.
So the last step of learning takes the readings themselves. A correction is a sum of basis
functions, with weights w that are normally distributed a priori,

    g(z) = m + phi(z)' w,    phi(z) = s L^-1 k(Z, z),    L L' = k(Z, Z),    w ~ N(0, I)

which is the GP on the subspace of M of its samples, Z (Seeger, Williams and Lawrence, "Fast forward
selection to speed up sparse Gaussian process regression", AISTATS 2003); what it lacks there,
s^2 k(z, z) - phi' phi, is independent noise in each step (Snelson and Ghahramani, "Sparse Gaussian
processes using pseudo-inputs", NIPS 2006), besides the learned noise. The corrected model is linear
in w, so an extended Kalman filter of [x; w], linearised along smoothed states, has the posterior of
w by all readings when it has passed all drives: w goes on from one to the next, x begins anew.
Samples that are at hand without readings are measurements of g.

Where a car is its own mirror image, so is the correction: k(z, z') + p k(z, Mz') in place of k,
with p = 1 for vx and -1 for vy and omega, which change their signs in the mirror M.

Weights have room for points, not for a covariance: they get the Z (with their images), the exact
mean, and the noise with which points there would leave as large a variance, on average over the
samples.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import brentq

from bayesrace.arrays import Floats, Rows
from bayesrace.gp.expression import kernel_matrix
from bayesrace.gp.weights import FEATURES, GpOutput, Weights
from bayesrace.integrators import Discretisation
from bayesrace.learning.dataset import MIRRORED_FEATURES, MIRRORED_OUTPUTS, Dataset
from bayesrace.learning.drives import Drive, Estimates, Event, Measured
from bayesrace.learning.kalman import compared
from bayesrace.learning.smoothing import (
    blurred,
    corrected_steps,
    inputs_of,
    period_begins,
    started,
)
from bayesrace.learning.subset import evenly, most_informative
from bayesrace.learning.validation import residual
from bayesrace.vehicles.parameters import Car

__all__ = ["conditioned"]

_BASIS: Final = 150
"""Functions of an output at most. Time and memory grow with their square."""
_RATIO: Final = 0.01
"""Noise over signal with which the most informative samples are chosen."""
_ROUNDING: Final = 1e-6
"""Of the mean variance, for the factor of Z that are nearly alike."""
_ALIKE: Final = 8.0
"""Smoothed states in a row that err alike: what so many of them say, one does."""
_COMPARED: Final = 400
"""Samples that variances are compared at."""
_NX: Final = 7
_NB: Final = 9
_LATER: Final = 48
"""Rows of corrections that are collected before the covariance of w is made anew."""


def conditioned(
    weights: Weights,
    dataset: Dataset,
    discretisation: Discretisation,
    capacity: int,
    noise_share: float,
) -> Weights:
    """The same kernels, with the mean and the variance that the readings of the drives leave, and
    the samples without drives.

    ``dataset`` was smoothed by nearly these ``weights``. ``capacity``: points of an output at most.
    ``noise_share``: of the variance of their noise, what is the model's. LinAlgError where they
    cannot follow the readings.
    """
    images = 2 if dataset.car.mirrored_samples and capacity > 1 else 1
    count, z = max(1, min(_BASIS, capacity // images)), dataset.features
    bases = [
        _Basis.of(output, z, count, parity if images == 2 else 0)
        for output, parity in zip(weights.outputs, MIRRORED_OUTPUTS, strict=True)
    ]
    belief = _Belief(bases, noise_share)
    estimates = dataset.estimates or Estimates.exact(len(dataset))
    number, place = estimates.origin.T
    if (settled := number < 0).any():
        samples = dataset.select(settled)
        belief.measure(samples.features, residual(samples, discretisation), samples.deviation)
    for k, drive in enumerate(estimates.drives):
        if (own := number == k).any():
            belief.follow(drive, place[own], dataset.car, discretisation, weights)
    mean, covariance = belief.result()
    some = z[evenly(len(z), _COMPARED)]
    outputs = [
        basis.output(mean[own], basis.variance(some, covariance[own, own]), some)
        for basis, own in zip(bases, belief.parts, strict=True)
    ]
    return replace(weights, outputs=(outputs[0], outputs[1], outputs[2]))


@dataclass(frozen=True, eq=False)
class _Basis:
    """phi of an output, in SI units."""

    before: GpOutput
    inputs: Floats
    """Z, (M, 6)"""
    parity: float
    """p; 0 for a car that is not symmetric."""
    factor: Floats
    """L, (M, M)"""

    @classmethod
    def of(cls, before: GpOutput, z: Floats, count: int, parity: float) -> "_Basis":
        """At ``count`` of the samples ``z`` (n, 6)."""
        rows = most_informative(before.kernel, z, before.length_scales, _RATIO, count)
        basis = cls(before, z[rows], parity, np.eye(len(rows)))
        matrix = basis.between(basis.inputs, basis.inputs)
        matrix[np.diag_indices_from(matrix)] += _ROUNDING * np.trace(matrix) / len(matrix)
        return replace(basis, factor=cholesky(matrix, lower=True))

    @property
    def scale(self) -> float:
        """s"""
        return float(self.before.y_scale * np.sqrt(self.before.signal_variance))

    @property
    def offset(self) -> float:
        """m; what is odd in the mirror has none."""
        return self.before.y_mean if self.parity >= 0 else 0.0

    def between(self, a: Floats, b: Floats) -> Floats:
        """Correlations (n, m) of g at ``a`` (n, 6) and ``b`` (m, 6)."""
        kind, lengths = self.before.kernel, self.before.length_scales
        found = kernel_matrix(kind, a, b, lengths)
        if self.parity:
            found += self.parity * kernel_matrix(kind, a, b * MIRRORED_FEATURES, lengths)
        return found

    def at(self, z: Floats) -> Floats:
        """phi (n, M)."""
        across = self.between(self.inputs, z)
        return np.asarray(self.scale * solve_triangular(self.factor, across, lower=True).T)

    def lacking(self, z: Floats, phi: Floats) -> Floats:
        """Prior variance (n,) that phi does not have."""
        own = np.ones(len(z))
        if self.parity:
            apart = z * (1 - MIRRORED_FEATURES) / self.before.length_scales
            # The kernel of one point with its own image: a row each.
            zero, ones = np.zeros((1, len(FEATURES))), np.ones(len(FEATURES))
            own += self.parity * kernel_matrix(self.before.kernel, apart, zero, ones)[:, 0]
        return np.asarray(np.maximum(self.scale**2 * own - np.sum(phi**2, axis=1), 0))

    def variance(self, z: Floats, covariance: Floats) -> Floats:
        """Of g at ``z``, (n,), where w has this covariance (M, M)."""
        phi = self.at(z)
        return np.asarray(np.sum(phi @ covariance * phi, axis=1) + self.lacking(z, phi))

    def output(self, w: Floats, variance: Floats, z: Floats) -> GpOutput:
        """Weights with the mean of ``w`` (M,), and such ``variance`` (n,) on average at ``z``."""
        before, scale = self.before, self.before.y_scale * self.before.signal_variance
        alpha = solve_triangular(self.factor, w, trans=1, lower=True) * self.scale / scale
        inputs = self.inputs
        if self.parity:
            inputs = np.vstack([inputs, inputs * MIRRORED_FEATURES])
            alpha = np.concatenate([alpha, self.parity * alpha])
        wanted = float(np.mean(variance)) / self.scale**2
        noise = self.before.signal_variance * _noise_for(before, inputs, z, wanted)
        return replace(before, inputs=inputs, alpha=alpha, y_mean=self.offset, noise_variance=noise)


def _noise_for(output: GpOutput, inputs: Floats, z: Floats, wanted: float) -> float:
    """Noise over signal of points at ``inputs``, with which the mean variance over the signal's at
    ``z`` is as wanted."""
    kind, lengths = output.kernel, output.length_scales
    values, vectors = np.linalg.eigh(kernel_matrix(kind, inputs, inputs, lengths))
    squares = (kernel_matrix(kind, z, inputs, lengths) @ vectors) ** 2
    values = np.maximum(values, 0)

    def excess(log_noise: float) -> float:
        left = 1 - squares @ (1 / (values + np.exp(log_noise)))
        return float(np.log(np.maximum(np.mean(left), 1e-14) / wanted))

    if not 0 < wanted < np.inf:
        raise np.linalg.LinAlgError("the readings leave no variance")
    least, most = np.log([1e-9, 1e3])
    if excess(least) > 0:
        return float(np.exp(least))
    return float(np.exp(brentq(excess, least, most, xtol=1e-3) if excess(most) > 0 else most))


class _Chain(NamedTuple):
    """The steps from each event to the next, linearised along a path."""

    ahead: Floats
    """(n, 9), from the path."""
    slope: Floats
    """(n, 9, 9), by the states."""
    by_g: Floats
    """(n, 9, 3), by the corrections of the period."""
    noise: Floats
    """(n, 9, 9)"""
    phi: Sequence[Floats]
    """(n, M) of each output."""
    assumed: Floats
    """Corrections (n, 3) that ``ahead`` was made with, beside m."""
    read: Sequence[Event]
    """The events that the steps lead to."""


class _Belief:
    """Mean and covariance of [x; w]."""

    def __init__(self, bases: Sequence[_Basis], noise_share: float) -> None:
        ends = np.cumsum([0, *(len(one.inputs) for one in bases)])
        self.parts = [slice(*pair) for pair in pairwise(ends.tolist())]
        self._bases, count = bases, int(ends[-1])
        self._noise = noise_share * np.array([one.before.amplitudes[3] for one in bases])
        self._w, self._ww = np.zeros(count), np.eye(count)
        self._x, self._rows = np.zeros(_NB), np.zeros((_NB, _NB + count))
        self._xx, self._xw = self._rows[:, :_NB], self._rows[:, _NB:]
        self._later, self._count = np.zeros((_LATER + _NX, count)), 0
        """The first rows R, of which R' R is still to be taken from the covariance of w."""

    def result(self) -> tuple[Floats, Floats]:
        """Mean (m,) and covariance (m, m) of w."""
        self._settle()
        return self._w, self._ww

    def measure(self, z: Floats, g: Floats, deviation: Floats) -> None:
        """Values ``g`` (n, 3) at ``z`` (n, 6), as well known as ``deviation`` (n, 3 or more) says;
        before any drive."""
        for k, (basis, own) in enumerate(zip(self._bases, self.parts, strict=True)):
            phi = basis.at(z)
            variance = _ALIKE * deviation[:, k] ** 2 + self._noise[k] + basis.lacking(z, phi)
            variance += _ROUNDING**2 * basis.scale**2
            weighted = phi / variance[:, None]
            covariance = np.linalg.inv(np.eye(phi.shape[1]) + weighted.T @ phi)
            self._ww[own, own] = covariance
            self._w[own] = covariance @ (weighted.T @ (g[:, k] - basis.offset))

    def follow(
        self,
        drive: Drive,
        samples: Rows,
        car: Car,
        discretisation: Discretisation,
        weights: Weights,
    ) -> None:
        """Takes in all readings of a smoothed drive, linearised along its path and ``weights``.

        ``samples``: the states in it that periods to learn from begin with. In others the
        correction is anything that it could be a priori.
        """
        events, path = drive.events, drive.path
        if path is None:
            raise ValueError("the drive has not been smoothed")
        path = path[:, :_NB]
        chain = self._chain(events, path, samples, car, discretisation, weights)
        self._x, self._xx[:] = started(events[0], drive, car, path[0])
        self._xw[:] = 0
        for i, event in enumerate(chain.read):
            if event.duration_s > 0:
                self._x = chain.ahead[i] + chain.slope[i] @ (self._x - path[i])
                self._predict(chain, i)
            if event.measured is not None:
                self._update(event.measured)

    def _chain(
        self,
        events: Sequence[Event],
        path: Floats,
        samples: Rows,
        car: Car,
        discretisation: Discretisation,
        weights: Weights,
    ) -> "_Chain":
        (u, h), rows = inputs_of(events[1:]), period_begins(events)
        begin = path[rows, :_NX]
        states = np.array([one.period for one in events])
        states[0] = states[states >= 0][0] - 1  # the first pose is within the period after it
        learned = np.isin(states[rows], samples)
        step = corrected_steps(path[:-1, :_NX], begin, u, h, car, discretisation, weights)
        z, share = np.column_stack([begin[:, 3:], u]), h / discretisation.step_s
        phi = [learned[:, None] * basis.at(z) for basis in self._bases]
        lacking = [basis.lacking(z, one) for basis, one in zip(self._bases, phi, strict=True)]
        spread = np.sqrt((np.column_stack(lacking) + self._noise) * share[:, None])
        spread = step.by_error * spread[:, None]
        drift = np.square(car.tuning.estimation(nominal=False)["drift"])
        noise = np.diag(drift) * h[:, None, None]
        noise[:, :_NX, :_NX] += spread @ spread.transpose(0, 2, 1)
        slope, by_g = np.tile(np.eye(_NB), (len(z), 1, 1)), np.zeros((len(z), _NB, 3))
        slope[:, :_NX, :_NX], by_g[:, :_NX] = step.slope, step.by_error * share[:, None, None]
        ahead = path[:-1].copy()
        ahead[:, :_NX] = step.ahead
        assumed = step.residual - [basis.offset for basis in self._bases]
        read = blurred(events, step.residual, discretisation.step_s)[1:]
        return _Chain(ahead, slope, by_g, noise, phi, assumed, read)

    def _predict(self, chain: "_Chain", i: int) -> None:
        """The covariance after a step, and the mean by w in place of what was assumed."""
        slope, by_g = chain.slope[i], chain.by_g[i]
        pairs = [(phi[i], part) for phi, part in zip(chain.phi, self.parts, strict=True)]
        g = np.array([one @ self._w[part] for one, part in pairs])
        gw = np.array([one @ self._ww[part] for one, part in pairs])
        later = self._later[: self._count]
        gw -= np.array([later[:, part] @ one for one, part in pairs]) @ later
        gx = np.array([self._xw[:, part] @ one for one, part in pairs])
        gg = np.array([gw[:, part] @ one for one, part in pairs])
        across = slope @ gx.T @ by_g.T
        self._x += by_g @ (g - chain.assumed[i])
        xx = slope @ self._xx @ slope.T + across + across.T + by_g @ gg @ by_g.T
        self._xx[:] = (xx + xx.T) / 2 + chain.noise[i]
        self._xw[:] = slope @ self._xw + by_g @ gw

    def _update(self, measured: Measured) -> None:
        """By a reading, one number after the other."""
        numbers = zip(measured.states, measured.value, measured.variance, strict=True)
        for state, value, variance in numbers:
            new, hp, s = compared(state, value, variance, self._x, self._rows)
            if not s > 0:
                raise np.linalg.LinAlgError("the readings cannot be followed")
            deviation = np.sqrt(s)
            by, white = hp / deviation, new / deviation
            self._x += by[:_NB] * white
            self._w += by[_NB:] * white
            self._rows -= np.outer(by[:_NB], by)
            self._later[self._count] = by[_NB:]
            self._count += 1
        if self._count >= _LATER:
            self._settle()

    def _settle(self) -> None:
        later = self._later[: self._count]
        self._ww -= later.T @ later
        self._count = 0
