"""Minimum-time lap as a nonlinear programme (CasADi, IPOPT).

Per station k of the frame: lateral offset n, path direction xi against the frame, squared speed
E = v^2, path curvature kappa, acceleration a along the path. Between two stations the path is a
clothoid (kappa linear in its length l) and E has slope 2 a with a linear in l, so that

    psi' - psi = l (kappa' + kappa) / 2              E' - E = l (a' + a)
    chord direction = (psi + psi') / 2 - l (kappa' - kappa) / 12
    l = chord (1 + (psi' - psi)^2 / 24)              time = 2 l / (v + v')

(' marks the next station; the chord formulas are exact to fourth order in l). No curvature of the
frame enters: the path is as smooth as the car can drive even where the centreline isn't.

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
from bayesrace.interrupts import deferred_interrupt
from bayesrace.raceline.frame import Frame, build_frame
from bayesrace.raceline.guess import speed_profile
from bayesrace.raceline.identity import line_identity
from bayesrace.raceline.line import RaceLine
from bayesrace.raceline.sample import Clothoids, sample_line
from bayesrace.raceline.settings import RaceLineError, RaceLineSettings
from bayesrace.tracks import Track
from bayesrace.vehicles.models import longitudinal_force, top_command
from bayesrace.vehicles.parameters import CarParameters
from bayesrace.vehicles.parts import GRAVITY_MPS2

__all__ = ["CarLimits", "car_limits", "optimise", "solve", "top_speed"]

_XI_MAX_RAD: Final = 1.2
_ROUNDS: Final = 3
_FIRST_ITERATIONS: Final = 100
"""Short tracks need 30. On a long one the guess, at the car's limits, may lead nowhere; then the
second try begins with ..."""
_SLOWER: Final = 0.4
"""... so much of its squared speeds and accelerations."""


@dataclass(frozen=True)
class CarLimits:
    """What the car can do, from what one can measure; works on numbers and CasADi expressions."""

    car: CarParameters
    grip_mps2: float
    """Radius of the friction circle."""
    straight: ca.Function
    """(v, d) to the acceleration without cornering [m/s^2]; d as the drive can."""

    def steering(self, kappa: Any) -> Any:
        """Steering angle that a path of this curvature needs [rad].

        Kinematic bicycle: sin(beta) = lr kappa and tan(beta) = lr / L tan(delta).
        """
        slope = self.car.wheelbase_m * kappa / ca.sqrt(1 - (self.car.lr_m * kappa) ** 2)
        return ca.atan(slope)

    @property
    def kappa_max_radpm(self) -> float:
        """Curvature at full lock."""
        slope = self.car.lr_m / self.car.wheelbase_m * np.tan(self.car.delta_max_rad)
        return float(np.sin(np.arctan(slope)) / self.car.lr_m)

    def straight_values(self, v: Floats, d: float) -> Floats:
        """``straight`` at many speeds."""
        return np.asarray(self.straight(v.reshape(1, -1), d)).ravel()


def car_limits(car: CarParameters, settings: RaceLineSettings) -> CarLimits:
    """The limits of a car, friction from the settings or else the car's."""
    v, d = ca.SX.sym("v"), ca.SX.sym("d")
    acting = ca.fmin(d, top_command(car, v, car.d_max))
    straight = longitudinal_force(car, v, acting) / car.mass_kg
    friction = car.friction if settings.friction is None else settings.friction
    return CarLimits(
        car=car,
        grip_mps2=friction * GRAVITY_MPS2,
        straight=ca.Function("straight", [v, d], [straight]),
    )


def solve(track: Track, car: CarParameters, settings: RaceLineSettings) -> RaceLine:
    """Racing line of ``car`` on ``track``; raises InputError or RaceLineError.

    The margin holds at the stations; should the path between them come nearer to the real edge
    than allowed, it is optimised again with that much more.
    """
    margin = car.width_m / 2 if settings.margin_m is None else settings.margin_m
    limits, tuning = car_limits(car, settings), car.tuning.raceline
    extra, shares = 0.0, [1.0, _SLOWER]
    for _ in range(_ROUNDS):
        frame = build_frame(track, tuning, margin + extra)
        path = optimise(track.name, frame, limits, settings, shares)
        line = sample_line(track, path, tuning.spacing_m)
        excess = float(np.max(track.project_path(line.xy_m).off_track_m)) + margin
        if excess <= tuning.tolerance_m:
            return replace(line, made_for=line_identity(track, car, settings))
        extra += excess
    raise RaceLineError(
        f"the racing line for track '{track.name}' passes the margin by {1e3 * excess:.1f} mm "
        "between stations; choose a smaller step_m in the car's [tuning.raceline]"
    )


