"""The car's quantities as an FMU's variables, by arithmetic alone.

Every value that passes is affine, ``scale * value + offset``: a row (:class:`Link`) for each
variable of the FMU. A few rules derive the state from what the rows read: the heading is continued
by whole turns; body velocities follow from world velocities or from speed and slip angle, the yaw
rate from the heading, the steering angle from the rate.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.errors import InputError

__all__ = ["COMMANDS", "QUANTITIES", "STATES", "VELOCITIES", "Link", "Value", "Wiring"]

Value = float | int | bool | str

TURN: Final = 2.0 * math.pi

POSE_TOLERANCE: Final = 1e-3
"""Metres or radians that an FMU's first pose may be off the asked one: single precision far from
the origin is within it, a start value that the FMU ignored is not."""

STATES: Final = {
    "x": "m", "y": "m", "psi": "rad", "vx": "m/s", "vy": "m/s", "omega": "rad/s", "delta": "rad",
}  # fmt: skip
"""The car's state in order, with units."""

COMMANDS: Final = {
    "d": "1", "delta_rate": "rad/s", "delta": "rad", "throttle": "1", "brake": "1",
}  # fmt: skip
"""What can drive an FMU's input, with units: the drive command or its positive and (turned
positive) negative part, in the unit of the car's drive, here that of a duty cycle; and the steering
rate or the steering angle at the end of the hold."""

QUANTITIES: Final = STATES | {
    "world_vx": "m/s", "world_vy": "m/s", "speed": "m/s", "slip": "rad",
}  # fmt: skip
"""What an FMU's outputs can mean and what can set its start values, with units; world_* are
velocities along the axes of x and y."""

VELOCITIES: Final = ({"world_vx", "world_vy"}, {"speed", "slip"}, {"speed"})
"""What an FMU's outputs can give in place of vx and vy."""


@dataclass(frozen=True, slots=True)
class Link:
    """One variable of the FMU and the quantity of ours beside it.

    An output's gives ours, ``scale * theirs + offset``; an input's or a start value's gives theirs,
    ``scale * ours + offset``, which the FMU allows from ``lowest`` to ``highest``.
    """

    variable: str
    quantity: str
    scale: float = 1.0
    offset: float = 0.0
    lowest: float = -math.inf
    highest: float = math.inf

    def start(self, ours: Mapping[str, float]) -> float:
        """The FMU's start value; a heading is turned into the declared range.

        InputError outside the range.
        """
        value = self.scale * ours[self.quantity] + self.offset
        if not self.lowest <= value <= self.highest and self.quantity == "psi":
            turn = abs(self.scale) * TURN
            anchor = self.lowest if math.isfinite(self.lowest) else self.highest - turn
            value = anchor + (value - anchor) % turn
        if self.lowest <= value <= self.highest:
            return value
        raise InputError(
            f"the FMU cannot start with {self.variable} = {value:g} (our {self.quantity} = "
            f"{ours[self.quantity]:g}): it allows {self.lowest:g} to {self.highest:g}; start "
            "elsewhere, or correct unit, sign and offset in the map's [start]"
        )


