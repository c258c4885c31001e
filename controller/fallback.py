"""A bad solution never reaches the actuators: what is sent instead, step by step down.

Level 0 the solution; 1 the previous plan, shifted, for a bounded number of cycles; 2 braking along
the plan's steering; 3 stop, steering held. Every cycle is counted under its level. A usable
solution leads back to level 0 at once.
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

    shifted_cycles: int = Field(
        default=5, ge=0, le=100, description="cycles in a row that the previous plan may be driven"
    )
    tolerance: float = Field(
        default=1e-3, ge=0, le=0.1, description="excess over a limit that is clipped, not refused"
    )
    brake_fade_mps: float = Field(
        default=0.1, gt=0, description="speed below which braking fades to none at standstill"
    )


class Fallback:
    """Chooses the input of each cycle; always finite and within the car's limits."""

    def __init__(self, car: CarParameters, settings: FallbackSettings | None = None) -> None:
        self._settings = settings or FallbackSettings()
        self._low = np.array([car.d_min, -car.delta_rate_max_radps])
        self._high = np.array([car.d_max, car.delta_rate_max_radps])
        self._plan: Array = NO_PLAN
        self._misses = 0
        self.counts = [0, 0, 0, 0]
        """Cycles so far by level."""

    def reset(self) -> None:
        """Forget the plan: it belongs to another run. The counts go on."""
        self._plan = NO_PLAN
        self._misses = 0

    def decide(self, output: StepOutput | None, vx_mps: float) -> tuple[float, float, Level]:
        """d, delta_rate and where they come from; ``output`` None: the step gave nothing."""
        chosen = None if output is None else self._accepted(output)
        if chosen is None:
            self._misses += 1
            chosen = self._step_down(vx_mps)
        self.counts[chosen[2]] += 1
        return chosen

    def _accepted(self, output: StepOutput) -> tuple[float, float, Level] | None:
        if output.status != 0:
            return None
        d, rate = float(output.u[0]), float(output.u[1])
        d_safe, rate_safe = self._limited(d, rate)
        # Explicitly, because max(0.0, nan) is 0.0: a NaN steering rate must not get through.
        if not (math.isfinite(d) and math.isfinite(rate)):
            return None
        if max(abs(d - d_safe), abs(rate - rate_safe)) > self._settings.tolerance:
            return None
        # The plan is kept only from solutions that were fit to be driven.
        if len(output.plan_u) and np.isfinite(output.plan_u).all():
            self._plan = output.plan_u.copy()
        else:
            self._plan = NO_PLAN
        self._misses = 0
        return d_safe, rate_safe, Level.SOLUTION

    def _step_down(self, vx_mps: float) -> tuple[float, float, Level]:
        """``_misses`` cycles after the last solution, whose plan's row 0 was driven then."""
        row = self._misses
        if row <= self._settings.shifted_cycles and row < len(self._plan):
            d, rate = self._limited(float(self._plan[row, 0]), float(self._plan[row, 1]))
            return d, rate, Level.SHIFTED_PLAN
        d = self._brake(vx_mps)
        rolling = vx_mps > self._settings.brake_fade_mps
        if rolling and row < len(self._plan):
            _, rate = self._limited(0.0, float(self._plan[row, 1]))
            return d, rate, Level.BRAKE
        return d, 0.0, Level.STOP

    def _brake(self, vx_mps: float) -> float:
        if not math.isfinite(vx_mps):
            return 0.0
        return float(self._low[0]) * min(max(vx_mps / self._settings.brake_fade_mps, 0.0), 1.0)

    def _limited(self, d: float, rate: float) -> tuple[float, float]:
        low, high = self._low, self._high
        return (
            min(max(d, float(low[0])), float(high[0])),
            min(max(rate, float(low[1])), float(high[1])),
        )
