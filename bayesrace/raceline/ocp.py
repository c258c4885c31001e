"""Minimum-time lap as a nonlinear programme (CasADi, IPOPT).

Per gate k: lateral offset n, path direction xi against the gate's, squared speed
E = v^2, path curvature kappa, acceleration a along the path. Between two gates the path is a
clothoid (kappa linear in its length l) and E has slope 2 a with a linear in l, so that

    psi' - psi = l (kappa' + kappa) / 2              E' - E = l (a' + a)
    chord direction = (psi + psi') / 2 - l (kappa' - kappa) / 12
    l = chord (1 + (psi' - psi)^2 / 24)              time = 2 l / (v + v')

(' marks the next gate; the chord formulas are exact to fourth order in l). No curvature of the
centreline enters: the path is as smooth as the car can drive even where the centreline isn't.

Limits, with ay = kappa E: friction circle a^2 + ay^2 <= (mu g)^2; drive, straight(v, d_min) <= a
<= straight(v, d_max); steering angle and its rate; track edges less the margin. All of it can be
measured without tyre curves: mass, geometry, drive and one friction number. What the tyres' slip
costs in a bend is left to the controller.
"""

from dataclasses import dataclass, replace
from typing import Any, Final

import casadi as ca
import numpy as np

from bayesrace.arrays import Floats
from bayesrace.raceline.friction import CarLimits, car_limits
from bayesrace.raceline.gates import Gates, even_places, flying_gates, smooth_centreline
from bayesrace.raceline.line import RaceLine, RaceLineError, RaceLineSettings, line_identity
from bayesrace.raceline.nlp import solve_nlp
from bayesrace.tracks import StartLine, Track
from bayesrace.vehicles.parameters import Car

__all__ = ["solve"]

_FOLD: Final = 0.85
"""Largest n * kappa: beyond 1 neighbouring gates cross."""
_XI_MAX_RAD: Final = 1.2
_ROUNDS: Final = 3
_FIRST_ITERATIONS: Final = 100
"""Short tracks need 30. On a long one the guess, at the car's limits, may lead nowhere; then the
second try begins with ..."""
_SLOWER: Final = 0.4
"""... so much of its squared speeds and accelerations."""
_GAUSS_X, _GAUSS_W = np.polynomial.legendre.leggauss(6)


def solve(track: Track, car: Car, settings: RaceLineSettings) -> RaceLine:
    """Racing line of ``car`` on ``track``; raises InputError or RaceLineError.

    The margin holds at the gates; should the path between them come nearer to the real edge than
    allowed, it is optimised again with that much more.
    """
    margin = car.width_m / 2 if settings.margin_m is None else settings.margin_m
    limits, tuning = car_limits(car, settings), car.tuning.raceline
    curve = smooth_centreline(track, tuning)
    places = even_places(curve, track, tuning)
    extra, shares = 0.0, [1.0, _SLOWER]
    for _ in range(_ROUNDS):
        gates = flying_gates(track, curve, places, tuning, margin + extra, _FOLD)
        path = _optimised(track.name, gates, limits, settings, shares)
        line = _sampled(track, path, tuning.spacing_m)
        excess = float(np.max(track.project_path(line.xy_m).off_track_m)) + margin
        if excess <= tuning.tolerance_m:
            return replace(line, made_for=line_identity(track, car, settings))
        extra += excess
    raise RaceLineError(
        f"the racing line for track '{track.name}' passes the margin by {1e3 * excess:.1f} mm "
        "between stations; choose a smaller step_m in the car's [tuning.raceline]"
    )


def _following(x: Any) -> Any:
    """The values at the next gate, around the lap."""
    return ca.vertcat(x[1:], x[0])