class Wiring:
    """The car's commands as an FMU's inputs, and the FMU's outputs as the car's state.

    Over a run it keeps what is integrated or continued: call :meth:`start_values` and
    :meth:`begin`, then :meth:`to_inputs` and :meth:`state` in turn.
    """

    def __init__(
        self,
        inputs: Sequence[Link],
        outputs: Sequence[Link],
        starts: Sequence[Link] = (),
        fixed: Mapping[str, Value] | None = None,
        placed: bool = False,
    ) -> None:
        """``inputs`` link to :data:`COMMANDS`, ``outputs`` and ``starts`` to :data:`QUANTITIES`;
        ``fixed`` are parameters and inputs that are set once, before initialisation; ``placed``:
        the FMU has a start of its own, which becomes the asked pose.
        """
        self.inputs = tuple(link.variable for link in inputs)
        """The FMU's variables in the order in which values are passed; so ``outputs``."""
        self.outputs = tuple(link.variable for link in outputs)
        self.follows_angle = any(link.quantity == "delta" for link in inputs)
        """Whether an input changes during a hold because the steering angle does."""
        self._inputs, self._outputs, self._starts = inputs, outputs, starts
        self._fixed, self._placed = dict(fixed or {}), placed
        self._psi, self._delta = 0.0, 0.0  # continued in the FMU's world, integrated
        self._turn, self._origin = 0.0, 0j  # of the FMU's world in ours

    def start_values(self, x0: Sequence[float] | Floats) -> dict[str, Value]:
        """Values to set before initialisation so that the car starts in ``x0``, (7,).

        Parameters, constant inputs, start values, and the inputs of a car whose motor is off and
        whose steering holds still. InputError for a start that the FMU's ranges do not allow.
        """
        ours = dict(zip(STATES, map(float, x0), strict=True))
        velocity = complex(ours["vx"], ours["vy"])
        world = velocity * _direction(ours["psi"])
        ours |= {"speed": abs(velocity), "slip": math.atan2(velocity.imag, velocity.real)}
        ours |= {"world_vx": world.real, "world_vy": world.imag}
        still = dict(zip(self.inputs, self.to_inputs((0.0, 0.0), ours["delta"]), strict=True))
        return self._fixed | still | {one.variable: one.start(ours) for one in self._starts}

    def to_inputs(
        self, u: Sequence[float], delta_rad: float, times_s: Sequence[float] = (0.0,)
    ) -> list[float]:
        """The FMU's inputs, a row for each of the times since ``u`` = (d, delta_rate) began to act.

        ``u`` has passed the guard; ``delta_rad`` is the steering angle when it begins. Values
        outside the range that the FMU declares are clipped, as an actuator stays at its stop.
        """
        d, rate = float(u[0]), float(u[1])
        ours = {"d": d, "delta_rate": rate, "throttle": max(d, 0.0), "brake": max(-d, 0.0)}
        rows: list[float] = []
        for time_s in times_s:
            ours["delta"] = delta_rad + time_s * rate
            for one in self._inputs:
                value = one.scale * ours[one.quantity] + one.offset
                rows.append(min(max(value, one.lowest), one.highest))
        return rows

    def begin(self, outputs: Sequence[float], x0: Sequence[float] | Floats) -> Floats:
        """State (7,) after initialisation, where ``x0`` (7,) was asked for.

        Raises InputError if the FMU starts elsewhere, unless it is to be placed.
        """
        asked = [float(value) for value in x0]
        self._psi, self._delta = 0.0 if self._placed else asked[2], asked[6]
        ours = self._read(outputs)
        x, y, psi = pose = ours["x"], ours["y"], ours["psi"]
        if self._placed:
            self._turn = asked[2] - psi
            self._origin = complex(*asked[:2]) - complex(x, y) * _direction(self._turn)
        elif POSE_TOLERANCE < np.abs(np.subtract(pose, asked[:3])).max() < math.inf:
            raise InputError(
                f"the FMU starts at x = {x:.4g} m, y = {y:.4g} m, psi = {psi:.4g} rad instead of "
                f"{asked[0]:.4g}, {asked[1]:.4g}, {asked[2]:.4g}; name the variables that set its "
                "pose in the map's [start] (and check units, signs and offsets), or let "
                "`placed = true` in [fmu] move its world, if it starts at an origin of its own"
            )
        return self._state(ours, omega=asked[5])  # the heading has not changed yet

    def state(self, outputs: Sequence[float], u: Sequence[float], duration_s: float) -> Floats:
        """State (7,) after ``u`` acted for ``duration_s``; not finite where the outputs are not.

        The heading is continuous as long as it changes by less than half a turn a call.
        """
        before = self._psi
        ours = self._read(outputs)
        self._delta += duration_s * float(u[1])
        return self._state(ours, omega=(self._psi - before) / duration_s)

    def _read(self, outputs: Sequence[float]) -> dict[str, float]:
        """What the rows and rules make of the outputs, in the FMU's world."""
        rows = zip(self._outputs, outputs, strict=True)
        ours = {one.quantity: one.scale * value + one.offset for one, value in rows}
        turns = (self._psi - ours["psi"]) / TURN
        # Nothing is added where the FMU counts turns itself: its value stays to the bit.
        self._psi = ours["psi"] + TURN * round(turns) if math.isfinite(turns) else math.nan
        velocity = None
        if "world_vx" in ours:
            velocity = complex(ours["world_vx"], ours["world_vy"]) * _direction(-self._psi)
        elif "speed" in ours:
            velocity = ours["speed"] * _direction(ours.get("slip", 0.0))
        if velocity is not None:
            ours |= {"vx": velocity.real, "vy": velocity.imag}
        return ours | {"psi": self._psi}

    def _state(self, ours: Mapping[str, float], omega: float) -> Floats:
        place = complex(ours["x"], ours["y"]) * _direction(self._turn) + self._origin
        psi, delta = ours["psi"] + self._turn, ours.get("delta", self._delta)
        omega = ours.get("omega", omega)
        return np.array((place.real, place.imag, psi, ours["vx"], ours["vy"], omega, delta))


def _direction(angle_rad: float) -> complex:
    """The unit vector at this angle as a complex number, NaN for an angle that is not finite: to
    multiply by it turns a vector."""
    if not math.isfinite(angle_rad):
        return complex(math.nan, math.nan)
    return complex(math.cos(angle_rad), math.sin(angle_rad))
