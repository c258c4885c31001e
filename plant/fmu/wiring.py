"""Between the car's own quantities and an FMU's variables: arithmetic only, no process, no FMU.

A :class:`Wiring` is what is left of a map (:mod:`plant.fmu.map`) once it has been checked against
an FMU's description. Every value that passes is affine, ``scale * value + offset``; what the FMU
does not say is derived from what it says: heading from a quaternion or from a wrapped angle, body
velocities from world velocities or from speed and slip angle, yaw rate from the heading, steering
angle from the steering rate that acted.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from bayesrace.errors import InputError

__all__ = [
    "COMMANDS",
    "STATES",
    "STARTS",
    "BodyVelocity",
    "CosSin",
    "Heading",
    "InputLink",
    "OutputLinks",
    "Quaternion",
    "Signal",
    "SpeedSlip",
    "StartLink",
    "Velocity",
    "Wiring",
    "WorldVelocity",
]

Array = npt.NDArray[np.float64]
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
"""What an FMU's input can be driven by, with units: the duty cycle or its positive and (turned
positive) negative part, and the steering rate or the steering angle at the end of the hold."""

STARTS: Final = STATES | {
    "speed": "m/s", "slip": "rad", "world_vx": "m/s", "world_vy": "m/s",
    "qw": "1", "qx": "1", "qy": "1", "qz": "1",
}  # fmt: skip
"""What an FMU's start value can be set from, with units; q* is the heading as a quaternion."""


@dataclass(frozen=True, slots=True)
class Signal:
    """One of the FMU's outputs, by its place in :attr:`Wiring.outputs`, in our unit and sign."""

    index: int
    scale: float = 1.0
    offset: float = 0.0

    def read(self, outputs: Sequence[float]) -> float:
        """Our value among the FMU's."""
        return self.scale * outputs[self.index] + self.offset


@dataclass(frozen=True, slots=True)
class Quaternion:
    """Heading from the rotation body → world, of any length; yaw is the z-y-x Euler angle."""

    w: Signal
    x: Signal
    y: Signal
    z: Signal
    sign: float = 1.0
    offset: float = 0.0

    def read(self, outputs: Sequence[float]) -> float:
        """Heading [rad] within half a turn of ``offset``; NaN for a quaternion of zeros."""
        w, x, y, z = (part.read(outputs) for part in (self.w, self.x, self.y, self.z))
        sine, cosine = 2.0 * (w * z + x * y), w * w + x * x - y * y - z * z
        return self.sign * _angle(sine, cosine) + self.offset


@dataclass(frozen=True, slots=True)
class CosSin:
    """Heading from its cosine and sine (of any common length)."""

    cos: Signal
    sin: Signal
    sign: float = 1.0
    offset: float = 0.0

    def read(self, outputs: Sequence[float]) -> float:
        """Heading [rad] within half a turn of ``offset``; NaN where both are zero."""
        return self.sign * _angle(self.sin.read(outputs), self.cos.read(outputs)) + self.offset


def _angle(sine: float, cosine: float) -> float:
    return math.nan if sine == cosine == 0.0 else math.atan2(sine, cosine)


@dataclass(frozen=True, slots=True)
class BodyVelocity:
    """Forward and leftward velocity."""

    vx: Signal
    vy: Signal

    def read(self, outputs: Sequence[float], psi_rad: float) -> tuple[float, float]:
        """(vx, vy) [m/s] in the car's frame."""
        return self.vx.read(outputs), self.vy.read(outputs)


@dataclass(frozen=True, slots=True)
class WorldVelocity:
    """Velocity along the axes that x and y are measured along."""

    x: Signal
    y: Signal

    def read(self, outputs: Sequence[float], psi_rad: float) -> tuple[float, float]:
        """(vx, vy) [m/s] in the car's frame."""
        return _rotated(self.x.read(outputs), self.y.read(outputs), -psi_rad)


@dataclass(frozen=True, slots=True)
class SpeedSlip:
    """Speed and the angle of the velocity to the left of the car's axis; None: no side slip."""

    speed: Signal
    slip: Signal | None

    def read(self, outputs: Sequence[float], psi_rad: float) -> tuple[float, float]:
        """(vx, vy) [m/s] in the car's frame."""
        speed = self.speed.read(outputs)
        if self.slip is None:
            return speed, 0.0
        slip = self.slip.read(outputs)
        return _rotated(speed, 0.0, slip)


def _rotated(x: float, y: float, angle_rad: float) -> tuple[float, float]:
    """(x, y) turned by the angle; NaN for an angle that is not finite."""
    if not math.isfinite(angle_rad):
        return math.nan, math.nan
    cosine, sine = math.cos(angle_rad), math.sin(angle_rad)
    return cosine * x - sine * y, sine * x + cosine * y


