"""The lap of minimum time through gates, as a nonlinear programme.

Per gate: the offset n on it, heading, vx, vy, yaw rate, steering angle, drive command and steering
rate; per interval its duration h. The car's position is Cartesian, that of the gate at n. Time is
the independent variable of the dynamics: Hermite-Simpson's scheme, inputs linear in time,

    z_m = (z + z') / 2 + h / 8 (f - f')        z' - z = h / 6 (f + 4 f_m + f')

The track's edges are bounds of n. Minimised is the sum of all h, and a little of the inputs'
changes, against chatter, which is no part of the lap time that is reported. Nothing divides by the
distance of gates: where they nearly meet, on the inside of a hairpin, a car passes them at once.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Final

import casadi as ca
import numpy as np

from bayesrace.arrays import Floats
from bayesrace.limit.lap import LimitSettings
from bayesrace.raceline.gates import Gates
from bayesrace.raceline.nlp import Indices, Piece, Solution, minimise
from bayesrace.tracks import Track
from bayesrace.vehicles.models import Model, command_limits
from bayesrace.vehicles.parameters import Car
from bayesrace.vehicles.parts import GRAVITY_MPS2, LinearTyres

__all__ = ["Lap", "Outline", "optimise", "usual_interval"]

_INTERVAL: Final = 2.0
"""Length of an interval of the first mesh, over one of the racing line's."""

_CHATTER: Final = 1e-3
"""Cost of an input's change over its whole range within an interval, over the interval's time."""

_SLIDING_RAD: Final = float(np.pi / 3)
"""Largest angle between a car on linear tyres and its velocity: see models.py."""

_ASIDE_RAD: Final = 1.5
"""Largest angle between car and gate's driving direction."""

_TOLERANCE: Final = 1e-7
"""IPOPT's, of a scaled programme."""

_ALONG: Final = 9
"""Points on each of the outline's long sides, corners included."""


def usual_interval(car: Car) -> tuple[float, float]:
    """Length [m] and duration [s] of the first mesh's intervals."""
    length_m, usable = _INTERVAL * car.tuning.raceline.step_m, car.friction * GRAVITY_MPS2
    return length_m, length_m / (2 * float(np.sqrt(usable * car.wheelbase_m)))


@dataclass(frozen=True, eq=False)
class Lap:
    """A lap through M + 1 gates."""

    gates: Gates
    states: Floats
    """(M + 1, 8): offset, heading, vx, vy, yaw rate, steering angle, drive command, steering rate;
    in SI units."""
    durations_s: Floats
    """(M,) from gate to gate."""

    @property
    def times_s(self) -> Floats:
        """When each gate is passed, (M + 1,), from 0 on."""
        return np.concatenate([[0.0], np.cumsum(self.durations_s)])

    @property
    def time_s(self) -> float:
        """Of the lap."""
        return float(self.durations_s.sum())

    @property
    def xy_m(self) -> Floats:
        """Positions (M + 1, 2)."""
        return self.gates.points(self.states[:, 0])

    def through(self, gates: Gates) -> "Lap":
        """The same lap through other gates, between its own interpolated linearly."""
        own, place = self.gates, gates.place_m
        aside = self.states.copy()
        aside[:, 1] -= own.heading_rad
        states = np.column_stack([np.interp(place, own.place_m, column) for column in aside.T])
        states[:, 1] += gates.heading_rad
        return Lap(gates, states, np.diff(np.interp(place, own.place_m, self.times_s)))


class _Layout:
    """Where the variables of gates and intervals are in the programme's x, and their sizes."""

    def __init__(self, gates: Gates, car: Car) -> None:
        tuned, drive = car.tuning.scale, max(-car.d_min, car.d_max)
        self.scale = np.array([
            car.width_m, 1.0, tuned.speed_mps, tuned.speed_mps, tuned.yaw_rate_radps,
            car.delta_max_rad, drive, car.delta_rate_max_radps,
        ])  # fmt: skip
        _, self.interval_s = usual_interval(car)
        self.gates, intervals = gates, gates.intervals
        count = intervals if gates.closed else intervals + 1
        self.gate: Indices = np.arange(8 * count).reshape(count, 8)
        self.duration: Indices = 8 * count + np.arange(intervals)
        self.ends = np.arange(1, intervals + 1) % count
        """Of the intervals, which begin at the gates 0 to M - 1."""
        turn = gates.heading_rad[-1] - gates.heading_rad[0]
        self.turn_rad = float(turn) if gates.closed else 0.0
        """Heading gained from the last gate's variables to those of the first, which it is."""

    def packed(self, states: Floats, durations_s: Floats) -> Floats:
        """x of values in SI units, (M + 1, 8) and (M,)."""
        gates = states[: len(self.gate)] / self.scale
        return np.concatenate([gates.ravel(), durations_s / self.interval_s])

    def lap(self, x: Floats) -> Lap:
        """The values of x in SI units."""
        states = x[self.gate][np.append(0, self.ends)] * self.scale
        states[-1, 1] += self.turn_rad
        return Lap(self.gates, states, x[self.duration] * self.interval_s)


