"""States of a drive from what instruments have read in it, all of them used for every state.

A controller's estimate at a moment uses what was read before; learning can use what was read after
it as well. A forward pass is an extended Kalman filter as that of controller/native/br_estimator.c
(nine numbers: the states, and the offsets of the measured yaw rate and steering angle; the residual
of a period's beginning in all its parts), in order of measurement, so that no reading is late.
Other than that one it begins vaguely, at speed, never widens its covariance, and judges no
instrument; nor does it keep the car to its limits. A backward pass, Rauch, Tung and Striebel's,
takes in what came later (Särkkä, "Bayesian Filtering and Smoothing", section 9.1): with the gain

    G_k = P_k F_k' P_(k+1|k)^-1

    x_(k|K) = x_k + G_k (x_(k+1|K) - x_(k+1|k)),
    P_(k|K) = P_k + G_k (P_(k+1|K) - P_(k+1|k)) G_k',    P_(k+1,k|K) = P_(k+1|K) G_k'.

Two models predict. **Without weights** no model of the car does: the pose follows from the
velocities, and these are twice integrated random walks in the car's frame (white jerk), as noisy as
makes the readings most likely. The nominal model would bend the velocities to its own error, which
is just what is to be learned. Its gate is that of the C code, but for a reading after five of its
instrument that were refused, and for a random walk that is noisier still: what it has refused is
left out for good. **With weights** it is the corrected model, with the variance that the weights
state and the walk of ``car.tuning.estimator``, linearised along the first result; it has no gate,
since where its weights know nothing it would refuse what is to be learned.

Steering that no instrument reads is what was commanded, from what is known of it at the start: at a
run's the wheels are straight, later the controller's estimate is as good as it states.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any, Final, NamedTuple

import casadi as ca
import numpy as np
from scipy.special import chdtri

from bayesrace.arrays import Flags, Floats, Rows
from bayesrace.gp.expression import mean_function
from bayesrace.gp.weights import Weights
from bayesrace.integrators import Discretisation, pose_from_velocities
from bayesrace.learning.drives import POSE, Drive, Event, Measured
from bayesrace.learning.validation import NOMINAL, predictive_sigma
from bayesrace.vehicles.parameters import Car
from bayesrace.vehicles.parts import GRAVITY_MPS2

__all__ = ["Smoothed", "Steps", "blurred", "corrected_steps", "innovation", "inputs_of"]
__all__ += ["observation", "period_begins", "smooth", "started"]

_NX: Final = 7
_NB: Final = 9
_VAGUE: Final = 10.0
"""Times the tuning's deviations of a start from rest: a drive may begin at speed."""
_JERK_S: Final = 0.1
"""In which accelerations change by their full range: the middle of the search."""
_LOOSER: Final = 30.0
"""Times its most likely noise, with which the random walk judges readings: so it refuses nothing
that a car can do."""
_SEARCHED: Final = (4, 75)
"""Windows of a drive, evenly spread, and periods in each, that the random walk's noise is found
by."""
_EXCEEDED: Final = {n: float(chdtri(n, 0.001)) for n in range(1, _NX + 1)}
"""Squared distances that one of 1,000 right readings exceeds, as in the C code."""
_REFUSED: Final = 5
"""Readings of an instrument in a row: then it is the filter that is wrong."""
_LINEARISED: Final = 2
"""Passes along the result of the one before."""


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


# Filter and smoother -----------------------------------------------------------------------------

_Transition = Callable[[int, Floats], tuple[Floats, Floats, Floats]]
"""Event i and x (b, m) at the one before to x, its derivatives (.., m, m), added covariance."""


@dataclass(eq=False)
class _Forward:
    """What the filter has found, for b variants side by side."""

    x: Floats  # (e, b, m), after each event
    p: Floats  # (e, b, m, m)
    ahead: Floats  # (e, b, m), before each event
    p_ahead: Floats  # (e, b, m, m)
    f: Floats  # (e, b, m, m), from the event before
    likelihood: Floats  # (b,)
    refused: Flags  # (e, b)


