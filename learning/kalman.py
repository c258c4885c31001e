"""Extended Kalman filter over the events of a drive, and the smoother of Rauch, Tung and Striebel.

The smoother takes in what came later (Särkkä, "Bayesian Filtering and Smoothing", section 9.1).
With the gain

    G_k = P_k F_k' P_(k+1|k)^-1

    x_(k|K) = x_k + G_k (x_(k+1|K) - x_(k+1|k)),
    P_(k|K) = P_k + G_k (P_(k+1|K) - P_(k+1|k)) G_k',    P_(k+1,k|K) = P_(k+1|K) G_k'.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.special import chdtri

from bayesrace.arrays import Flags, Floats, Rows
from bayesrace.learning.drives import Event, Measured

__all__ = ["Filtered", "Smoothed", "Transition", "backward", "compared", "forward"]

_NX: Final = 7
_NB: Final = 9
_EXCEEDED: Final = {n: float(chdtri(n, 0.001)) for n in range(1, _NX + 1)}
"""Squared distances that one of 1,000 right readings exceeds, as in the C code."""
_OFFSETS: Final = {5: 7, 6: 8}
"""The number of the offset that a yaw rate and a steering angle are read with."""
_HEADING: Final = 2
_REFUSED: Final = 5
"""After so many refused readings of an instrument in a row the next one is taken in: the filter is
wrong then, not the instrument."""
_ROUNDING: Final = 1e-13
"""Added to the diagonal of the scaled predicted covariance, which may be singular."""

Transition = Callable[[int, Floats], tuple[Floats, Floats, Floats]]
"""Takes the number of an event and the states (b, m) after the event before. Returns the predicted
states, their derivatives (.., m, m) by those, and the covariance (.., m, m) that the step adds,
which hold until the next call."""


@dataclass(eq=False)
class Filtered:
    """What the filter has found, for b variants side by side."""

    x: Floats  # (e, b, m), after each event
    p: Floats  # (e, b, m, m)
    predicted: Floats  # (e, b, m), before the reading of each event
    p_predicted: Floats  # (e, b, m, m)
    f: Floats  # (e, b, m, m), from the event before
    likelihood: Floats  # (b,)
    refused: Flags  # (e, b)


@dataclass(frozen=True, eq=False)
class Smoothed:
    """Of the states ``rows`` (m,) of a drive, those from its first pose on."""

    rows: Rows
    x: Floats
    """(m, 9)"""
    covariance: Floats
    """(m, 9, 9)"""
    cross: Floats
    """(m - 1, 9, 9): of each state with the one before, in this order."""
    path: Floats
    """All that was smoothed at every event, (e, 9 or more)."""
    refused: Flags
    """Events (e,) whose reading did not pass the gate."""

    def step_variance(self, slope: Floats) -> Floats:
        """Variances (m - 1, 3) of x_(k+1) - f(x_k, u_k) for vx, vy, omega, where f has these
        derivatives (m - 1, 7, 7)."""
        rows = slope[:, 3:6]
        p, own = self.covariance[:-1, :_NX, :_NX], self.covariance[1:, :_NX, :_NX]
        both = np.einsum("nij,njk->nik", rows, self.cross[:, 3:6, :_NX].transpose(0, 2, 1))
        found = np.einsum("nij,njk,nik->ni", rows, p, rows)
        found += np.einsum("nii->ni", own[:, 3:6, 3:6] - 2 * both)
        return np.asarray(np.maximum(found, 0))


def forward(
    events: Sequence[Event], x0: Floats, p0: Floats, go: Transition, gate: float
) -> Filtered:
    """The filter from ``x0`` (b, m) and ``p0`` (b, m, m) after the first event on."""
    (b, m), e = x0.shape, len(events)
    means, covariances = np.zeros((2, e, b, m)), np.zeros((3, e, b, m, m))
    filtered = Filtered(
        means[0], covariances[0], means[1], covariances[1], covariances[2],
        np.zeros(b), np.zeros((e, b), np.bool_),
    )  # fmt: skip
    refused = {one.measured.instrument: np.zeros(b, np.int64) for one in events if one.measured}
    x, p = x0, p0
    filtered.x[0], filtered.p[0] = x, p
    for i in range(1, e):
        event = events[i]
        if event.duration_s > 0:
            x, f, q = go(i, x)
            p = f @ p @ np.swapaxes(f, -1, -2)
            # An asymmetry of rounding would grow in an unstable model: no reading lessens it.
            p = (p + np.swapaxes(p, -1, -2)) / 2 + q
            filtered.f[i] = f
        else:
            filtered.f[i] = np.eye(m)
        filtered.predicted[i], filtered.p_predicted[i] = x, p
        if event.measured is not None:
            own = refused[event.measured.instrument]
            x, p, passed = _updated(x, p, event.measured, gate, filtered.likelihood, own)
            filtered.refused[i] = ~passed
        filtered.x[i], filtered.p[i] = x, p
    return filtered


def _updated(
    x: Floats, p: Floats, measured: Measured, gate: float, likelihood: Floats, refused: Rows
) -> tuple[Floats, Floats, Flags]:
    """With a reading, where the gate lets it pass (b,), or has refused too many of its instrument
    in a row (``refused``, (b,)); adds to the likelihoods (b,).

    Its numbers are taken in one after the other, which for independent errors is the same as all at
    once, without matrices to solve for.
    """
    given, squared, log_s = (x, p), np.zeros(len(x)), np.zeros(len(x))
    numbers = zip(measured.states, measured.value.tolist(), measured.variance.tolist(), strict=True)
    for state, value, variance in numbers:
        new, hp, s = compared(state, value, variance, x, p)
        deviation = np.sqrt(s)[:, None]
        by = hp / deviation
        x, p = x + by * (new[:, None] / deviation), p - by[:, :, None] * by[:, None]
        squared += new**2 / s
        log_s += np.log(s)
    if gate == 0:
        likelihood -= (squared + log_s) / 2
        return x, p, np.ones(len(x), np.bool_)
    limit = gate * _EXCEEDED[len(measured.states)]
    within = squared <= limit
    passed = within | (refused >= _REFUSED)
    refused[:] = np.where(within, 0, refused + 1)
    likelihood -= (np.minimum(squared, limit) + log_s) / 2
    if not passed.all():
        x, p = np.where(passed[:, None], x, given[0]), np.where(passed[:, None, None], p, given[1])
    return x, p, passed


def compared(state: int, value: float, variance: float, x: Floats, p: Floats) -> Any:
    """Of a number that was read of ``state``: what it differs by from what it would be at ``x``
    (.., m), the covariance of that with all rows of ``p`` (.., m, n), (.., n), and its variance."""
    new, hp = value - x[..., state], p[..., state, :]
    s = hp[..., state] + variance
    if (offset := _OFFSETS.get(state)) is not None:
        new, hp = new - x[..., offset], hp + p[..., offset, :]
        s = hp[..., state] + hp[..., offset] + variance
    if state == _HEADING:
        new = np.remainder(new + np.pi, 2 * np.pi) - np.pi
    return new, hp, s


def backward(events: Sequence[Event], filtered: Filtered) -> Smoothed:
    """What all readings say of the states, from a filter of one variant."""
    x, p, predicted = filtered.x[:, 0].copy(), filtered.p[:, 0].copy(), filtered.p_predicted[1:, 0]
    m = x.shape[1]
    scale = np.sqrt(np.einsum("nii->ni", predicted))
    scale[scale == 0] = 1
    scaled = predicted / (scale[:, :, None] * scale[:, None]) + _ROUNDING * np.eye(m)
    gains = np.linalg.solve(scaled, filtered.f[1:, 0] @ p[:-1] / scale[:, :, None])
    gains = gains.transpose(0, 2, 1) / scale[:, None]
    ends = np.array([i for i, one in enumerate(events) if one.period >= 0])
    cross, since, end = list[Floats](), np.eye(m), ends[-1]
    for i in range(len(events) - 2, -1, -1):
        gain = gains[i]
        x[i] += gain @ (x[i + 1] - filtered.predicted[i + 1, 0])
        p[i] += gain @ (p[i + 1] - predicted[i]) @ gain.T
        p[i] = (p[i] + p[i].T) / 2
        since = gain @ since
        if events[i].period >= 0:
            if i < ends[-1]:
                cross.append(p[end] @ since.T)
            end, since = i, np.eye(m)
    rows = np.array([events[i].period for i in ends])
    mixed = np.array(cross[::-1]).reshape(len(ends) - 1, m, m)[:, :_NB, :_NB]
    kept = x[ends, :_NB], p[ends, :_NB, :_NB], mixed
    return Smoothed(rows, *kept, x, filtered.refused[:, 0])
