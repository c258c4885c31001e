"""What the car does by itself with a command, or without one.

Whatever arrives, drive command, steering rate and steering angle stay within the car's limits, and
what is not finite never gets to the drive. Without a usable command the car follows the braking
plan that the controller sends ahead after each cycle (:class:`bayesrace.messages.BrakingPlan`), row
by row, in plant time; without a plan it brakes with the steering held.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.messages import BrakingPlan
from bayesrace.vehicles.parameters import CarParameters

__all__ = ["Command", "GuardCounters", "Planned", "PlantGuard", "planned_at"]

_EARLY: Final = 2.0
"""Rows by which a plan may lie in the future when it takes over."""

_CLIP_TOLERANCE: Final = 1e-9
"""Excess that is rounding of the sender's arithmetic: corrected, not counted as clipped."""

_SLOWEST: Final = 1e-6
"""Squared speed by which is divided."""


class Planned:
    """A command that depends on the steering angle at which it begins to act.

    A plan has steering angles, not rates: they do not depend on when it takes over.
    """

    def __init__(self, plan: BrakingPlan, now_s: float) -> None:
        self._plan, self._now_s = plan, now_s

    def command(self, delta_rad: float, duration_s: float) -> tuple[float, float]:
        """Drive command and steering rate [rad/s] that follow the plan for so long."""
        plan = self._plan
        row = min(max(int((self._now_s - plan.begins_s) / plan.step_s), 0), len(plan.d) - 1)
        ends_s = plan.begins_s + plan.step_s * np.arange(1, len(plan.d) + 1)
        target = float(np.interp(self._now_s + duration_s, ends_s, plan.delta))
        return plan.d[row], (target - delta_rad) / duration_s


def planned_at(plan: BrakingPlan | None, now_s: float) -> Planned | None:
    """What the plan says at this plant time; None: nothing, it is over or there is none."""
    if plan is None or not plan.d or len(plan.d) != len(plan.delta):
        return None
    row = (now_s - plan.begins_s) / plan.step_s
    return Planned(plan, now_s) if -_EARLY <= row < len(plan.d) else None


Command = Sequence[float] | Planned | None
"""Drive command and steering rate, what the braking plan makes of them, or None: brake."""


@dataclass(slots=True)
class GuardCounters:
    """How often the guard had to act since it was made."""

    rejected: int = 0
    """Commands that were not finite; the car braked instead."""
    clipped: int = 0
    """Commands beyond a limit of drive command, steering rate or steering angle."""
    planned: int = 0
    """Periods, or parts of one, driven by the controller's braking plan."""
    braked: int = 0
    """Periods, or parts of one, with neither a usable command nor a braking plan."""


class PlantGuard:
    """Turns any command into one that the car's actuators can follow for one period."""

    def __init__(self, car: CarParameters) -> None:
        self._d_min, self._d_max, self._drive = car.d_min, car.d_max, car.drive
        self._rate_max = car.delta_rate_max_radps
        self._delta_max = car.delta_max_rad
        self._brake_fade_mps, self._brake_d, self._brake_slow = car.brake_numbers.values()
        self.counters = GuardCounters()

    def apply(self, u: Command, x: Floats, duration_s: float) -> tuple[float, float]:
        """Drive command and steering rate [rad/s] that act so long for the command ``u`` in state
        ``x`` (7,); None brakes."""
        vx_mps, delta_rad = float(x[3]), float(x[6])
        lowest = self._drive.braking(vx_mps, self._d_min, duration_s)
        if u is None:
            return self._brake(vx_mps, lowest)
        if isinstance(u, Planned):
            self.counters.planned += 1
            d, rate = u.command(delta_rad, duration_s)
            if d < 0:  # the car may stand sooner than the model that planned
                d = max(d, self._braking(vx_mps, lowest))
        else:
            d, rate = float(u[0]), float(u[1])
        if not (math.isfinite(d) and math.isfinite(rate)):
            self.counters.rejected += 1
            return self._brake(vx_mps, lowest)
        highest = self._d_max * self._drive.available(vx_mps, float(x[4]))
        d_safe = min(max(d, lowest), highest)
        rate_safe = self._steerable(rate, delta_rad, duration_s)
        if abs(d_safe - d) > _CLIP_TOLERANCE or abs(rate_safe - rate) > _CLIP_TOLERANCE:
            self.counters.clipped += 1
        return d_safe, rate_safe

    def _brake(self, vx_mps: float, lowest: float) -> tuple[float, float]:
        """Braking with the steering held."""
        self.counters.braked += 1
        return self._braking(vx_mps, lowest), 0.0

    def _braking(self, vx_mps: float, lowest: float) -> float:
        """The drive command that the car can hold while it rolls, fading to none at standstill."""
        held = self._brake_d + self._brake_slow / max(vx_mps * vx_mps, _SLOWEST)
        share = min(max(vx_mps / self._brake_fade_mps, 0.0), 1.0)
        return max(max(self._d_min, -held) * share, lowest)

    def _steerable(self, rate: float, delta_rad: float, duration_s: float) -> float:
        """The nearest rate within its limit that leaves the angle within its own at the end."""
        lowest = (-self._delta_max - delta_rad) / duration_s
        highest = (self._delta_max - delta_rad) / duration_s
        rate = min(max(rate, lowest), highest)
        return min(max(rate, -self._rate_max), self._rate_max)

    def angle_after(self, delta_rad: float, rate: float, duration_s: float) -> float:
        """Steering angle after that long at ``rate``, free of the integrator's rounding."""
        return min(max(delta_rad + duration_s * rate, -self._delta_max), self._delta_max)