def _forward(
    events: Sequence[Event], x0: Floats, p0: Floats, go: _Transition, gate: float
) -> _Forward:
    """The filter from ``x0`` (b, m) and ``p0`` (b, m, m) after the first event on."""
    (b, m), e = x0.shape, len(events)
    means, covariances = np.zeros((2, e, b, m)), np.zeros((3, e, b, m, m))
    made = _Forward(
        means[0], covariances[0], means[1], covariances[1], covariances[2],
        np.zeros(b), np.zeros((e, b), np.bool_),
    )  # fmt: skip
    refused = {one.measured.instrument: np.zeros(b, np.int64) for one in events if one.measured}
    x, p = x0, p0
    made.x[0], made.p[0] = x, p
    for i in range(1, e):
        event = events[i]
        if event.duration_s > 0:
            x, f, q = go(i, x)
            p = f @ p @ np.swapaxes(f, -1, -2) + q
            made.f[i] = f
        else:
            made.f[i] = np.eye(m)
        made.ahead[i], made.p_ahead[i] = x, p
        if event.measured is not None:
            own = refused[event.measured.instrument]
            x, p, passed = _updated(x, p, event.measured, gate, made.likelihood, own)
            made.refused[i] = ~passed
        made.x[i], made.p[i] = x, p
    return made


def _updated(
    x: Floats, p: Floats, measured: Measured, gate: float, likelihood: Floats, refused: Rows
) -> tuple[Floats, Floats, Flags]:
    """With a reading, where the gate lets it pass (b,), or has refused too many of its instrument
    in a row (``refused``, (b,)); adds to the likelihoods (b,)."""
    of, m = measured.states, x.shape[1]
    h, r = observation(of, m), np.diag(measured.variance)
    hp = h @ p
    s = hp @ h.T + r
    new = innovation(measured, x, h)
    weighted = np.linalg.solve(s, np.concatenate([new[..., None], hp], axis=2))
    squared = np.einsum("bi,bi->b", new, weighted[..., 0])
    limit = gate * _EXCEEDED[len(of)] if gate > 0 else np.inf
    passed = (squared <= limit) | (refused >= _REFUSED)
    refused[:] = np.where(squared <= limit, 0, refused + 1)
    likelihood -= 0.5 * (np.minimum(squared, limit) + np.linalg.slogdet(s)[1])
    gain = np.swapaxes(weighted[..., 1:], 1, 2) * passed[:, None, None]
    left = np.eye(m) - gain @ h
    p = left @ p @ np.swapaxes(left, 1, 2) + gain @ r @ np.swapaxes(gain, 1, 2)
    return x + np.einsum("bij,bj->bi", gain, new), p, passed


def innovation(measured: Measured, x: Floats, h: Floats) -> Floats:
    """What a reading differs by from what it would be at ``x`` (b, m), where it is ``h`` x."""
    new = measured.value - x @ h.T
    if 2 in measured.states:
        k = measured.states.index(2)
        new[:, k] = np.remainder(new[:, k] + np.pi, 2 * np.pi) - np.pi
    return new


def observation(of: Sequence[int], m: int) -> Floats:
    """Matrix (n, m) of the readings of the states ``of``, with the offsets of those that have
    one."""
    h = np.zeros((len(of), m))
    h[range(len(of)), of] = 1
    h[:, 7] += h[:, 5]
    h[:, 8] += h[:, 6]
    return h


def _backward(events: Sequence[Event], made: _Forward) -> Smoothed:
    """Of a filter's only variant."""
    x, p = made.x[:, 0].copy(), made.p[:, 0].copy()
    m, since = x.shape[1], np.eye(x.shape[1])
    ends = np.array([i for i, one in enumerate(events) if one.period >= 0])
    cross: list[Floats] = []
    end = ends[-1]
    for i in range(len(events) - 2, -1, -1):
        ahead = made.p_ahead[i + 1, 0]
        scale = np.sqrt(np.diag(ahead))
        scale[scale == 0] = 1
        scaled = ahead / np.outer(scale, scale) + 1e-13 * np.eye(m)
        back = made.p[i, 0] @ made.f[i + 1, 0].T / scale
        gain = np.linalg.solve(scaled, back.T).T / scale
        x[i] += gain @ (x[i + 1] - made.ahead[i + 1, 0])
        p[i] += gain @ (p[i + 1] - ahead) @ gain.T
        p[i] = (p[i] + p[i].T) / 2
        since = gain @ since
        if events[i].period >= 0:
            if i < ends[-1]:
                cross.append(p[end] @ since.T)
            end, since = i, np.eye(m)
    rows = np.array([events[i].period for i in ends])
    mixed = np.array(cross[::-1]).reshape(len(ends) - 1, m, m)[:, :_NB, :_NB]
    kept = x[ends, :_NB], p[ends, :_NB, :_NB], mixed
    return Smoothed(rows, *kept, x, made.refused[:, 0])


# The two models ----------------------------------------------------------------------------------


