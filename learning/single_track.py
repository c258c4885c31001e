"""A single-track car of which everything is unknown but its geometry, in windows of a drive.

Many cars and many windows at once: numbers of cars are (p, 1), states (6, p, w). Its tyres have a
stiffness and a peak, its drive the curve of a motor; both are over the load, or over the mass,
which no motion shows. In the plane:

    vx'    = cos(w) a - sin(w) (F_r + F_f cos(delta)) - bend F_f sin(delta) + vy omega
    vy'    = cos(w) (F_r + F_f cos(delta)) + sin(w) a - vx omega,  w = turned vy / vx
    omega' = (lf cos(delta) F_f - lr F_r) / (inertia lf lr)
    a      = (a1 - a2 vx) d - a3 - a4 vx^2
    F_i    = load_i P_i sin(C_i atan(K_i alpha_i / (C_i P_i)))
"""

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from scipy.signal import lfilter

from bayesrace.arrays import AnyArray, Floats, Rows
from bayesrace.learning.instruments import Recorded, Windows
from bayesrace.messages import QUANTITIES
from bayesrace.vehicles import CarParameters
from bayesrace.vehicles.parts import GRAVITY_MPS2

__all__ = ["LONGEST_DELAY_S", "Motion", "Numbers", "SingleTrack", "rates"]

LONGEST_DELAY_S: Final = 0.25
"""Between a command and the car."""

_HEADING, _YAW_RATE, _STEERING = (QUANTITIES.index(one) for one in ("psi", "omega", "delta"))


class Numbers(NamedTuple):
    """Of cars, and of how they are commanded and measured; (p, 1) each, SI units."""

    a1: AnyArray
    a2: AnyArray
    a3: AnyArray
    a4: AnyArray
    """Acceleration per command at standstill, its loss with speed, rolling resistance, drag."""
    delay_s: AnyArray
    lag_s: AnyArray
    """Of the steering behind its delayed command, first order."""
    offset_rad: AnyArray
    gain: AnyArray
    """Steering angle = gain times commanded angle + offset."""
    size: AnyArray
    """Wheelbase over that of the file."""
    front: AnyArray
    rear: AnyArray
    """Cornering stiffness K over the load [1/rad]."""
    front_soft: AnyArray
    rear_soft: AnyArray
    """1/P: load over the largest force."""
    front_shape: AnyArray
    rear_shape: AnyArray
    """C."""
    inertia: AnyArray
    """Over mass lf lr."""
    bend: AnyArray
    """Share of the front tyres' drag."""
    turned: AnyArray
    """Forces act along and across the car (0), or its velocity (1), as CommonRoad has it."""
    height_m: AnyArray
    """Of the centre of gravity: accelerating moves load rearwards."""
    gyro_radps: AnyArray
    angle_rad: AnyArray
    """Offsets of measured yaw rates and steering angles."""


def rates(car: CarParameters, n: Numbers, x: AnyArray, d: AnyArray, delta: AnyArray) -> AnyArray:
    """Of x, y, psi, vx, vy, omega (6, p, w), by the equations above."""
    _, _, psi, vx, vy, omega = x
    lf, lr, g = n.size * car.lf_m, n.size * car.lr_m, GRAVITY_MPS2
    along = (n.a1 - n.a2 * vx) * d - n.a3 - n.a4 * vx * vx
    sin, cos, moved = np.sin(delta), np.cos(delta), n.height_m * along
    aside = vy + lf * omega
    front = -np.arctan((aside * cos - vx * sin) / (vx * cos + aside * sin))
    rear = np.arctan((lr * omega - vy) / vx)

    def force(slip: AnyArray, stiffness: AnyArray, soft: AnyArray, shape: AnyArray) -> AnyArray:
        found: AnyArray = np.sin(shape * np.arctan(stiffness * soft / shape * slip)) / soft
        return found

    length = n.size * car.wheelbase_m
    force_f = (g * lr - moved) / length * force(front, n.front, n.front_soft, n.front_shape)
    force_r = (g * lf + moved) / length * force(rear, n.rear, n.rear_soft, n.rear_shape)
    head, left, found = np.cos(psi), np.sin(psi), np.empty(x.shape)
    found[0] = vx * head - vy * left
    found[1] = vx * left + vy * head
    found[2] = omega
    across, way = force_r + force_f * cos, n.turned * vy / vx
    turned, kept = np.sin(way), np.cos(way)
    found[3] = kept * along - turned * across - n.bend * force_f * sin + vy * omega
    found[4] = kept * across + turned * along - vx * omega
    found[5] = (force_f * lf * cos - force_r * lr) / (n.inertia * lf * lr)
    return found


