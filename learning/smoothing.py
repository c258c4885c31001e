"""States of a drive from what instruments have read in it, all of them used for every state.

A controller's estimate at a moment uses what was read before; learning can use what was read after
it as well. A forward pass is an extended Kalman filter as that of controller/native/br_estimator.c
(nine numbers: the states, and the offsets of the measured yaw rate and steering angle; the residual
of a period's beginning in all its parts), in order of measurement, so that no reading is late.
Other than that one it begins vaguely, at speed, never widens its covariance, and judges no
instrument; nor does it keep the car to its limits. A backward pass, Rauch, Tung and Striebel's,
takes in what came later (:mod:`bayesrace.learning.kalman`).

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
from dataclasses import replace
from itertools import product
from typing import Any, Final, NamedTuple

import casadi as ca
import numpy as np

from bayesrace.arrays import Floats, Rows
from bayesrace.gp.expression import mean_function
from bayesrace.gp.weights import Weights
from bayesrace.integrators import Discretisation, pose_from_velocities
from bayesrace.learning.drives import POSE, Drive, Event
from bayesrace.learning.kalman import Smoothed, Transition, backward, forward
from bayesrace.learning.validation import NOMINAL, predictive_sigma
from bayesrace.vehicles.parameters import Car
from bayesrace.vehicles.parts import GRAVITY_MPS2

__all__ = [
    "Steps", "blurred", "corrected_steps", "inputs_of", "period_begins", "smooth", "started",
]  # fmt: skip

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
_LINEARISED: Final = 2
"""Passes along the result of the one before."""


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
                found = backward(read, forward(read, x0[None], p0[None], model, gate=0))
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
    """Inputs (e, 2) and durations (e,)."""
    return np.array([one.u for one in events]), np.array([one.duration_s for one in events])


class _Batched:
    """Evaluates a CasADi function for ``count`` rows at once, in buffers of its own: the
    conversions of an ordinary call take longer than the function."""

    def __init__(self, name: str, given: Sequence[Any], results: Sequence[Any], count: int) -> None:
        """Of the expressions ``results`` in the columns ``given``."""
        function = ca.Function(name, given, [ca.densify(one) for one in results])
        every: Any = function.map(count, "serial")
        self._buffer, self._evaluate = every.buffer()
        self._given = [np.zeros((count, one.size1())) for one in given]
        # CasADi writes a matrix column by column.
        self._results = [np.zeros((count, *one.size()[::-1])) for one in results]
        for i, array in enumerate(self._given):
            self._buffer.set_arg(i, array.data)
        for i, array in enumerate(self._results):
            self._buffer.set_res(i, array.data)

    def __call__(self, *given: Floats) -> list[Floats]:
        """A matrix (count, n, m) of each result; they hold until the next call."""
        for own, one in zip(self._given, given, strict=True):
            own[:] = one
        self._evaluate()
        return [one.transpose(0, 2, 1) for one in self._results]


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
) -> tuple[Transition, list[Event]]:
    """The corrected model, linearised along the path, and the events with readings as noisy as it
    takes them."""
    before, (u, h), e = path[:-1], inputs_of(events[1:]), len(events) - 1
    begin = path[period_begins(events), :_NX]
    step = corrected_steps(before[:, :_NX], begin, u, h, car, discretisation, weights)
    z, period = _periods(begin, u)
    sigma = predictive_sigma(weights, z)[period]
    spread = step.by_error * (sigma * np.sqrt(h / discretisation.step_s)[:, None])[:, None]
    f, q = np.tile(np.eye(_NB), (e, 1, 1)), np.zeros((e, _NB, _NB))
    f[:, :_NX, :_NX] = step.slope
    q[:, :_NX, :_NX] = spread @ spread.transpose(0, 2, 1)
    drift = np.square(car.tuning.estimation(nominal=False)["drift"])
    q += np.diag(drift) * h[:, None, None]
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
        gp = _Batched("gp", [features], [found, ca.jacobian(found, features)], len(z))
        means, gradients = gp(z)
        mean = means[period, :, 0]
        gradient = share[:, None, None] * gradients[period]
    one, v, e = ca.SX.sym("x", 7), ca.SX.sym("u", 2), ca.SX.sym("e", 3)
    part = ca.SX.sym("h")
    next_x = discretisation.over(NOMINAL(car))(one, v, e, part)
    results = [next_x, ca.jacobian(next_x, one), ca.jacobian(next_x, e)]
    step = _Batched("step", [one, v, part, e], results, count)
    ahead, slope, by_error = step(x, u, h[:, None], share[:, None] * mean)
    slope[:, :, 3:] += by_error @ gradient[:, :, :4]
    return Steps(ahead[..., 0], slope, by_error, mean)


def _walk(count: int) -> _Batched:
    """(x, u, h) -> x_next, its derivatives, and the covariances (36, 12) that white jerk of density
    1 along the car, across it and about it adds, one below the other; x (12,) ends with the
    accelerations."""
    x, u, h = ca.SX.sym("x", _NB + 3), ca.SX.sym("u", 2), ca.SX.sym("h")
    velocities = x[3:6] + h * x[_NB:]
    pose = pose_from_velocities(x, velocities, h)
    after = ca.vertcat(pose, velocities, x[6] + h * u[1], x[7:])
    results = [after, ca.jacobian(after, x), ca.vertcat(*_jerk(h, x[2]))]
    return _Batched("walk", [x, u, h], results, count)


def _jerk(h: Any, psi: Any) -> list[Any]:
    """Covariances (12, 12) that white jerk of density 1 along each axis adds within h."""
    part = ca.blockcat([
        [h**5 / 20, h**4 / 8, h**3 / 6], [h**4 / 8, h**3 / 3, h**2 / 2], [h**3 / 6, h**2 / 2, h],
    ])  # fmt: skip
    c, s, found = ca.cos(psi), ca.sin(psi), []
    for axis, direction in enumerate(((c, s, 0), (-s, c, 0), (0, 0, 1))):
        turn = ca.SX(_NB + 3, 3)
        turn[:3, 0] = ca.vertcat(*direction)
        turn[3 + axis, 1] = turn[_NB + axis, 2] = 1
        found.append(turn @ part @ turn.T)
    return found


def _walked(events: Sequence[Event], drive: Drive, car: Car) -> Smoothed:
    """By the random walk of the velocities, with the noise that makes the readings most likely."""
    x0, p0 = np.zeros((1, _NB + 3)), np.zeros((1, _NB + 3, _NB + 3))
    x0[0, :_NB], p0[0, :_NB, :_NB] = started(events[0], drive, car, np.zeros(_NB))
    full = car.friction * GRAVITY_MPS2 * np.array([1, 1, 1 / car.wheelbase_m])
    p0[0, _NB:, _NB:] = np.diag(full**2)
    gate, density = car.tuning.estimator.gate, full[None] ** 2 / _JERK_S
    path = backward(events, forward(events, x0, p0, _stepwise(events, density), gate)).path
    along, windows = _along(events, path), _windows(events)
    for factor, count in ((10.0, 5), (3.0, 3), (1.7, 3)):
        steps = factor ** np.arange(-(count // 2), count // 2 + 1)
        grid = np.array(list(product(steps, repeat=3 if count == 3 else 2)))
        tried = density * (grid if count == 3 else grid[:, [0, 0, 1]])
        p, found = np.tile(p0, (len(tried), 1, 1)), np.zeros(len(tried))
        for first, last in windows:
            x = np.tile(path[first] if first else x0[0], (len(tried), 1))
            found += forward(events[first:last], x, p, along(tried, first), gate).likelihood
        density = tried[[int(np.argmax(np.nan_to_num(found, nan=-np.inf)))]]
    refused = forward(events, x0, p0, along(_LOOSER * density), gate).refused[:, 0]
    kept = [one.without() if wrong else one for one, wrong in zip(events, refused, strict=True)]
    smoothed = backward(kept, forward(kept, x0, p0, along(density), gate=0))
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


def _along(events: Sequence[Event], path: Floats) -> Callable[..., Transition]:
    """The random walk linearised along the path (e, 12), of densities (b, 3) of the jerk, for the
    events from a ``first`` one on."""
    before, (u, h), m = path[:-1], inputs_of(events[1:]), path.shape[1]
    after, f, jerk = _walk(len(before))(before, u, h[:, None])
    q = jerk.reshape(-1, 3, m * m)

    def of(density: Floats, first: int = 0) -> Transition:
        def go(i: int, x: Floats) -> tuple[Floats, Floats, Floats]:
            k = first + i - 1
            added = (density @ q[k]).reshape(-1, m, m)
            return after[k, :, 0] + (x - before[k]) @ f[k].T, f[k], added

        return go

    return of


def _stepwise(events: Sequence[Event], density: Floats) -> Transition:
    """The random walk linearised at the current estimate, for one density (1, 3) of the jerk."""
    (u, h), walk, m = inputs_of(events[1:]), _walk(1), _NB + 3

    def go(i: int, x: Floats) -> tuple[Floats, Floats, Floats]:
        after, f, jerk = walk(x, u[i - 1], h[i - 1])
        return after[..., 0].copy(), f[0], (density @ jerk.reshape(3, m * m)).reshape(1, m, m)

    return go
