"""A bad solution never reaches the actuators: what is sent instead, step by step down.

Level 0 the solution; 1 the previous plan, shifted, for a bounded time; 2 braking along the plan's
steering, and with the steering held when the plan is over; 3 standing still. Every cycle is counted
under its level. From level 1 the next usable solution leads back; from 2 several in a row, so that
a controller that works every other cycle does not jerk the car. A standing car is not jerked: it
drives the next one. Where only the first step after a cold start is usable it would stand for ever.
"""

import math
from enum import IntEnum

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from bayesrace.vehicles.parameters import CarParameters
from controller.interface import NO_PLAN, Array, StepOutput

__all__ = ["Fallback", "FallbackSettings", "Level"]


class Level(IntEnum):
    """Where the input came from."""

    SOLUTION = 0
    SHIFTED_PLAN = 1
    BRAKE = 2
    STOP = 3


class FallbackSettings(BaseModel):
    """How far down, how fast."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    shifted_s: float = Field(
        default=0.1, ge=0, le=2, description="how long after its first input a plan may be driven"
    )
    recover_cycles: int = Field(
        default=3,
        ge=1,
        le=100,
        description="usable solutions in a row that end braking; the last of them is driven. "
        "A car that stands drives the first",
    )
    tolerance: float = Field(
        default=1e-3, ge=0, le=0.1, description="excess over a limit that is clipped, not refused"
    )


class Fallback:
    """Chooses the input of each cycle; always finite and within the car's limits."""

    def __init__(self, car: CarParameters, settings: FallbackSettings | None = None) -> None:
        self._settings = settings or FallbackSettings()
        self._low = np.array([car.d_min, -car.delta_rate_max_radps])
        self._high = np.array([car.d_max, car.delta_rate_max_radps])
        self._brake_fade_mps = car.brake_fade_mps
        self.counts = [0, 0, 0, 0]
        """Cycles so far by level."""
        self.reset()

    def reset(self) -> None:
        """Forget the plan: it belongs to another run. The counts go on."""
        self._plan: Array = NO_PLAN
        self._plan_s = self._row_s = 0.0
        self._to_recover = 0

    def decide(
        self, output: StepOutput | None, vx_mps: float, time_s: float, late_s: float = 0.0
    ) -> tuple[float, float, Level]:
        """d, delta_rate and where they come from.

        ``output`` is made for an input that begins to act at ``time_s``; None: the step gave
        nothing. ``late_s``: how much later than that the input will act after all, which is a
        reason to drive the plan farther down.
        """
        if output is not None and self._usable(output):
            chosen = self._accepted(output, vx_mps, time_s, late_s)
        else:
            chosen = self._step_down(vx_mps, time_s + late_s)
            if chosen[2] >= Level.BRAKE:
                self._to_recover = self._settings.recover_cycles
        self.counts[chosen[2]] += 1
        return chosen

    def halt(self, vx_mps: float, time_s: float) -> tuple[float, float]:
        """Braking to standstill on command: along the plan's steering, not counted."""
        return self._braking(vx_mps, time_s)[:2]

    def rehearse(self, output: StepOutput | None) -> None:
        """The checks of :meth:`decide`, without effect."""
        if output is not None and self._usable(output):
            self._fit(output)

    def _usable(self, output: StepOutput) -> bool:
        if output.status != 0:
            return False
        d, rate = float(output.u[0]), float(output.u[1])
        # Explicitly, because max(0.0, nan) is 0.0: a NaN steering rate must not get through.
        if not (math.isfinite(d) and math.isfinite(rate)):
            return False
        d_safe, rate_safe = self._limited(d, rate)
        return max(abs(d - d_safe), abs(rate - rate_safe)) <= self._settings.tolerance

    def _accepted(
        self, output: StepOutput, vx_mps: float, time_s: float, late_s: float
    ) -> tuple[float, float, Level]:
        # The plan is kept only from solutions that were fit to be driven.
        self._plan = self._fit(output)
        self._plan_s, self._row_s = time_s, output.plan_step_s
        if self._to_recover > 1 and vx_mps > self._brake_fade_mps:
            self._to_recover -= 1
            return self._braking(vx_mps, time_s + late_s)
        self._to_recover = 0
        if self._row(time_s + late_s) > 0:
            return self._step_down(vx_mps, time_s + late_s)
        return *self._limited(float(output.u[0]), float(output.u[1])), Level.SOLUTION

    @staticmethod
    def _fit(output: StepOutput) -> Array:
        """A copy of the plan, or none if any of it is no number."""
        plan = output.plan_u
        return plan.copy() if len(plan) and np.isfinite(plan).all() else NO_PLAN

    def _row(self, time_s: float) -> int:
        """Row of the plan that is due."""
        if not len(self._plan):
            return 0
        return max(int((time_s - self._plan_s) / self._row_s + 1e-6), 0)

    def _step_down(self, vx_mps: float, time_s: float) -> tuple[float, float, Level]:
        row = self._row(time_s)
        recent = time_s - self._plan_s <= self._settings.shifted_s + 1e-6
        if recent and row < len(self._plan) and not self._to_recover:
            d, rate = self._limited(float(self._plan[row, 0]), float(self._plan[row, 1]))
            return d, rate, Level.SHIFTED_PLAN
        return self._braking(vx_mps, time_s)

    def _braking(self, vx_mps: float, time_s: float) -> tuple[float, float, Level]:
        d = self._brake(vx_mps)
        if not vx_mps > self._brake_fade_mps:
            return d, 0.0, Level.STOP
        row = self._row(time_s)
        if row < len(self._plan):
            _, rate = self._limited(0.0, float(self._plan[row, 1]))
            return d, rate, Level.BRAKE
        return d, 0.0, Level.BRAKE

    def _brake(self, vx_mps: float) -> float:
        if not math.isfinite(vx_mps):
            return 0.0
        return float(self._low[0]) * min(max(vx_mps / self._brake_fade_mps, 0.0), 1.0)

    def _limited(self, d: float, rate: float) -> tuple[float, float]:
        low, high = self._low, self._high
        return (
            min(max(d, float(low[0])), float(high[0])),
            min(max(rate, float(low[1])), float(high[1])),
        )