Heading = Signal | Quaternion | CosSin
Velocity = BodyVelocity | WorldVelocity | SpeedSlip


@dataclass(frozen=True, slots=True)
class OutputLinks:
    """How the state is read from the FMU's outputs."""

    x: Signal
    y: Signal
    psi: Heading
    velocity: Velocity
    omega: Signal | None
    """None: from the change of heading."""
    delta: Signal | None
    """None: integrated from the steering rate that acted."""


@dataclass(frozen=True, slots=True)
class _Link:
    """A variable of the FMU that a quantity of ours sets, and the range that the FMU declares."""

    variable: str
    source: str
    """Name of our quantity."""
    scale: float = 1.0
    offset: float = 0.0
    lowest: float = -math.inf
    highest: float = math.inf

    def _converted(self, ours: Mapping[str, float]) -> float:
        """The FMU's value, not yet held against its range."""
        return self.scale * ours[self.source] + self.offset


@dataclass(frozen=True, slots=True)
class InputLink(_Link):
    """An FMU input, and what of :data:`COMMANDS` drives it."""

    def value(self, commands: Mapping[str, float]) -> float:
        """The FMU's value, within its range: an actuator at its stop stays there."""
        return min(max(self._converted(commands), self.lowest), self.highest)


@dataclass(frozen=True, slots=True)
class StartLink(_Link):
    """A start value of the FMU, and what of :data:`STARTS` sets it."""

    def value(self, starts: Mapping[str, float]) -> float:
        """The FMU's value; a heading is turned into the declared range. InputError outside it."""
        value = self._converted(starts)
        if not self.lowest <= value <= self.highest and self.source == "psi":
            turn = abs(self.scale) * TURN
            anchor = self.lowest if math.isfinite(self.lowest) else self.highest - turn
            value = anchor + (value - anchor) % turn
        if not self.lowest <= value <= self.highest:
            raise InputError(
                f"the FMU cannot start with {self.variable} = {value:g} (our {self.source} = "
                f"{starts[self.source]:g}): it allows {self.lowest:g} to {self.highest:g}; start "
                "elsewhere, or correct unit, sign and offset in the map's [start]"
            )
        return value


_COMMAND_OF: Final[dict[str, Callable[[float, float, float], float]]] = {
    "d": lambda d, rate, delta: d,
    "delta_rate": lambda d, rate, delta: rate,
    "delta": lambda d, rate, delta: delta,
    "throttle": lambda d, rate, delta: max(d, 0.0),
    "brake": lambda d, rate, delta: max(-d, 0.0),
}


