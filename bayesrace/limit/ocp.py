"""The lap of minimum time through gates, as a nonlinear programme.

Per gate: the offset n on it, heading, vx, vy, yaw rate, steering angle, drive command and steering
rate; per interval its duration h. The car's position is Cartesian, that of the gate at n. Time is
the independent variable of the dynamics: Hermite-Simpson's scheme, inputs linear in time,

    z_m = (z + z') / 2 + h / 8 (f - f')        z' - z = h / 6 (f + 4 f_m + f')

The track's edges are bounds of n. Minimised is the sum of all h, and a little of the inputs'
changes, against chatter, which is no part of the lap time that is reported.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final

import casadi as ca
import numpy as np

from bayesrace.arrays import Floats
from bayesrace.limit.gates import Gates
from bayesrace.limit.outline import Outline
from bayesrace.limit.programme import Indices, Piece, Solution, minimise
from bayesrace.vehicles.models import Model, command_limits
from bayesrace.vehicles.parameters import CarParameters
from bayesrace.vehicles.parts import LinearTyres

__all__ = ["Lap", "optimise"]

_CHATTER: Final = 1e-3
"""Cost of an input's change over its whole range within an interval, over the interval's time."""

_SLIDING_RAD: Final = float(np.pi / 3)
"""Largest angle between a car on linear tyres and its velocity: see models.py."""

_ASIDE_RAD: Final = 1.5
"""Largest angle between car and gate's driving direction."""


@dataclass(frozen=True, eq=False)
class Lap:
    """A lap through M + 1 gates."""

    states: Floats
    """(M + 1, 8): offset, heading, vx, vy, yaw rate, steering angle, drive command, steering rate;
    in SI units."""
    durations_s: Floats
    """(M,) from gate to gate."""

    @property
    def time_s(self) -> float:
        """Of the lap."""
        return float(self.durations_s.sum())


class _Layout:
    """Where the variables of gates and intervals are in the programme's x, and their sizes."""

    def __init__(self, gates: Gates, car: CarParameters, interval_s: float) -> None:
        tuned, drive = car.tuning.scale, max(-car.d_min, car.d_max)
        self.scale = np.array([
            car.width_m, 1.0, tuned.speed_mps, tuned.speed_mps, tuned.yaw_rate_radps,
            car.delta_max_rad, drive, car.delta_rate_max_radps,
        ])  # fmt: skip
        self.interval_s = interval_s
        intervals = gates.intervals
        count = intervals if gates.closed else intervals + 1
        self.gate: Indices = np.arange(8 * count).reshape(count, 8)
        self.duration: Indices = 8 * count + np.arange(intervals)
        self.begin = np.arange(intervals)
        self.end = (self.begin + 1) % count
        turn = gates.heading_rad[-1] - gates.heading_rad[0]
        self.turn_rad = float(turn) if gates.closed else 0.0
        """Heading gained from the last gate's variables to those of the first, which it is."""

    def packed(self, states: Floats, durations_s: Floats) -> Floats:
        """x of values in SI units, (M + 1, 8) and (M,)."""
        gates = states[: len(self.gate)] / self.scale
        return np.concatenate([gates.ravel(), durations_s / self.interval_s])

    def lap(self, x: Floats) -> Lap:
        """The values of x in SI units."""
        states = x[self.gate][np.append(self.begin, self.end[-1])] * self.scale
        states[-1, 1] += self.turn_rad
        return Lap(states, x[self.duration] * self.interval_s)


def _interval(model: Model, gates: Gates, layout: _Layout) -> Piece:
    """Dynamics from each gate to the next, and the cost."""
    a, b, h = ca.SX.sym("a", 8), ca.SX.sym("b", 8), ca.SX.sym("h")
    p = ca.SX.sym("p", 9)
    one, other = a * layout.scale, b * layout.scale
    time = h * layout.interval_s

    def at(y: Any, gate: Any, turn: Any) -> Any:
        """State of the model at a gate x, y, normal."""
        return ca.vertcat(gate[:2] + y[0] * gate[2:], y[1] + turn, y[2:6])

    za, zb = at(one, p[:4], 0), at(other, p[4:8], p[8])
    fa, fb = model.ode(za, one[6:]), model.ode(zb, other[6:])
    middle = (za + zb) / 2 + time / 8 * (fa - fb)
    fm = model.ode(middle, (one[6:] + other[6:]) / 2)
    defect = zb - za - time / 6 * (fa + 4 * fm + fb)
    size = np.concatenate([layout.scale[[0, 0]], layout.scale[1:6]])
    at_gates = np.column_stack([gates.xy_m, gates.normal])
    turn = np.zeros(gates.intervals)
    turn[-1] = layout.turn_rad
    return Piece(
        w=ca.vertcat(a, b, h),
        p=p,
        cost=h * (1 + _CHATTER * ca.sumsqr(b[6:] - a[6:])),
        g=defect / size,
        g_min=np.zeros(7),
        g_max=np.zeros(7),
        index=np.column_stack(
            [layout.gate[layout.begin], layout.gate[layout.end], layout.duration]
        ),
        numbers=np.column_stack([at_gates[:-1], at_gates[1:], turn]),
    )