def _interval(model: Model, layout: _Layout) -> Piece:
    """Dynamics from each gate to the next, and the cost."""
    a, b, h, p = (ca.SX.sym(*of) for of in (("a", 8), ("b", 8), ("h", 1), ("p", 9)))
    one, other, time = a * layout.scale, b * layout.scale, h * layout.interval_s

    def at(y: Any, gate: Any, turn: Any) -> Any:
        """State of the model at a gate x, y, normal."""
        return ca.vertcat(gate[:2] + y[0] * gate[2:], y[1] + turn, y[2:6])

    za, zb = at(one, p[:4], 0), at(other, p[4:8], p[8])
    fa, fb = model.ode(za, one[6:]), model.ode(zb, other[6:])
    middle = (za + zb) / 2 + time / 8 * (fa - fb)
    fm = model.ode(middle, (one[6:] + other[6:]) / 2)
    defect = zb - za - time / 6 * (fa + 4 * fm + fb)
    at_gates = np.column_stack([layout.gates.xy_m, layout.gates.normal])
    turn = np.zeros(layout.gates.intervals)
    turn[-1] = layout.turn_rad
    begins = np.arange(layout.gates.intervals)
    return Piece(
        w=ca.vertcat(a, b, h),
        p=p,
        cost=h * (1 + _CHATTER * ca.sumsqr(b[6:] - a[6:])),
        g=defect / layout.scale[[0, 0, 1, 2, 3, 4, 5]],
        g_min=0.0,
        g_max=0.0,
        index=np.column_stack([layout.gate[begins], layout.gate[layout.ends], layout.duration]),
        numbers=np.column_stack([at_gates[:-1], at_gates[1:], turn]),
    )


def _at_gates(layout: _Layout, within: Callable[[Any], list[Any]]) -> Piece:
    """Expressions of a gate's values in SI units that may not be above 0."""
    y, nothing = ca.SX.sym("y", 8), np.zeros((len(layout.gate), 0))
    return Piece(y, ca.vertcat(*within(y * layout.scale)), -np.inf, 0.0, layout.gate, nothing)


def _car_within(car: Car, layout: _Layout) -> Iterator[Piece]:
    """What the bounds of the inputs and of the steering angle do not say about a car."""
    if car.drive.guarded:
        yield _at_gates(
            layout,
            lambda y: command_limits(car, ca.sqrt(y[2] ** 2 + y[3] ** 2), y[6]),
        )
    if isinstance(car.tyres, LinearTyres):
        most, speed = float(np.tan(_SLIDING_RAD)), layout.scale[2]
        yield _at_gates(
            layout,
            lambda y: [(y[3] - most * y[2]) / speed, (-y[3] - most * y[2]) / speed],
        )


def _bounds(car: Car, layout: _Layout, settings: LimitSettings) -> tuple[Floats, Floats]:
    """Of x."""
    gates, top = layout.gates, car.tuning.raceline.speed_bound_mps
    aside, spin = settings.lateral_speed_mps or top, 20 * layout.scale[4]
    steer, rate = car.delta_max_rad, car.delta_rate_max_radps
    count = (len(gates.place_m), 1)
    low = np.tile([0, 0, 0, -aside, -spin, -steer, car.d_min, -rate], count)
    high = np.tile([0, 0, top, aside, spin, steer, car.d_max, rate], count)
    low[:, 0], high[:, 0] = gates.n_min_m, gates.n_max_m
    low[:, 1], high[:, 1] = gates.heading_rad - _ASIDE_RAD, gates.heading_rad + _ASIDE_RAD
    if settings.standing:
        start = [gates.heading_rad[0], settings.start_speed_mps, 0.0, 0.0, 0.0]
        low[0, 1:6] = high[0, 1:6] = start
    intervals = np.ones(gates.intervals)
    return layout.packed(low, 0 * intervals), layout.packed(high, np.inf * intervals)