@dataclass(frozen=True)
class _Problem:
    """The nonlinear programme: minimise f(x) with g_min <= g(x) <= 0 and bounds on x."""

    x: Any
    f: Any
    g: Any
    g_min: Floats
    length: Any
    """Arc lengths between stations, (N, 1)."""


def _following(x: Any) -> Any:
    """The values at the next station, around the lap."""
    return ca.vertcat(x[1:], x[0])


def _problem(frame: Frame, limits: CarLimits) -> _Problem:
    """Objective and constraints over x = [n, xi, E, kappa, a], each (N, 1).

    From the last station of a path that is not closed nothing leads to the first one.
    """
    count = len(frame.kappa_radpm)
    intervals = count if frame.start_mps is None else count - 1
    step = frame.length_m / intervals
    n, xi, energy, kappa, a = (ca.SX.sym(x, count) for x in ("n", "xi", "E", "kappa", "a"))

    x, y = (frame.xy_m[:, i] + n * frame.normal[:, i] for i in range(2))
    dx, dy = _following(x) - x, _following(y) - y
    turn = _following(xi) - xi + frame.turn_rad
    length = ca.sqrt(dx**2 + dy**2) * (1 + turn**2 / 24)
    chord = frame.heading_rad + xi + turn / 2 - length * (_following(kappa) - kappa) / 12
    equal = [
        turn - length * (_following(kappa) + kappa) / 2,
        (ca.cos(chord) * dy - ca.sin(chord) * dx) / step,
        _following(energy) - energy - length * (_following(a) + a),
    ]
    v = ca.sqrt(energy)
    time = 2 * length / (_following(v) + v)
    within = _car_within(limits, energy, kappa, a)
    steered = _steered_within(limits, time, kappa)
    tuning = limits.car.tuning.raceline
    rough = tuning.rate_weight * (_following(a) - a) ** 2
    rough += tuning.curvature_weight * (_following(kappa) - kappa) ** 2
    equal, steered = ([part[:intervals] for part in parts] for parts in (equal, steered))
    limited = ca.vertcat(*within, *steered)
    return _Problem(
        x=ca.vertcat(n, xi, energy, kappa, a),
        f=ca.sum1(time[:intervals]) + ca.sum1(rough[:intervals]) / step,
        g=ca.vertcat(*equal, limited),
        g_min=np.append(np.zeros(len(equal) * intervals), np.full(limited.numel(), -np.inf)),
        length=length,
    )


def _car_within(limits: CarLimits, energy: Any, kappa: Any, a: Any) -> list[Any]:
    """What the car can do at a station, as expressions (N, 1) that must be <= 0.

    The steering angle's limit is the bound on kappa.
    """
    car = limits.car
    v, ay = ca.sqrt(energy), kappa * energy
    return [
        (ay / limits.grip_mps2) ** 2 + (a / limits.grip_mps2) ** 2 - 1,
        a - limits.straight(v.T, car.d_max).T,
        limits.straight(v.T, car.d_min).T - a,
    ]


def _steered_within(limits: CarLimits, time: Any, kappa: Any) -> list[Any]:
    """The limit of the steering rate between stations, as expressions (N, 1) that must be <= 0."""
    steering = limits.steering(kappa)
    steered = _following(steering) - steering
    most = limits.car.delta_rate_max_radps * time
    return [steered - most, -steered - most]


def _bounds(frame: Frame, limits: CarLimits, v_max: float) -> tuple[Floats, Floats]:
    """Lower and upper bounds of x."""
    one = np.ones(len(frame.kappa_radpm))
    kappa, tuning = limits.kappa_max_radpm, limits.car.tuning.raceline
    v_min, a_any = tuning.speed_min_mps, tuning.acceleration_bound_mps2
    slowest, fastest = v_min**2 * one, (1.05 * v_max) ** 2 * one
    if frame.start_mps is not None:
        slowest[0] = fastest[0] = frame.start_mps**2
    low = [frame.n_min_m, -_XI_MAX_RAD * one, slowest, -kappa * one, -a_any * one]
    high = [frame.n_max_m, _XI_MAX_RAD * one, fastest, kappa * one, a_any * one]
    return np.concatenate(low), np.concatenate(high)


