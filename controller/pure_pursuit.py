"""Pure pursuit along a line: the driver that collects training data, beyond the limit on purpose.

Coulter, "Implementation of the pure pursuit path tracking algorithm", 1992, in the frame of the
line: the car steers as the line bends, and on the circle through a point ahead that takes it back
to the line. The speed follows the line's by its acceleration and a proportional drive command.
A seeded disturbance on both inputs, and speeds at which the tyres slide, make the data worth
learning from; beside the line both fade, so that the car stays on its track.
"""

import math
from typing import Final, Literal, NamedTuple

import numpy as np
from pydantic import Field

from bayesrace.arrays import Floats
from bayesrace.controller.interface import NO_LIMITS, Environment, StepOutput
from bayesrace.errors import InputError
from bayesrace.strict import StrictModel
from bayesrace.vehicles.parameters import Car

__all__ = ["DrivingStyle", "PurePursuit", "PurePursuitSettings", "dead_reckoning", "turning"]

DrivingStyle = Literal["limit", "calm", "weave"]
"""limit: faster than the line allows, so that the car slides. calm: slower than the line. weave: in
waves about the line, at its speed."""

_SCALES: Final[dict[DrivingStyle, float]] = {"limit": 1.1, "calm": 0.9, "weave": 1.0}
"""Mean speed of each style over the line's; it sways about that, so that each place is passed at
several speeds."""
_SLOWER: Final = 0.6
"""Share of the speed that is taken off at the end of the room beside the line."""
_SLIPPING: Final = 0.65
"""What is aimed at the line: the car's axis, turned by this share of its slip angle."""
_WINDOW: Final = 0.25
"""Of the distance of the target: points before and behind by which the line's bends are found."""


class PurePursuitSettings(StrictModel):
    """How it drives; what depends on the car's size is in the car's tuning."""

    style: DrivingStyle = Field(
        default="limit",
        description="style of the training drive: limit (it slides), calm, or weave (in waves "
        "about the line)",
    )
    speed_scale: float | None = Field(
        default=None,
        gt=0,
        le=2,
        description="mean fraction of the line's speed; None: by the style",
    )
    excite_d: float | None = Field(
        default=None,
        ge=0,
        description="std. deviation of the disturbance of d; None: the car's, from its tuning",
    )
    excite_delta_rad: float = Field(
        default=0.04, ge=0, le=1, description="std. deviation of the steering disturbance"
    )
    excite_s: float = Field(default=0.1, gt=0, description="correlation time of the disturbances")
    seed: int = Field(default=0, ge=0, description="of the disturbances")
    step_s: float = Field(default=0.02, gt=0, le=1, description="sampling time")

    @property
    def scale(self) -> float:
        """Mean fraction of the line's speed."""
        return self.speed_scale or _SCALES[self.style]


class _Place(NamedTuple):
    """Where the car is beside its line."""

    nearest: int
    """Index of the nearest point of the line."""
    left_m: float
    """Offset to the left of the line."""
    aside: float
    """Of the room on that side: 0 on the line, 1 at the end."""


def dead_reckoning(car: Car, x: Floats, u: Floats, duration_s: float) -> Floats:
    """The state (7,) after so long: the velocities stay, the steering goes on at its rate."""
    after = x.copy()
    psi_mid = float(x[2]) + 0.5 * duration_s * float(x[5])
    vx, vy = float(x[3]), float(x[4])
    after[0] += duration_s * (vx * math.cos(psi_mid) - vy * math.sin(psi_mid))
    after[1] += duration_s * (vx * math.sin(psi_mid) + vy * math.cos(psi_mid))
    after[2] += duration_s * float(x[5])
    delta = float(x[6]) + duration_s * float(u[1])
    after[6] = min(max(delta, -car.delta_max_rad), car.delta_max_rad)
    return after


def turning(car: Car, delta_rad: float, target_rad: float, step_s: float) -> float:
    """Steering rate [rad/s] with which the angle is that of the target after a period, or as near
    to it as the car's limits allow."""
    lowest = max(-car.delta_rate_max_radps, (-car.delta_max_rad - delta_rad) / step_s)
    highest = min(car.delta_rate_max_radps, (car.delta_max_rad - delta_rad) / step_s)
    return min(max((target_rad - delta_rad) / step_s, lowest), highest)


