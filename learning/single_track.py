"""A single-track car of which everything is unknown but its geometry, in windows of a drive.

The equations are those of the simulated cars (:mod:`bayesrace.vehicles.models`), on tyres of one
model or the other. Their stiffness is over the load, and forces of the motor are over the mass, as
no motion shows either.
"""

from functools import lru_cache
from typing import Any, Final, NamedTuple

import casadi as ca
import numpy as np
from scipy.signal import lfilter

from bayesrace.arrays import AnyArray, Floats, Rows
from bayesrace.learning.instruments import Drives, Windows
from bayesrace.messages import QUANTITIES
from bayesrace.vehicles import Car
from bayesrace.vehicles.models import dynamic_with_parameters
from bayesrace.vehicles.parts import GRAVITY_MPS2, DcMotor, LinearTyres, Pacejka, PacejkaTyres

__all__ = ["TYRES", "Cars", "Motion", "Numbers", "SingleTrack"]

_REST_S: Final = 0.5
"""Before each run, in which a lagging steering comes to rest."""
_SWITCH_MPS: Final = 0.2
"""Of linear tyres; windows are faster."""

_ONE: Final = Pacejka(b=1, c=1, d=1)
_ROLLING: Final = {"front_stiffness": 1, "rear_stiffness": 1, "mu": 1, "height_m": 0}
TYRES: Final = (
    PacejkaTyres(model="pacejka", front=_ONE, rear=_ONE),
    LinearTyres(model="linear", **_ROLLING, switch_mps=_SWITCH_MPS),
)
"""Models of tyres that a car may have, with any numbers."""
_MOTOR: Final = DcMotor(model="dc_motor", cm1=1, cm2=0, cr0=0, cr2=0)
"""Of any car: a drive that follows accelerations is one without cm2."""


class Numbers(NamedTuple):
    """Of cars, and of how they are commanded and measured; SI units. By default what does not act.

    Each is a number, or an array with one of each car.
    """

    a1: Any = 1.0
    a2: Any = 0.0
    a3: Any = 0.0
    a4: Any = 0.0
    """Acceleration per command at standstill, its loss with speed, rolling resistance, drag."""
    lag_s: Any = 1e-5
    """Of the steering behind its command, first order."""
    offset_rad: Any = 0.0
    gain: Any = 1.0
    """Steering angle = gain times commanded angle + offset."""
    size: Any = 1.0
    """Wheelbase over that of the file."""
    front: Any = 1.0
    rear: Any = 1.0
    """Cornering stiffness over the load [1/rad]."""
    front_curve: Any = 1.0
    rear_curve: Any = 1.0
    """Of tyres that saturate: the force is stiffness times (slip - curve^2 slip^3 + ...)."""
    front_shape: Any = 1.0
    rear_shape: Any = 1.0
    """Pacejka's C, which what follows depends on."""
    inertia: Any = 1.0
    """Over mass lf lr."""
    height_m: Any = 0.0
    """Of the centre of gravity, on linear tyres."""
    gyro_radps: Any = 0.0
    angle_rad: Any = 0.0
    """Offsets of measured yaw rates and steering angles."""
    delay_s: Any = 0.0
    """From a command to what the first instrument says of it."""

    def equation_numbers(self, like: Car) -> dict[str, Any]:
        """By name, as :attr:`Car.equation_numbers`, with the mass of another car."""
        mass, length = like.mass_kg, self.size * like.wheelbase_m
        lf, lr = self.size * like.lf_m, self.size * like.lr_m
        found = {
            "lf_m": lf, "lr_m": lr, "mass_kg": mass, "inertia_kgm2": self.inertia * mass * lf * lr,
            "cm1": mass * self.a1, "cm2": mass * self.a2, "cr0": mass * self.a3,
            "cr2": mass * self.a4, "front_stiffness": self.front, "rear_stiffness": self.rear,
            "mu": 1.0, "height_m": self.height_m, "switch_mps": _SWITCH_MPS,
        }  # fmt: skip
        for end, share, stiffness, curve, c in (
            ("front", lr, self.front, self.front_curve, self.front_shape),
            ("rear", lf, self.rear, self.rear_curve, self.rear_shape),
        ):
            b = curve / (1 / 3 + c * c / 6) ** 0.5
            d = mass * GRAVITY_MPS2 * share / length * stiffness / (b * c)
            found |= {f"{end}_b": b, f"{end}_c": c, f"{end}_d": d}
        return found


@lru_cache
def _step(like: Car) -> ca.Function:
    """One step of RK4 of cars with such tyres: (x (6,), [h, d, angles at its beginning, middle and
    end], numbers of the equations) -> rates at the beginning, the state at the end, rates there."""
    equations = dynamic_with_parameters(like)
    x, q, p = ca.SX.sym("x", 6), ca.SX.sym("q", 5), ca.SX.sym("p", equations.size1_in(2))

    def rates(x: Any, delta: Any) -> Any:
        return equations(ca.vertcat(x, delta), ca.vertcat(q[1], 0), p)[:6]

    h, first, middle, last = q[0], q[2], q[3], q[4]
    k1 = rates(x, first)
    k2 = rates(x + h / 2 * k1, middle)
    k3 = rates(x + h / 2 * k2, middle)
    after = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + rates(x + h * k3, last))
    return ca.Function("step", [x, q, p], ca.cse([k1, after, rates(after, last)]))