def _guess(frame: Frame, limits: CarLimits, v_max: float) -> Floats:
    """x on the frame's own line with the speeds that the car could drive there."""
    car = limits.car
    count = len(frame.kappa_radpm)
    step = frame.length_m / count
    kappa_max = 0.9 * limits.kappa_max_radpm
    kappa = np.clip(frame.kappa_radpm, -kappa_max, kappa_max)
    v = speed_profile(
        kappa,
        np.full(count, step),
        limits.grip_mps2,
        lambda v: limits.straight_values(v, car.d_max),
        lambda v: limits.straight_values(v, car.d_min),
        2 * car.tuning.raceline.speed_min_mps,
        v_max,
        frame.start_mps,
    )
    n = np.clip(0.0, frame.n_min_m, frame.n_max_m)
    a = (np.roll(v, -1) ** 2 - v**2) / (2 * step)
    if frame.start_mps is not None:
        a[-1] = 0.0
    return np.concatenate([n, np.zeros(count), v**2, kappa, a])


def optimise(
    name: str, frame: Frame, limits: CarLimits, settings: RaceLineSettings, shares: list[float]
) -> Clothoids:
    """The fastest path. ``shares`` of the guess's squared speeds and accelerations are tried in
    turn; one that fails is dropped, but for the last."""
    problem = _problem(frame, limits)
    v_max = top_speed(limits)
    bounds, guess = _bounds(frame, limits, v_max), _guess(frame, limits, v_max)
    while True:
        start = guess * np.repeat([1.0, 1.0, shares[0], 1.0, shares[0]], len(guess) // 5)
        most = settings.max_iterations
        iterations = min(_FIRST_ITERATIONS, most) if len(shares) > 1 else most
        result, stats = _solved(problem, bounds, start, iterations)
        if stats["success"] or len(shares) == 1:
            break
        shares.pop(0)
    if not stats["success"]:
        raise RaceLineError(
            f"no racing line for track '{name}': IPOPT ended with {stats['return_status']} after "
            f"{stats['iter_count']} iterations; try a smaller margin_m, another step_m in "
            "the car's [tuning.raceline], or more max_iterations"
        )
    n, xi, energy, kappa, a = np.asarray(result["x"]).reshape(5, -1)
    lengths = ca.Function("length", [problem.x], [problem.length])(result["x"])
    return Clothoids(
        xy_m=frame.xy_m + n[:, None] * frame.normal,
        psi_rad=frame.heading_rad + xi,
        kappa_radpm=kappa,
        energy=energy,
        ax_mps2=a,
        step_m=np.asarray(lengths).ravel(),
        turn_rad=float(frame.turn_rad.sum()),
    )


def _solved(
    problem: _Problem, bounds: tuple[Floats, Floats], start: Floats, iterations: int
) -> tuple[Any, dict[str, Any]]:
    """IPOPT's result and statistics, whether it has converged or not."""
    options: dict[str, Any] = {
        "print_time": False,
        "error_on_fail": False,
        "ipopt": {
            "print_level": 0,
            "sb": "yes",
            "tol": 1e-6,
            "acceptable_iter": 0,
            "max_iter": iterations,
        },
    }
    nlp = {"x": problem.x, "f": problem.f, "g": problem.g}
    solver = ca.nlpsol("raceline", "ipopt", nlp, options)
    with deferred_interrupt():
        result = solver(x0=start, lbx=bounds[0], ubx=bounds[1], lbg=problem.g_min, ubg=0.0)
    return result, solver.stats()


def top_speed(limits: CarLimits) -> float:
    """Speed at which full drive only balances the resistances [m/s]."""
    highest_mps = limits.car.tuning.raceline.speed_bound_mps
    v = np.linspace(0.0, highest_mps, 3001)
    spent = limits.straight_values(v, limits.car.d_max) <= 0
    spent[0] = False  # a standing car has no resistance but may have no drive either
    return float(v[int(np.argmax(spent))]) if spent.any() else highest_mps
