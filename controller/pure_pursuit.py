"""Pure pursuit along a racing line: the driver that collects training data. Not tuned well.

Coulter, "Implementation of the pure pursuit path tracking algorithm", 1992: steer on the circle
through the rear axle and a point ahead on the line, delta = atan(2 L sin(alpha) / l). The steering
angle is a target that a rate within the car's limit pursues; the speed follows the line's (or
less) by a proportional drive command. A seeded disturbance on both inputs makes the data worth
learning from.
"""

import math

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.vehicles.parameters import CarParameters
from controller.interface import NO_LIMITS, Environment, StepOutput

__all__ = ["PurePursuit", "PurePursuitSettings"]


class PurePursuitSettings(BaseModel):
    """How it drives; what depends on the car's size is in the car's tuning."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    speed_scale: float = Field(
        default=0.95, gt=0, le=1.5, description="fraction of the line's speed"
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


class PurePursuit:
    """See the module; a :class:`controller.interface.ControlLaw`."""

    def __init__(
        self,
        car: CarParameters,
        x_m: Floats,
        y_m: Floats,
        vx_mps: Floats,
        settings: PurePursuitSettings | None = None,
    ) -> None:
        """``x_m``, ``y_m``, ``vx_mps``: a closed line's points in order of driving, (n,) each, the
        last not repeated."""
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
        self._spacing = float(self._lengths[-1]) / len(steps)
        self._nearest: int | None = None
        self._random = np.random.default_rng(self._settings.seed)
        self._noise = np.zeros(2)
        self._output = StepOutput(u=np.zeros(2))
        self._predicted = np.zeros(7)

    def reset(self) -> None:
        """Search the whole line; begin the disturbance anew."""
        self._nearest = None
        self._random = np.random.default_rng(self._settings.seed)
        self._noise[:] = 0.0

    def predict(self, x: Floats, u: Floats, duration_s: float) -> Floats:
        """Dead reckoning: the velocities stay, the steering goes on at its rate."""
        after = self._predicted
        after[:] = x
        psi_mid = float(x[2]) + 0.5 * duration_s * float(x[5])
        vx, vy = float(x[3]), float(x[4])
        after[0] += duration_s * (vx * math.cos(psi_mid) - vy * math.sin(psi_mid))
        after[1] += duration_s * (vx * math.sin(psi_mid) + vy * math.cos(psi_mid))
        after[2] += duration_s * float(x[5])
        delta = float(x[6]) + duration_s * float(u[1])
        after[6] = min(max(delta, -self._car.delta_max_rad), self._car.delta_max_rad)
        return after

    def step(
        self,
        x: Floats,
        u_previous: Floats,
        environment: Environment = NO_LIMITS,
        elapsed_s: float = 0.0,
        budget_s: float = 0.0,
    ) -> StepOutput:
        """Steer towards the target point, hold the line's speed, or the limit's as it is now."""
        car, settings, output = self._car, self._settings, self._output
        px, py, psi, vx, delta = (float(x[i]) for i in (0, 1, 2, 3, 6))
        nearest = self._nearest = self._follow(px, py)
        self._excite()
        target_speed, delta_target = self._targets(nearest, px, py, psi, vx)
        target_speed = min(target_speed, environment.speed_limit_mps)
        d = (
            self._tuning.speed_gain_spm * (target_speed - vx)
            + car.drive.hold(vx)
            + float(self._noise[0])
        )
        rate = (delta_target + float(self._noise[1]) - delta) / settings.step_s
        lowest = max(-car.delta_rate_max_radps, (-car.delta_max_rad - delta) / settings.step_s)
        highest = min(car.delta_rate_max_radps, (car.delta_max_rad - delta) / settings.step_s)
        output.u[0] = min(max(d, car.d_min), car.d_max)
        output.u[1] = min(max(rate, lowest), highest)
        output.s_ref_m = float(self._lengths[nearest])
        return output

    def _targets(
        self, nearest: int, px: float, py: float, psi: float, vx: float
    ) -> tuple[float, float]:
        """Speed [m/s] and steering angle [rad] to aim for."""
        car, settings, tuning = self._car, self._settings, self._tuning
        reach = tuning.lookahead_m + tuning.lookahead_s * max(vx, 0.0)
        ahead = (nearest + max(1, round(reach / self._spacing))) % len(self._points)
        rear_x = px - car.lr_m * math.cos(psi)
        rear_y = py - car.lr_m * math.sin(psi)
        dx, dy = float(self._points[ahead, 0]) - rear_x, float(self._points[ahead, 1]) - rear_y
        alpha = math.atan2(dy, dx) - psi
        delta = math.atan2(2 * car.wheelbase_m * math.sin(alpha), math.hypot(dx, dy))
        speed = max(settings.speed_scale * float(self._speeds[ahead]), tuning.speed_min_mps)
        return speed, min(max(delta, -car.delta_max_rad), car.delta_max_rad)

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
        return int(np.argmin(self._squared_distances(px, py)))

    def _squared_distances(self, px: float, py: float) -> Floats:
        offsets = self._points - (px, py)
        result: Floats = np.einsum("ij,ij->i", offsets, offsets)
        return result