class Outline:
    """The car's outline within the track's edges, as constraints at the gates.

    The outline is the car's rectangle with the centre of gravity in its middle. Each of some points
    along it must keep the margin from the edge nearest to it. Which edge that is, and how it bends
    there, is taken from a lap near the one that is sought, so that the lap is optimised again until
    nothing changes. An edge is taken as an arc around the centreline's centre of curvature: the
    offset of a point from an arc of the centreline is exact, and needs no foot point as a variable.
    """

    def __init__(self, track: Track, car: Car, margin_m: float) -> None:
        self._track, self._margin_m = track, margin_m
        self._near_m, self._smoothing_m = car.width_m, car.tuning.raceline.smoothing_m
        ahead = np.linspace(0.5, -0.5, _ALONG) * car.length_m
        aside = np.full(_ALONG, car.width_m / 2)
        self._points = np.concatenate(
            [np.column_stack([ahead, aside]), np.column_stack([ahead, -aside])]
        )
        """On the car, (2 x 9, 2): ahead and to the left of the centre of gravity."""

    def _placed(self, xy: Floats, psi: Floats) -> Floats:
        """The points of cars at positions (N, 2) and headings (N,), shape (18, N, 2)."""
        ahead, aside = self._points[:, 0, None], self._points[:, 1, None]
        cos, sin = np.cos(psi), np.sin(psi)
        return np.stack(
            [xy[:, 0] + ahead * cos - aside * sin, xy[:, 1] + ahead * sin + aside * cos], axis=-1
        )

    def beyond_m(self, xy: Floats, psi: Floats) -> float:
        """How far the cars reach into the margin; <= 0 for none."""
        feet = [self._track.project_path(one) for one in self._placed(xy, psi)]
        return self._margin_m + max(float(one.off_track_m.max()) for one in feet)

    def piece(
        self, gates: Gates, xy: Floats, psi: Floats, variables: Indices, scale: Floats
    ) -> Piece:
        """Constraints on points that are near an edge where the car is at the gates, (M + 1,).

        ``variables``: indices (N, 8) of the gates' in the programme; ``scale``: their sizes (8,).
        """
        count = len(variables)  # without the last gate where it is the first again
        xy, psi = xy[:count], psi[:count]
        rows, numbers, low, high = [], [], [], []
        for point, placed in zip(self._points, self._placed(xy, psi), strict=True):
            on = self._track.project_path(placed)
            near = np.flatnonzero(on.off_track_m > -self._margin_m - self._near_m)
            s = on.s_m[near]
            right, left = self._track.widths(s)
            rows.append(near)
            low.append(self._margin_m - right)
            high.append(left - self._margin_m)
            numbers.append(np.column_stack([
                gates.xy_m[near], gates.normal[near], np.tile(point, (len(near), 1)),
                self._track.position(s), self._track.heading(s), self._curvature(s),
            ]))  # fmt: skip
        w, p = ca.SX.sym("w", 2), ca.SX.sym("p", 10)
        return Piece(
            w=w,
            p=p,
            g=_offset(w * scale[:2], p) / scale[0],
            g_min=np.concatenate(low)[:, None] / scale[0],
            g_max=np.concatenate(high)[:, None] / scale[0],
            index=variables[np.concatenate(rows), :2],
            numbers=np.concatenate(numbers),
        )

    def _curvature(self, s: Floats) -> Floats:
        """Of the centreline, over a short way: its points may be noisy."""
        turned = self._track.heading(s + self._smoothing_m) - self._track.heading(
            s - self._smoothing_m
        )
        return np.asarray(np.angle(np.exp(1j * turned)) / (2 * self._smoothing_m))


def _offset(gate: Any, p: Any) -> Any:
    """Offset of a point on the car from the arc of the centreline that is nearest to it [m].

    ``gate``: offset and heading at a gate; p: the gate's point and normal, the point on the car,
    the arc's point, heading and curvature.
    """
    n, psi = gate[0], gate[1]
    ahead, aside, heading, kappa = p[4], p[5], p[8], p[9]
    cos, sin = ca.cos(psi), ca.sin(psi)
    dx = p[0] + n * p[2] + ahead * cos - aside * sin - p[6]
    dy = p[1] + n * p[3] + ahead * sin + aside * cos - p[7]
    along = dx * ca.cos(heading) + dy * ca.sin(heading)
    away = dy * ca.cos(heading) - dx * ca.sin(heading)
    radius = ca.sqrt((1 - kappa * away) ** 2 + (kappa * along) ** 2)
    return (2 * away - kappa * (along**2 + away**2)) / (1 + radius)


def optimise(
    model: Model,
    guess: Lap,
    settings: LimitSettings,
    outline: Outline | None,
    options: dict[str, Any],
) -> tuple[Lap, Solution]:
    """The fastest lap through the guess's gates, and how the optimisation ended.

    ``outline``: to keep within the track, its edges as they are beside the guess; ``options``: of
    IPOPT.
    """
    layout = _Layout(guess.gates, model.car)
    pieces = [_interval(model, layout), *_car_within(model.car, layout)]
    if outline is not None:
        pieces.append(
            outline.piece(guess.gates, guess.xy_m, guess.states[:, 1], layout.gate, layout.scale)
        )
    bounds = _bounds(model.car, layout, settings)
    start = np.clip(layout.packed(guess.states, guess.durations_s), *bounds)
    ipopt = {"tol": _TOLERANCE, "max_iter": settings.max_iterations, **options}
    solution = minimise(pieces, bounds, start, ipopt)
    return layout.lap(solution.x), solution