def smooth(
    drive: Drive, car: Car, discretisation: Discretisation, weights: Weights | None
) -> Smoothed | None:
    """The states of a drive, by the corrected model or, without weights, by a random walk; None
    where too little was read, or the model cannot follow."""
    events = drive.events
    if not events or all(one.period < 0 for one in events):
        return None
    if weights is None:
        return _walked(events, drive, car)
    path = drive.path
    if path is None:
        walked = _walked(events, drive, car)
        path, drive = walked.path, replace(drive, refused=walked.refused)
        events = drive.events
    for _ in range(_LINEARISED):
        model, read = _corrected(events, path[:, :_NB], car, discretisation, weights)
        x0, p0 = started(events[0], drive, car, path[0, :_NB])
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                found = _backward(read, _forward(read, x0[None], p0[None], model, gate=0))
        except np.linalg.LinAlgError:  # what is believed has run away
            return None
        path = found.path
        if not _possible(path, car):
            return None
    return found if drive.refused is None else replace(found, refused=drive.refused)


def _possible(path: Floats, car: Car) -> bool:
    """Whether a controller would accept all of its states."""
    most = car.tuning.plausible
    bounds = np.array([
        most.position_m, most.position_m, most.heading_rad, most.speed_mps, most.speed_mps,
        most.yaw_rate_radps, most.steering_rad,
    ])  # fmt: skip
    return bool((np.abs(path[:, :_NX]) <= bounds).all())


def started(first: Event, drive: Drive, car: Car, around: Floats) -> tuple[Floats, Floats]:
    """Mean and covariance after the first pose."""
    x, settings = around.copy(), car.tuning.estimation(nominal=True)
    p = np.diag(np.square(settings["start"]))
    p[3:6] *= _VAGUE**2
    x[6] = drive.steering_rad
    read = {name for one in drive.readings for name in one.values}
    for offset, name in ((7, "omega"), (8, "delta")):
        x[offset], p[offset, offset] = 0.0, p[offset, offset] * (name in read)
    if "delta" not in read or drive.steering_deviation_rad > 0:
        p[6, 6] = drive.steering_deviation_rad**2
    if (pose := first.measured) is not None:
        x[6] += drive.turned_rad(pose.time_s)
        x[:3], p[:3, :3] = pose.value[:3], np.diag(pose.variance[:3])
    return x, p


def inputs_of(events: Sequence[Event]) -> tuple[Floats, Floats]:
    """Inputs (2, e) and durations (1, e)."""
    return np.array([one.u for one in events]).T, np.array([[one.duration_s for one in events]])


def _stacked(matrix: Any, count: int) -> Floats:
    """(n, m * count) of CasADi to (count, n, m)."""
    array = np.asarray(matrix, dtype=np.float64)
    return array.reshape(len(array), count, -1).transpose(1, 0, 2)


def period_begins(events: Sequence[Event]) -> Rows:
    """The event at which the period of each event but the first has begun, (e - 1,)."""
    ends = [i if i == 0 or one.period >= 0 else 0 for i, one in enumerate(events[:-1])]
    return np.maximum.accumulate(ends)


def blurred(events: Sequence[Event], residual: Floats, step_s: float) -> list[Event]:
    """Readings of velocities with what the corrected model errs by within periods in their
    variance. ``residual`` (e - 1, 3): of the period of each event but the first.

    The residual acts evenly in a period, though it changes from one to the next: by dg, as if it
    were linear in time, it has left out dg tau (1 - tau) / 2 after a share tau of the period.
    """
    first, period = np.unique(period_begins(events), return_inverse=True)
    if len(first) < 2:
        return list(events)
    passed = np.cumsum([one.duration_s for one in events[1:]])
    ended = passed[np.append(first[1:] - 1, -1)][period]
    tau = np.clip(1 - (ended - passed) / step_s, 0, 1)
    error = np.gradient(residual[first], axis=0)[period] * (tau * (1 - tau) / 2)[:, None]
    found = [events[0]]
    for event, by in zip(events[1:], error, strict=True):
        if (one := event.measured) is not None and {3, 4, 5} & set(one.states):
            added = [by[k - 3] ** 2 if 3 <= k <= 5 else 0.0 for k in one.states]
            event = event._replace(measured=one._replace(variance=one.variance + added))
        found.append(event)
    return found