def _optimised(
    name: str, gates: Gates, limits: CarLimits, settings: RaceLineSettings, shares: list[float]
) -> "_Clothoids":
    """The fastest path over x = [n, xi, E, kappa, a], each (M, 1).

    ``shares`` of the guess's squared speeds and accelerations are tried in turn; one that fails is
    dropped, but for the last.
    """
    count, tuning = gates.intervals, limits.car.tuning.raceline
    xy, normal, heading = gates.xy_m[:-1], gates.normal[:-1], gates.heading_rad[:-1]
    turn = np.diff(np.append(heading, heading[0]))
    turn[-1] = np.remainder(turn[-1] + np.pi, 2 * np.pi) - np.pi
    step = gates.place_m[-1] / count
    n, xi, energy, kappa, a = symbols = [
        ca.SX.sym(x, count) for x in ("n", "xi", "E", "kappa", "a")
    ]

    x, y = (xy[:, i] + n * normal[:, i] for i in range(2))
    dx, dy = _following(x) - x, _following(y) - y
    turned = _following(xi) - xi + turn
    length = ca.sqrt(dx**2 + dy**2) * (1 + turned**2 / 24)
    chord = heading + xi + turned / 2 - length * (_following(kappa) - kappa) / 12
    v = ca.sqrt(energy)
    time = 2 * length / (_following(v) + v)
    equal = ca.vertcat(
        turned - length * (_following(kappa) + kappa) / 2,
        (ca.cos(chord) * dy - ca.sin(chord) * dx) / step,
        _following(energy) - energy - length * (_following(a) + a),
    )
    rough = tuning.rate_weight * (_following(a) - a) ** 2
    rough += tuning.curvature_weight * (_following(kappa) - kappa) ** 2
    limited = ca.vertcat(*_within(limits, energy, kappa, a, time))
    every = ca.vertcat(*symbols)
    nlp = {"x": every, "f": ca.sum1(time) + ca.sum1(rough) / step, "g": ca.vertcat(equal, limited)}
    least = np.append(np.zeros(equal.numel()), np.full(limited.numel(), -np.inf))

    v_max, most = limits.top_speed(), settings.max_iterations
    bounds, guess = _bounds(gates, limits, v_max), _guess(gates, limits, v_max)
    while True:
        start = guess * np.repeat([1.0, 1.0, shares[0], 1.0, shares[0]], count)
        options = {"tol": 1e-6, "max_iter": min(_FIRST_ITERATIONS, most) if shares[1:] else most}
        found = solve_nlp(nlp, start, bounds, (least, 0.0), options)
        if found.converged or len(shares) == 1:
            break
        shares.pop(0)
    if not found.converged:
        raise RaceLineError(
            f"no racing line for track '{name}': {found.how}; try a smaller margin_m, another "
            "step_m in the car's [tuning.raceline], or more max_iterations"
        )
    offset, direction, squared, curvature, along = found.x.reshape(5, -1)
    return _Clothoids(
        xy_m=xy + offset[:, None] * normal,
        psi_rad=heading + direction,
        kappa_radpm=curvature,
        energy=squared,
        ax_mps2=along,
        step_m=np.asarray(ca.Function("length", [every], [length])(found.x)).ravel(),
        turn_rad=float(turn.sum()),
    )


def _within(limits: CarLimits, energy: Any, kappa: Any, a: Any, time: Any) -> list[Any]:
    """What the car can do, as expressions (M, 1) that must be <= 0: friction and drive at the
    gates, steering rate between them. The steering angle's limit is the bound on kappa."""
    car = limits.car
    v, ay, steering = ca.sqrt(energy), kappa * energy, limits.steering(kappa)
    steered, most = _following(steering) - steering, car.delta_rate_max_radps * time
    return [
        (ay / limits.grip_mps2) ** 2 + (a / limits.grip_mps2) ** 2 - 1,
        a - limits.straight(v.T, car.d_max).T,
        limits.straight(v.T, car.d_min).T - a,
        steered - most,
        -steered - most,
    ]


def _bounds(gates: Gates, limits: CarLimits, v_max: float) -> tuple[Floats, Floats]:
    """Lower and upper bounds of x."""
    tuning = limits.car.tuning.raceline
    kappa, a = limits.kappa_max_radpm, tuning.acceleration_bound_mps2
    slowest, fastest = tuning.speed_min_mps**2, (1.05 * v_max) ** 2
    one = np.ones(gates.intervals)
    low = [gates.n_min_m[:-1], -_XI_MAX_RAD * one, slowest * one, -kappa * one, -a * one]
    high = [gates.n_max_m[:-1], _XI_MAX_RAD * one, fastest * one, kappa * one, a * one]
    return np.concatenate(low), np.concatenate(high)