class Motion(NamedTuple):
    """States at both ends of the parts of each period, with their rates, (periods, 2, 6, p, w)."""

    begin: AnyArray
    begin_rate: AnyArray
    end: AnyArray
    end_rate: AnyArray


@dataclass(frozen=True, eq=False)
class _Angles:
    """What is commanded to the steering (m,), and how far it lags behind (p, m)."""

    commanded: Floats
    rate: Floats
    behind: Floats


class SingleTrack:
    """The commands of some runs, and the cars that they drive through windows."""

    def __init__(self, car: CarParameters, runs: list[Recorded], periods: int) -> None:
        self.car, self.step_s, self._periods = car, runs[0].step_s, periods
        before = int(np.ceil(LONGEST_DELAY_S / self.step_s)) + 1
        rest = np.zeros((before, 2))
        self._u = np.vstack([np.vstack((rest, run.u)) for run in runs])
        self._starts = np.cumsum([before, *(before + len(run.u) for run in runs[:-1])])
        self._commanded = np.concatenate([
            run.angle_rad + np.r_[np.zeros(before), [0], np.cumsum(run.u[:-1, 1]) * self.step_s]
            for run in runs
        ])  # fmt: skip

    def base(self, windows: Windows) -> Rows:
        """Index of the command at the beginning of each window."""
        return self._starts[windows.run] + windows.first

    def commands(self, index: Rows) -> tuple[Floats, Floats]:
        """Drive command and commanded steering angle of some periods."""
        return self._u[index, 0], self._commanded[index]

    def _angles(self, n: Numbers) -> _Angles:
        found: dict[float, Floats] = {}
        rate = self._u[:, 1]
        for lag_s in n.lag_s.ravel().tolist():
            if lag_s not in found:
                keep = np.exp(-self.step_s / lag_s)
                found[lag_s] = np.r_[0, lfilter([(1 - keep) * lag_s], [1, -keep], rate)[:-1]]
        behind = np.array([found[lag_s] for lag_s in n.lag_s.ravel().tolist()])
        return _Angles(self._commanded, rate, behind)

    def _angle(self, n: Numbers, of: _Angles, index: Rows, since_s: AnyArray) -> AnyArray:
        """Steering angle (p, w) so long after the beginning of a command's period."""
        index = np.broadcast_to(index, (len(of.behind), index.shape[-1]))
        index = np.clip(index, 0, len(of.rate) - 1)
        rate = of.rate[index]
        behind = np.take_along_axis(of.behind, index, axis=1)
        lost = rate * n.lag_s + (behind - rate * n.lag_s) * np.exp(-since_s / n.lag_s)
        return n.gain * (of.commanded[index] + rate * since_s - lost) + n.offset_rad

    def drive(self, n: Numbers, base: Rows, x: AnyArray) -> Motion:
        """Windows that begin with the commands ``base`` (w,) in the states x (6, p, w).

        A command acts from ``delay_s`` after its period has begun, so each period has two parts.
        """
        whole, first_s = self._split(n)
        x = np.broadcast_to(x, (6, len(whole), len(base)))
        motion = Motion(*(np.zeros((self._periods, 2, *x.shape)) for _ in range(4)))
        parts = [self._part(n, base, whole, self.step_s - first_s, 0 * first_s)]
        if first_s.any():
            parts.insert(0, self._part(n, base, whole + 1, first_s, self.step_s - first_s))
        for period in range(self._periods):
            for part, (h, commands, angles) in enumerate(parts, 2 - len(parts)):
                d = commands[..., period]
                first, middle, last = (one[..., period] for one in angles)
                k1 = rates(self.car, n, x, d, first)
                motion.begin[period, part], motion.begin_rate[period, part] = x, k1
                k2 = rates(self.car, n, x + h / 2 * k1, d, middle)
                k3 = rates(self.car, n, x + h / 2 * k2, d, middle)
                k4 = rates(self.car, n, x + h * k3, d, last)
                x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
                motion.end[period, part] = x
                motion.end_rate[period, part] = rates(self.car, n, x, d, last)
        return motion

    def _part(
        self, n: Numbers, base: Rows, age: Rows, span_s: AnyArray, since_s: AnyArray
    ) -> tuple[AnyArray, AnyArray, list[AnyArray]]:
        """Of a part of all periods: its length, drive commands (p, w, periods), and steering angles
        at its beginning, middle and end. Commands are so many periods old, and have begun
        ``since_s`` before the part."""
        flat = np.repeat(base, self._periods) + np.tile(np.arange(self._periods), len(base)) - age
        shape = len(age), len(base), self._periods
        behind = self._angles(n)
        angles = [
            self._angle(n, behind, flat, since_s + one * span_s).reshape(shape)
            for one in (0.0, 0.5, 1.0)
        ]
        return span_s, self._u[flat, 0].reshape(shape), angles

    def _split(self, n: Numbers) -> tuple[Rows, AnyArray]:
        """Whole periods of the delay, and what is left of it [s]."""
        whole = np.floor(n.delay_s / self.step_s + 1e-9).astype(np.int64)
        return whole, np.maximum(n.delay_s - whole * self.step_s, 0.0)

    def measured(
        self, n: Numbers, base: Rows, motion: Motion, time_s: AnyArray, of: Rows
    ) -> AnyArray:
        """What instruments would say of the quantities ``of`` (w, r) at these times (p, w, r)."""
        _, first_s = self._split(n)
        period = np.clip(np.floor(time_s / self.step_s), 0, self._periods - 1).astype(np.int64)
        rest_s = time_s - period * self.step_s
        later = (rest_s >= first_s[..., None]) | (first_s[..., None] <= 0)
        begin_s = np.where(later, first_s[..., None], 0.0)
        span_s = np.where(later, self.step_s - first_s[..., None], first_s[..., None])
        cars, rows = np.ogrid[: time_s.shape[0], : time_s.shape[1]]
        place = (
            period,
            later.astype(np.int64),
            np.minimum(of, 5),
            cars[..., None],
            rows[..., None],
        )
        x0, r0, x1, r1 = (one[place] for one in motion)
        s = (rest_s - begin_s) / span_s
        value: AnyArray = x0 + (x1 - x0) * s * s * (3 - 2 * s)
        value += span_s * s * (1 - s) * (r0 * (1 - s) - r1 * s)  # cubic Hermite
        value += np.where(of == _YAW_RATE, n.gyro_radps[..., None], 0.0)
        if (of == _STEERING).any():
            value = np.where(of == _STEERING, self._steering(n, base, time_s), value)
        return value

    def _steering(self, n: Numbers, base: Rows, time_s: AnyArray) -> AnyArray:
        """Measured steering angles (p, w, r)."""
        flat = (time_s - n.delay_s[..., None]).reshape(len(time_s), -1)
        period = np.floor(flat / self.step_s).astype(np.int64)
        index = np.repeat(base, time_s.shape[2]) + period
        angle = self._angle(n, self._angles(n), index, flat - period * self.step_s)
        return angle.reshape(time_s.shape) + n.angle_rad[..., None]
