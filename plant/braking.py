"""The braking plan: what the car does by itself when no actuation comes any more.

The controller sends it ahead after each cycle (:class:`bayesrace.messages.BrakingPlan`); the guard
carries it out row by row, in plant time. Steering angles, not rates, are kept: they do not depend
on when the plan takes over.
"""

from typing import Final

import numpy as np

from bayesrace.messages import BrakingPlan

__all__ = ["Planned", "planned_at"]

_EARLY: Final = 2.0
"""Rows by which a plan may lie in the future when it takes over."""


class Planned:
    """A command that depends on the steering angle at which it begins to act."""

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