def _at_gates(layout: _Layout, within: Callable[[Any], list[Any]]) -> Piece:
    """Expressions of a gate's values in SI units that may not be above 0."""
    y = ca.SX.sym("y", 8)
    g = ca.vertcat(*within(y * layout.scale))
    return Piece(
        w=y,
        p=ca.SX.sym("p", 0),
        cost=ca.SX(0),
        g=g,
        g_min=np.full(g.numel(), -np.inf),
        g_max=np.zeros(g.numel()),
        index=layout.gate,
        numbers=np.zeros((len(layout.gate), 0)),
    )


def _car_within(car: CarParameters, layout: _Layout) -> Iterator[Piece]:
    """What the bounds of the inputs and of the steering angle do not say about a car."""
    if car.drive.guarded:
        yield _at_gates(
            layout,
            lambda y: command_limits(car, ca.sqrt(y[2] ** 2 + y[3] ** 2), y[6]),
        )
    if isinstance(car.tyres, LinearTyres):
        most = float(np.tan(_SLIDING_RAD))
        speed = layout.scale[2]
        yield _at_gates(
            layout,
            lambda y: [(y[3] - most * y[2]) / speed, (-y[3] - most * y[2]) / speed],
        )


def _bounds(
    car: CarParameters,
    gates: Gates,
    layout: _Layout,
    start_mps: float | None,
    lateral_mps: float | None,
) -> tuple[Floats, Floats]:
    """Of x."""
    count, top = len(gates.place_m), car.tuning.raceline.speed_bound_mps
    aside = top if lateral_mps is None else lateral_mps
    spin = 20 * layout.scale[4]
    low = np.tile([0, 0, 0, -aside, -spin, -car.delta_max_rad, car.d_min, 0.0], (count, 1))
    high = np.tile([0, 0, top, aside, spin, car.delta_max_rad, car.d_max, 0.0], (count, 1))
    low[:, 7], high[:, 7] = -car.delta_rate_max_radps, car.delta_rate_max_radps
    low[:, 0], high[:, 0] = gates.n_min_m, gates.n_max_m
    low[:, 1], high[:, 1] = gates.heading_rad - _ASIDE_RAD, gates.heading_rad + _ASIDE_RAD
    if start_mps is not None:
        low[0, 1:6] = high[0, 1:6] = [gates.heading_rad[0], start_mps, 0.0, 0.0, 0.0]
    shortest, longest = np.full(gates.intervals, 0.0), np.full(gates.intervals, np.inf)
    return layout.packed(low, shortest), layout.packed(high, longest)


def optimise(
    model: Model,
    gates: Gates,
    guess: Lap,
    *,
    interval_s: float,
    start_mps: float | None,
    lateral_mps: float | None,
    outline: Outline | None,
    options: dict[str, Any],
) -> tuple[Lap, Solution]:
    """The fastest lap, and how the optimisation ended.

    ``interval_s``: usual duration of an interval; ``start_mps``: speed at the first gate of a lap
    from the start pose, None for a flying one; ``lateral_mps``: largest |vy|, None for any;
    ``outline``: to keep within the track, its edges as they are beside the guess; ``options``: of
    IPOPT.
    """
    layout = _Layout(gates, model.car, interval_s)
    pieces = [_interval(model, gates, layout), *_car_within(model.car, layout)]
    if outline is not None:
        pieces.append(outline.piece(gates, guess.states, layout.gate, layout.scale))
    bounds = _bounds(model.car, gates, layout, start_mps, lateral_mps)
    start = layout.packed(guess.states, guess.durations_s)
    solution = minimise(pieces, *bounds, np.clip(start, *bounds), options)
    return layout.lap(solution.x), solution