class PurePursuit:
    """See the module; a :class:`bayesrace.controller.interface.ControlLaw`."""

    def __init__(
        self,
        car: Car,
        x_m: Floats,
        y_m: Floats,
        vx_mps: Floats,
        settings: PurePursuitSettings | None = None,
        *,
        room_m: tuple[Floats, Floats] | None = None,
    ) -> None:
        """``x_m``, ``y_m``, ``vx_mps``: a closed line's points in order of driving, (n,) each, the
        last not repeated. ``room_m``: how far the car may be to the right and to the left of each
        point, (n,) each; without, anywhere."""
        self._car = car
        self._settings = settings or PurePursuitSettings()
        self._points = np.column_stack([x_m, y_m]).astype(np.float64)
        self._speeds = np.asarray(vx_mps, dtype=np.float64)
        if len(self._points) < 10 or not np.isfinite(self._points).all():
            raise InputError("pure pursuit needs a line of at least 10 finite points")
        if self._speeds.shape != (len(self._points),) or not np.isfinite(self._speeds).all():
            raise InputError("pure pursuit needs one finite speed for each point of the line")
        steps = np.linalg.norm(np.roll(self._points, -1, axis=0) - self._points, axis=1)
        if not (steps > 0).all():
            raise InputError(
                "the line repeats a point; leave out the last point if it is the first"
            )
        # Twice around, so that every window of indices is one slice.
        self._twice_x, self._twice_y = np.tile(self._points, (2, 1)).T.copy()
        self._lengths = np.concatenate([[0.0], np.cumsum(steps)])
        self._tuning = car.tuning.pursuit
        excite_d = self._settings.excite_d
        self._excite_d = self._tuning.excite_d if excite_d is None else excite_d
        self._steps = 0
        self._spacing = float(self._lengths[-1]) / len(steps)
        self._shape()
        everywhere: Floats = np.full(len(steps), np.inf)
        self._right_m, self._left_m = (everywhere, everywhere) if room_m is None else room_m
        self._nearest: int | None = None
        self._random = np.random.default_rng(self._settings.seed)
        self._noise = np.zeros(2)
        self._output = StepOutput(u=np.zeros(2))

    def _shape(self) -> None:
        """Directions, curvatures and accelerations of the line, (n,) each."""
        reach = max(1, round(_WINDOW * self._tuning.lookahead_m / self._spacing))

        def across(values: Floats) -> Floats:
            return np.roll(values, -reach, axis=0) - np.roll(values, reach, axis=0)

        chord = across(self._points)
        length = 2 * reach * self._spacing
        self._heading = np.arctan2(chord[:, 1], chord[:, 0])
        turned = np.remainder(across(self._heading) + np.pi, 2 * np.pi) - np.pi
        self._kappa = turned / length
        self._acceleration = across(self._speeds**2) / (2 * length)

    def reset(self) -> None:
        """Search the whole line; begin the disturbance anew."""
        self._nearest, self._steps = None, 0
        self._random = np.random.default_rng(self._settings.seed)
        self._noise[:] = 0.0

    def predict(self, x: Floats, u: Floats, duration_s: float) -> Floats:
        """As :func:`dead_reckoning`."""
        return dead_reckoning(self._car, x, u, duration_s)

    def step(
        self,
        x: Floats,
        u_previous: Floats,
        environment: Environment = NO_LIMITS,
        elapsed_s: float = 0.0,
        budget_s: float = 0.0,
    ) -> StepOutput:
        """Steer along the line, hold its speed, or the limit's as it is now."""
        car, settings, output = self._car, self._settings, self._output
        place, delta = self._place(float(x[0]), float(x[1])), float(x[6])
        self._excite()
        self._steps += 1
        excited_d, excited_delta = (1 - place.aside) * self._noise
        d = self._drive(place, float(x[3]), environment.speed_limit_mps) + float(excited_d)
        delta_target = self._steer(place, x) + float(excited_delta)
        output.u[0] = min(max(d, car.d_min), car.d_max)
        output.u[1] = turning(car, delta, delta_target, settings.step_s)
        output.numbers = {"s_ref_m": float(self._lengths[place.nearest])}
        return output

    def _place(self, px: float, py: float) -> _Place:
        index = self._nearest = self._follow(px, py)
        heading = float(self._heading[index])
        dx, dy = px - float(self._points[index, 0]), py - float(self._points[index, 1])
        left_m = dy * math.cos(heading) - dx * math.sin(heading)
        room_m = float((self._left_m if left_m > 0 else self._right_m)[index])
        return _Place(index, left_m, min(abs(left_m) / max(room_m, 1e-9), 1.0))

    def _ahead(self, index: int, way_m: float) -> int:
        """The point of the line so far ahead of another one."""
        return (index + round(max(way_m, 0.0) / self._spacing)) % len(self._points)

    def _drive(self, place: _Place, vx: float, limit_mps: float) -> float:
        """Drive command for the line's speed a little ahead; less beside the line."""
        car, tuning = self._car, self._tuning
        ahead = self._ahead(place.nearest, vx * tuning.preview_s)
        phase = 2 * math.pi * self._steps * self._settings.step_s / tuning.sway_s
        sway = math.sin(phase)
        scale = self._settings.scale * (1 + (tuning.faster if sway > 0 else tuning.slower) * sway)
        wanted = scale * (1 - _SLOWER * place.aside) * float(self._speeds[ahead])
        wanted = min(max(wanted, tuning.speed_min_mps), limit_mps)
        acceleration = scale**2 * float(self._acceleration[ahead])
        forward = car.drive.command_at(vx, acceleration, car.mass_kg)
        return tuning.speed_gain_spm * (wanted - vx) + forward

    def _steer(self, place: _Place, x: Floats) -> float:
        """Steering angle to aim for [rad]: the line's bend, and back to it; what the tyres lose in
        a bend is added, and a yaw rate beyond the line's is damped."""
        car, tuning = self._car, self._tuning
        vx, vy = float(x[3]), float(x[4])
        slip = math.atan2(vy, max(vx, tuning.speed_min_mps))
        axis = float(x[2]) + _SLIPPING * slip - float(self._heading[place.nearest])
        reach_m = tuning.lookahead_m + tuning.lookahead_s * max(vx, 0.0)
        sideways = math.asin(min(max(place.left_m / reach_m, -1.0), 1.0))
        back = 2 * math.sin(math.remainder(-sideways - axis, 2 * math.pi)) / reach_m
        ahead = self._ahead(place.nearest, vx * tuning.steering_s)
        kappa = float(self._kappa[ahead]) + back
        delta = math.atan(car.wheelbase_m * kappa) + tuning.understeer_s2pm * kappa * vx * vx
        delta -= tuning.damping_s * (float(x[5]) - vx * float(self._kappa[place.nearest]))
        return min(max(delta, -car.delta_max_rad), car.delta_max_rad)

    def _excite(self) -> None:
        """First-order low-pass noise (Ornstein-Uhlenbeck) of the set standard deviations."""
        settings = self._settings
        keep = math.exp(-settings.step_s / settings.excite_s)
        fresh = self._random.standard_normal(2) * math.sqrt(1 - keep * keep)
        fresh *= (self._excite_d, settings.excite_delta_rad)
        self._noise *= keep
        self._noise += fresh

    def _follow(self, px: float, py: float) -> int:
        """Nearest point near the last one; of the whole line if the car has left that by far."""
        count = len(self._points)
        if self._nearest is not None:
            reach = min(max(3, int(self._tuning.window_m / self._spacing)), count // 3)
            first = (self._nearest - reach // 2) % count
            window = slice(first, first + reach // 2 + reach)
            dx, dy = self._twice_x[window] - px, self._twice_y[window] - py
            squared = dx * dx + dy * dy
            best = int(squared.argmin())
            if squared[best] <= self._tuning.lost_m**2:
                return (first + best) % count
        offsets = self._points - (px, py)
        return int(np.einsum("ij,ij->i", offsets, offsets).argmin())