class Wiring:
    """The car's commands as an FMU's inputs, and its outputs as the car's state.

    Made by :func:`plant.fmu.map.wire`. It remembers what is integrated or unwrapped over a run:
    :meth:`start_values`, :meth:`begin`, then :meth:`to_inputs` and :meth:`state` in turn.

    ``inputs`` and ``outputs`` are the FMU's variables, all real, in the order in which values are
    passed; ``fixed`` are parameters and inputs that are set once, before initialisation;
    ``step_s`` is the communication step that the map asks for, None if it leaves that open;
    ``timeout_s`` how long the FMU may take for a step, ``startup_s`` for its start; ``placed``: the
    FMU starts where it likes and its world is moved so that it starts at the asked pose.
    """

    def __init__(
        self,
        *,
        inputs: Sequence[InputLink],
        outputs: Sequence[str],
        links: OutputLinks,
        starts: Sequence[StartLink] = (),
        fixed: Mapping[str, Value] | None = None,
        step_s: float | None = None,
        timeout_s: float = 2.0,
        startup_s: float = 8.0,
        placed: bool = False,
    ) -> None:
        self.inputs: tuple[str, ...] = tuple(link.variable for link in inputs)
        self.outputs: tuple[str, ...] = tuple(outputs)
        self.fixed: dict[str, Value] = dict(fixed or {})
        self.step_s = step_s
        self.timeout_s = timeout_s
        self.startup_s = startup_s
        self.placed = placed
        self._inputs = tuple(inputs)
        self._starts = tuple(starts)
        self._links = links
        self._psi_fmu = 0.0  # unwrapped, in the FMU's world
        self._delta = 0.0  # integrated
        self._shift: tuple[float, float, float, float, float] | None = None

    def start_values(self, x0: Sequence[float] | Array) -> dict[str, Value]:
        """What to set before initialisation so that the car starts in ``x0``, (7,).

        Parameters, constant inputs, start values, and the inputs of a car whose motor is off and
        whose steering holds still. InputError for a start that the FMU's ranges do not allow.
        """
        x, y, psi, vx, vy, omega, delta = (float(value) for value in x0)
        world_vx, world_vy = _rotated(vx, vy, psi)
        starts = dict(zip(STATES, (x, y, psi, vx, vy, omega, delta), strict=True)) | {
            "speed": math.hypot(vx, vy),
            "slip": math.atan2(vy, vx),
            "world_vx": world_vx,
            "world_vy": world_vy,
            "qw": math.cos(psi / 2.0),
            "qx": 0.0,
            "qy": 0.0,
            "qz": math.sin(psi / 2.0),
        }
        still = zip(self.inputs, self.to_inputs((0.0, 0.0), delta, 0.0), strict=True)
        return self.fixed | dict(still) | {s.variable: s.value(starts) for s in self._starts}

    def begin(self, outputs: Sequence[float], x0: Sequence[float] | Array) -> Array:
        """State (7,) after initialisation, where ``x0`` (7,) was asked for.

        Raises InputError if the FMU starts elsewhere, unless it is to be placed.
        """
        asked = np.array(x0, dtype=np.float64)
        self._shift = None
        self._psi_fmu = 0.0 if self.placed else float(asked[2])
        self._delta = float(asked[6])
        psi = self._unwrapped(outputs)
        x, y = self._links.x.read(outputs), self._links.y.read(outputs)
        if self.placed:
            turn = float(asked[2]) - psi
            self._shift = (x, y, float(asked[0]), float(asked[1]), turn)
        else:
            self._check_pose((x, y, psi), asked)
        self._psi_fmu = psi
        omega = float(asked[5])  # there is no change of heading yet to tell it from
        return self._state(outputs, psi, omega)

    def to_inputs(
        self, u: Sequence[float], delta_rad: float, duration_s: float
    ) -> list[float]:  # fmt: skip
        """The FMU's inputs while ``u`` = (d, delta_rate) acts for ``duration_s``.

        ``u`` has passed the guard. An FMU that takes a steering angle gets the one at the end of
        the hold, ``delta_rad`` being the one at its beginning.
        """
        d, rate = float(u[0]), float(u[1])
        delta = delta_rad + duration_s * rate
        commands = {link.source: _COMMAND_OF[link.source](d, rate, delta) for link in self._inputs}
        return [link.value(commands) for link in self._inputs]

    def state(self, outputs: Sequence[float], u: Sequence[float], duration_s: float) -> Array:
        """State (7,) after ``u`` acted for ``duration_s``; not finite where the outputs are not.

        The heading is continuous as long as it changes by less than half a turn a call.
        """
        psi = self._unwrapped(outputs)
        omega = (psi - self._psi_fmu) / duration_s
        self._delta += duration_s * float(u[1])
        self._psi_fmu = psi
        return self._state(outputs, psi, omega)

    def _unwrapped(self, outputs: Sequence[float]) -> float:
        """The FMU's heading, by whole turns nearest to the one before."""
        psi = self._links.psi.read(outputs)
        turns = (self._psi_fmu - psi) / TURN
        # Nothing is added where the FMU counts turns itself: its value stays to the bit.
        return psi + TURN * round(turns) if math.isfinite(turns) else math.nan

    def _state(self, outputs: Sequence[float], psi: float, omega: float) -> Array:
        links = self._links
        x, y = links.x.read(outputs), links.y.read(outputs)
        vx, vy = links.velocity.read(outputs, psi)
        if links.omega is not None:
            omega = links.omega.read(outputs)
        delta = self._delta if links.delta is None else links.delta.read(outputs)
        if self._shift is not None:
            x_fmu, y_fmu, x_asked, y_asked, turn = self._shift
            dx, dy = _rotated(x - x_fmu, y - y_fmu, turn)
            x, y, psi = x_asked + dx, y_asked + dy, psi + turn
        return np.array((x, y, psi, vx, vy, omega, delta))

    def _check_pose(self, pose: tuple[float, float, float], asked: Array) -> None:
        if not all(math.isfinite(value) for value in pose):
            return  # said better by who looks at all outputs
        if max(abs(is_ - want) for is_, want in zip(pose, asked[:3], strict=True)) > POSE_TOLERANCE:
            x, y, psi = pose
            raise InputError(
                f"the FMU starts at x = {x:.4g} m, y = {y:.4g} m, psi = {psi:.4g} rad instead of "
                f"{asked[0]:.4g}, {asked[1]:.4g}, {asked[2]:.4g}; name the variables that set its "
                "pose in the map's [start] (and check units, signs and offsets), or let "
                "`placed = true` in [fmu] move its world, if it starts at an origin of its own"
            )
