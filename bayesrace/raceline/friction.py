"""The friction circle: what a car can do by mass, geometry, drive and one friction number alone.

:class:`CarLimits` bounds the racing line's programme. :func:`speed_profile` gives the fastest
speeds along a given path: the programme's first guess, and the lap of a fixed line.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from bayesrace.arrays import Floats
from bayesrace.raceline.line import RaceLineSettings
from bayesrace.vehicles.models import longitudinal_force, top_command
from bayesrace.vehicles.parameters import CarParameters
from bayesrace.vehicles.parts import GRAVITY_MPS2

__all__ = ["CarLimits", "car_limits", "speed_profile"]

_TABLE = 400


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

    def top_speed(self) -> float:
        """Speed at which full drive only balances the resistances [m/s]."""
        highest_mps = self.car.tuning.raceline.speed_bound_mps
        v = np.linspace(0.0, highest_mps, 3001)
        spent = self.straight_values(v, self.car.d_max) <= 0
        spent[0] = False  # a standing car has no resistance but may have no drive either
        return float(v[int(np.argmax(spent))]) if spent.any() else highest_mps

    def fastest(self, kappa: Floats, step: Floats, v_min: float, v_max: float) -> Floats:
        """:func:`speed_profile` of a closed path within these limits."""
        drive = partial(self.straight_values, d=self.car.d_max)
        brake = partial(self.straight_values, d=self.car.d_min)
        return speed_profile(kappa, step, self.grip_mps2, drive, brake, v_min, v_max)


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


def speed_profile(
    kappa: Floats,
    step: Floats,
    grip_mps2: float,
    drive: Callable[[Floats], Floats],
    brake: Callable[[Floats], Floats],
    v_min: float,
    v_max: float,
    start_mps: float | None = None,
) -> Floats:
    """Speeds (n,) on a closed path of curvature ``kappa`` (n,), ``step`` (n,) to the next point.

    Forward-backward pass within the friction circle ``grip_mps2`` and the acceleration limits
    ``drive(v) >= a >= brake(v)``, starting at the slowest point so that the lap closes. With
    ``start_mps`` the path is open and begins at this speed; the last step is not used.
    """
    v = np.linspace(0.0, v_max, _TABLE)
    per_mps = (_TABLE - 1) / v_max
    highest, lowest = drive(v).tolist(), (-brake(v)).tolist()
    cap = np.clip(grip_mps2 / np.maximum(np.abs(kappa), 1e-6), v_min**2, v_max**2)
    start = int(np.argmin(cap)) if start_mps is None else 0
    energy: list[float] = np.roll(cap, -start).tolist()
    bend: list[float] = np.roll(np.abs(kappa), -start).tolist()
    length: list[float] = np.roll(step, -start).tolist()
    last = len(energy)
    if start_mps is not None:
        energy[0] = start_mps**2
        last -= 1

    def gained(k: int, limit: list[float]) -> float:
        """Most that the squared speed at k changes over a metre, by this table of speeds."""
        place = math.sqrt(energy[k]) * per_mps
        i = min(int(place), _TABLE - 2)
        along = grip_mps2**2 - (bend[k] * energy[k]) ** 2
        push = limit[i] + (place - i) * (limit[i + 1] - limit[i])
        return 2 * max(min(push, math.sqrt(max(along, 0.0))), 0.0)

    for k in range(last):
        following = (k + 1) % len(energy)
        energy[following] = min(energy[following], energy[k] + length[k] * gained(k, highest))
    for k in range(last - 1, -1, -1):
        following = (k + 1) % len(energy)
        energy[k] = min(energy[k], energy[following] + length[k] * gained(following, lowest))
    return np.asarray(np.sqrt(np.roll(energy, start)))