def _corrected(
    events: Sequence[Event],
    path: Floats,
    car: Car,
    discretisation: Discretisation,
    weights: Weights,
) -> tuple[_Transition, list[Event]]:
    """The corrected model, linearised along the path, and the events with readings as noisy as it
    takes them."""
    before, (u, h), e = path[:-1], inputs_of(events[1:]), len(events) - 1
    begin = path[period_begins(events), :_NX]
    step = corrected_steps(before[:, :_NX], begin, u.T, h[0], car, discretisation, weights)
    z, period = _periods(begin, u.T)
    sigma = predictive_sigma(weights, z)[period]
    spread = step.by_error * sigma[:, None] * np.sqrt(h.T / discretisation.step_s)[:, None]
    f, q = np.tile(np.eye(_NB), (e, 1, 1)), np.zeros((e, _NB, _NB))
    f[:, :_NX, :_NX] = step.slope
    q[:, :_NX, :_NX] = spread @ spread.transpose(0, 2, 1)
    drift = np.square(car.tuning.estimation(nominal=False)["drift"])
    q += np.diag(drift) * h.T[..., None]
    after = before.copy()
    after[:, :_NX] = step.ahead

    def go(i: int, x: Floats) -> tuple[Floats, Floats, Floats]:
        return after[i - 1] + (x - before[i - 1]) @ f[i - 1].T, f[i - 1], q[i - 1]

    return go, blurred(events, step.residual, discretisation.step_s)


def _periods(begin: Floats, u: Floats) -> tuple[Floats, Rows]:
    """Features (m, 6) of each period, and the number of the one that each row is of."""
    z, row = np.unique(np.column_stack([begin[:, 3:], u]), axis=0, return_inverse=True)
    return z, row


class Steps(NamedTuple):
    """Steps of the model from n states."""

    ahead: Floats
    """(n, 7)"""
    slope: Floats
    """(n, 7, 7), by the states."""
    by_error: Floats
    """(n, 7, 3), by the errors of a step."""
    residual: Floats
    """(n, 3), of the whole periods."""


def corrected_steps(
    x: Floats,
    begin: Floats,
    u: Floats,
    h: Floats,
    car: Car,
    discretisation: Discretisation,
    weights: Weights | None,
) -> Steps:
    """Steps from ``x`` (n, 7) under ``u`` (n, 2) within ``h`` (n,).

    ``begin`` (n, 7): where the period has begun that h is a part of. Its residual counts in all its
    parts, because it is learned as that of a whole period; it moves with x.
    """
    count, share = len(x), h / discretisation.step_s
    mean, gradient = np.zeros((count, 3)), np.zeros((count, 3, 6))
    if weights is not None:  # the same in all parts of a period
        z, period = _periods(begin, u)
        features = ca.SX.sym("z", 6)
        found = mean_function(weights)(features)
        at = ca.Function("gp", [features], [found, ca.densify(ca.jacobian(found, features))])
        means, gradients = at(z.T)
        mean = np.asarray(means).T[period]
        gradient = share[:, None, None] * _stacked(gradients, len(z))[period]
    one, v, e = ca.SX.sym("x", 7), ca.SX.sym("u", 2), ca.SX.sym("e", 3)
    part = ca.SX.sym("h")
    next_x = discretisation.over(NOMINAL(car))(one, v, e, part)
    results = [next_x, *(ca.densify(ca.jacobian(next_x, by)) for by in (one, e))]
    step = ca.Function("step", [one, v, part, e], results)
    ahead, by_x, by_e = step(x.T, u.T, h[None], share * mean.T)
    slope, by_error = _stacked(by_x, count), _stacked(by_e, count)
    slope[:, :, 3:] += by_error @ gradient[:, :, :4]
    return Steps(np.asarray(ahead).T, slope, by_error, mean)


def _walk() -> ca.Function:
    """(x, u, h) -> x_next and its derivatives; x (12,) ends with the accelerations."""
    x, u, h = ca.SX.sym("x", _NB + 3), ca.SX.sym("u", 2), ca.SX.sym("h")
    velocities = x[3:6] + h * x[_NB:]
    pose = pose_from_velocities(x, velocities, h)
    ahead = ca.vertcat(pose, velocities, x[6] + h * u[1], x[7:])
    return ca.Function("walk", [x, u, h], [ahead, ca.densify(ca.jacobian(ahead, x))])