def _guess(gates: Gates, limits: CarLimits, v_max: float) -> Floats:
    """x on the centreline with the speeds that the car could drive there."""
    count = gates.intervals
    step, kappa_max = gates.place_m[-1] / count, 0.9 * limits.kappa_max_radpm
    kappa = np.clip(gates.kappa_radpm[:-1], -kappa_max, kappa_max)
    v_min = 2 * limits.car.tuning.raceline.speed_min_mps
    v = limits.fastest(kappa, np.full(count, step), v_min, v_max)
    n = np.clip(0.0, gates.n_min_m[:-1], gates.n_max_m[:-1])
    a = (np.roll(v, -1) ** 2 - v**2) / (2 * step)
    return np.concatenate([n, np.zeros(count), v**2, kappa, a])


@dataclass(frozen=True, eq=False)
class _Clothoids:
    """Closed chain of n clothoids with piecewise linear acceleration; arrays (n,)."""

    xy_m: Floats
    psi_rad: Floats
    kappa_radpm: Floats
    energy: Floats
    """Squared speed [m^2/s^2]."""
    ax_mps2: Floats
    step_m: Floats
    """Arc length from each gate to the next."""
    turn_rad: float
    """Direction gained over the lap, +-2 pi."""

    @property
    def length_m(self) -> float:
        """Arc length of the whole path."""
        return float(self.step_m.sum())

    def at(self, s: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """xy (m, 2), psi, kappa, v, ax at arc lengths (m,) from gate 0, up to two laps on."""
        lap, rest = np.divmod(s, self.length_m)
        knots = np.concatenate([[0.0], np.cumsum(self.step_m[:-1])])
        k = np.searchsorted(knots, rest, side="right") - 1
        after = (k + 1) % len(knots)
        length, t = self.step_m[k], rest - knots[k]
        bend = (self.kappa_radpm[after] - self.kappa_radpm[k]) / length
        gain = (self.ax_mps2[after] - self.ax_mps2[k]) / length

        def psi(way: Floats) -> Floats:
            start = (slice(None),) + (None,) * (way.ndim - 1)
            turned = way * (self.kappa_radpm[k][start] + way * bend[start] / 2)
            return np.asarray(self.psi_rad[k][start] + turned)

        inner = psi(t[:, None] * (_GAUSS_X + 1) / 2)
        weight = t[:, None] * _GAUSS_W / 2
        offset = np.column_stack(
            [np.sum(np.cos(inner) * weight, axis=1), np.sum(np.sin(inner) * weight, axis=1)]
        )
        energy = self.energy[k] + t * (2 * self.ax_mps2[k] + t * gain)
        return (
            self.xy_m[k] + offset,
            psi(t) + lap * self.turn_rad,
            self.kappa_radpm[k] + bend * t,
            np.sqrt(energy),
            self.ax_mps2[k] + gain * t,
        )


def _sampled(track: Track, path: _Clothoids, spacing_m: float) -> RaceLine:
    """Evenly spaced points along the path, the first on the track's start line."""
    count = max(24, round(path.length_m / spacing_m))
    s = np.arange(count, dtype=np.float64) * (path.length_m / count)
    xy, psi, kappa, v, a = path.at(s + _start(track, path))
    psi = psi - 2 * np.pi * np.round(psi[0] / (2 * np.pi))
    return RaceLine(track.name, s, xy[:, 0], xy[:, 1], psi, kappa, v, a, path.length_m)


def _start(track: Track, path: _Clothoids) -> float:
    """Arc length, in [0, length), from gate 0 to the start line.

    The gates are normals of a smoothed centreline, so gate 0 and the start line differ slightly.
    """
    line = StartLine(track)
    s = 0.0
    for _ in range(20):
        xy, *_ = path.at(np.array([s % path.length_m]))
        change = line.signed_distance(float(xy[0, 0]), float(xy[0, 1]))
        s -= change
        if abs(change) < 1e-12:
            break
    return s % path.length_m