class Cars:
    """Some cars, each at so many places: one step of all of them at once."""

    def __init__(self, like: Car, numbers: Floats, places: int) -> None:
        """``like``: of such tyres and mass; ``numbers`` (p, n): :class:`Numbers` of each car."""
        count = len(numbers)
        like = like.model_copy(update={"inertia_kgm2": 1.0, "drive": _MOTOR})
        by_name = Numbers(*numbers.T).equation_numbers(like)
        columns = [np.broadcast_to(by_name[name], count) for name in like.equation_numbers]
        places_of_one = _step(like).map("places", "serial", places, [2], [])
        self._buffer, self._evaluate = places_of_one.map(count, "serial").buffer()
        self._x, self._q = np.zeros((count, places, 6)), np.zeros((count, places, 5))
        self._out = [np.zeros((count, places, 6)) for _ in range(3)]
        self._numbers = np.column_stack(columns)
        for i, array in enumerate((self._x, self._q, self._numbers)):
            self._buffer.set_arg(i, array.data)  # type: ignore[call-arg]
        for i, array in enumerate(self._out):
            self._buffer.set_res(i, array.data)  # type: ignore[call-arg]

    def step(self, x: AnyArray, h: float, d: AnyArray, angles: AnyArray) -> list[AnyArray]:
        """From the states x (p, w, 6), with ``angles`` (p, w, 3) at beginning, middle and end.

        Rates at the beginning, states and rates at the end, which the next step overwrites.
        """
        self._x[:], self._q[..., 0], self._q[..., 1], self._q[..., 2:] = x, h, d, angles
        self._evaluate()
        return self._out


class Motion(NamedTuple):
    """States (7) at both ends of each period, with their rates, (periods, p, w, 7)."""

    begin: AnyArray
    begin_rate: AnyArray
    end: AnyArray
    end_rate: AnyArray


class SingleTrack:
    """The commands of some runs, and the cars that they drive through windows."""

    def __init__(self, car: Car, drives: Drives, periods: int) -> None:
        self._car, self._step_s, self._periods = car, drives.step_s, periods
        rest = np.zeros((int(np.ceil(_REST_S / self._step_s)), 2))
        runs = [np.vstack((rest, u)) for u in drives.u]
        self._u = np.vstack(runs)
        self._starts = np.cumsum([0, *map(len, runs[:-1])]) + len(rest)
        turned = [np.cumsum(np.r_[0, run[:-1, 1]]) * self._step_s for run in runs]
        self._commanded = np.concatenate(
            [a + b for a, b in zip(drives.angle_rad, turned, strict=True)]
        )

    def commands(self, windows: Windows) -> tuple[Floats, Floats]:
        """Drive commands and commanded steering angles in each period of windows, (w, periods)."""
        index = self._index(windows)
        return self._u[index, 0], self._commanded[index]

    def _index(self, windows: Windows) -> Rows:
        first = self._starts[windows.run] + windows.first
        return np.asarray(first[:, None] + np.arange(self._periods))

    def _angles(self, n: Numbers) -> Floats:
        """Steering angles at beginning, middle and end of each period, (p, m, 3)."""
        rate, lag = self._u[:, 1], n.lag_s
        keep = np.exp(-self._step_s / lag)
        behind = np.array([
            np.r_[0, lfilter([one], [1, -other], rate)[:-1]]
            for one, other in zip(((1 - keep) * lag).ravel(), keep.ravel(), strict=True)
        ])  # fmt: skip
        parts = []
        for s in (0.0, 0.5 * self._step_s, self._step_s):
            lost = rate * lag + (behind - rate * lag) * np.exp(-s / lag)
            parts.append(n.gain * (self._commanded + rate * s - lost) + n.offset_rad)
        return np.stack(parts, axis=-1)

    def drive(self, numbers: Floats, windows: Windows, x: AnyArray) -> Motion:
        """Cars (p, n) that begin windows in the states x (p, w, 6), or (w, 6) all the same."""
        index = self._index(windows)
        angles = self._angles(Numbers(*numbers.T[..., None]))[:, index]  # (p, w, periods, 3)
        h = self._step_s
        cars = Cars(self._car, numbers, len(index))
        motion = Motion(*(np.empty((self._periods, len(numbers), len(index), 7)) for _ in range(4)))
        for period in range(self._periods):
            d = self._u[index[:, period], 0]
            made = x, *cars.step(x, h, d, angles[:, :, period])
            for one, what in zip(motion, made, strict=True):
                one[period, ..., :6] = what
            x = motion.end[period, ..., :6]
        # a parabola through the angles at beginning, middle and end
        by_ends = [[1, 0, 0], [-3, 4, -1], [0, 0, 1], [1, -4, 3]] / np.array([[1], [h], [1], [h]])
        for one, row in zip(motion, by_ends, strict=True):
            one[..., 6] = np.moveaxis(angles @ row, 2, 0)
        return motion

    def measured(self, numbers: Floats, motion: Motion, since_s: AnyArray, of: Rows) -> AnyArray:
        """What instruments would say of the quantities ``of`` (w, r) at times since the beginning
        of the window (p, w, r), which go on at the same rate beyond its ends."""
        period = np.clip(since_s // self._step_s, 0, self._periods - 1).astype(np.int64)
        share = since_s / self._step_s - period
        s = np.clip(share, 0, 1)
        cars, rows = np.ogrid[: since_s.shape[0], : since_s.shape[1]]
        x0, r0, x1, r1 = (one[period, cars[..., None], rows[..., None], of] for one in motion)
        value: AnyArray = x0 + (x1 - x0) * s * s * (3 - 2 * s)  # cubic Hermite
        value += self._step_s * s * (1 - s) * (r0 * (1 - s) - r1 * s)
        value += self._step_s * (share - s) * np.where(s > 0, r1, r0)
        for name, offset in (("omega", "gyro_radps"), ("delta", "angle_rad")):
            column = numbers[:, Numbers._fields.index(offset), None, None]
            value += np.where(of == QUANTITIES.index(name), column, 0.0)
        return value