def _jerk(h: Floats, psi: Floats) -> Floats:
    """Covariances (3, e, 12, 12) that white jerk of density 1 along the car, across it and about
    it adds within h (e,)."""
    part = np.array([[h**5 / 20, h**4 / 8, h**3 / 6], [h**4 / 8, h**3 / 3, h**2 / 2],
                     [h**3 / 6, h**2 / 2, h]]).transpose(2, 0, 1)  # fmt: skip
    c, s, one, none = np.cos(psi), np.sin(psi), np.ones_like(h), np.zeros_like(h)
    q = np.zeros((3, len(h), _NB + 3, _NB + 3))
    for axis, direction in enumerate(((c, s, none), (-s, c, none), (none, none, one))):
        turn = np.zeros((len(h), _NB + 3, 3))
        turn[:, :3, 0] = np.column_stack(direction)
        turn[:, 3 + axis, 1] = turn[:, _NB + axis, 2] = 1
        q[axis] = turn @ part @ turn.transpose(0, 2, 1)
    return q


def _walked(events: Sequence[Event], drive: Drive, car: Car) -> Smoothed:
    """By the random walk of the velocities, with the noise that makes the readings most likely."""
    walk, (u, h) = _walk(), inputs_of(events)
    x0, p0 = np.zeros(_NB + 3), np.zeros((_NB + 3, _NB + 3))
    x0[:_NB], p0[:_NB, :_NB] = started(events[0], drive, car, np.zeros(_NB))
    full = car.friction * GRAVITY_MPS2 * np.array([1, 1, 1 / car.wheelbase_m])
    p0[_NB:, _NB:] = np.diag(full**2)
    gate, middle = car.tuning.estimator.gate, full**2 / _JERK_S

    def stepwise(i: int, x: Floats) -> tuple[Floats, Floats, Floats]:
        ahead, f = walk(x[0], u[:, i], h[0, i])
        q = _jerk(h[0, i : i + 1], x[:, 2])[:, 0]
        return np.asarray(ahead).T, np.asarray(f), np.tensordot(middle, q, 1)

    path = _backward(events, _forward(events, x0[None], p0[None], stepwise, gate)).path
    windows, density = _windows(events), middle[None]
    for factor, count in ((10.0, 5), (3.0, 3), (1.7, 3)):
        steps = factor ** np.arange(-(count // 2), count // 2 + 1)
        grid = np.array(list(product(steps, repeat=3 if count == 3 else 2)))
        grid = grid if count == 3 else grid[:, [0, 0, 1]]
        tried = density * grid
        go = _along(path, walk, u, h, tried)
        p, found = np.tile(p0, (len(tried), 1, 1)), np.zeros(len(tried))
        for first, last in windows:
            x = np.tile(path[first] if first else x0, (len(tried), 1))
            found += _forward(events[first:last], x, p, partial(_later, go, first), gate).likelihood
        density = tried[[int(np.argmax(found))]]
    loose = _along(path, walk, u, h, _LOOSER * density)
    refused = _forward(events, x0[None], p0[None], loose, gate).refused[:, 0]
    kept = [one.without() if wrong else one for one, wrong in zip(events, refused, strict=True)]
    go = _along(path, walk, u, h, density)
    smoothed = _backward(kept, _forward(kept, x0[None], p0[None], go, gate=0))
    return replace(smoothed, refused=refused)


def _windows(events: Sequence[Event]) -> list[tuple[int, int]]:
    """First event, a pose, and end of each window; the first one is where the drive begins."""
    count, periods = _SEARCHED
    poses = [i for i, one in enumerate(events) if one.measured and one.measured.states[:3] == POSE]
    passed = np.cumsum([one.period >= 0 for one in events])
    if passed[-1] <= count * periods:
        return [(0, len(events))]
    begins = np.linspace(0, passed[-1] - periods, count)
    firsts = [min(poses, key=lambda i: abs(passed[i] - begin)) for begin in begins]
    return [(i, int(np.searchsorted(passed, passed[i] + periods, "right"))) for i in firsts]


def _later(go: _Transition, first: int, i: int, x: Floats) -> tuple[Floats, Floats, Floats]:
    """Of events that are counted from another one on."""
    return go(first + i, x)


def _along(path: Floats, walk: ca.Function, u: Floats, h: Floats, density: Floats) -> _Transition:
    """The random walk linearised along the path (e, 12), for densities (b, 3) of the jerk."""
    before, e = path[:-1], len(path) - 1
    ahead, slope = walk(before.T, u[:, 1:], h[:, 1:])
    after, f = np.asarray(ahead).T, _stacked(slope, e)
    q = _jerk(h[0, 1:], before[:, 2])

    def go(i: int, x: Floats) -> tuple[Floats, Floats, Floats]:
        added = np.tensordot(density, q[:, i - 1], 1)
        return after[i - 1] + (x - before[i - 1]) @ f[i - 1].T, f[i - 1], added

    return go
