"""Samples of what the car did within one Ts, made of recorded states as they come."""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from controller.weights.states import StateRecord

__all__ = ["Sample", "Sampler"]

_LONGEST: Final = 5.0
"""Sampling times that a sample lasts at most; where states come seldom, each makes one."""


class Sample(NamedTuple):
    """The car went from ``x`` (7,) to ``x_next`` (7,) with the input ``u`` (2,), a mean."""

    recorded_ns: int
    duration_s: float
    x: npt.NDArray[np.float64]
    u: npt.NDArray[np.float64]
    x_next: npt.NDArray[np.float64]


class Sampler:
    """Joins consecutive states until they are a sampling time apart; a gap begins anew."""

    def __init__(self, step_s: float, moving_mps: float) -> None:
        """Leaves out samples that begin slower than ``moving_mps``."""
        self._step_s, self._moving_mps = step_s, moving_mps
        self._first: StateRecord | None = None
        self._last: StateRecord | None = None
        self._impulse = np.zeros(2)
        """Integral of the input since the first state."""

    def add(self, state: StateRecord) -> Sample | None:
        """The sample that this state completes, if any."""
        first, last, self._last = self._first, self._last, state
        if first is None or last is None or not _consecutive(last, state):
            self._first, self._impulse = state, np.zeros(2)
            return None
        self._impulse += (state.time_s - last.time_s) * np.array(state.u_applied)
        duration_s = state.time_s - first.time_s
        if duration_s < self._step_s * (1 - 1e-6):
            return None
        u = self._impulse / duration_s
        self._first, self._impulse = state, np.zeros(2)
        if first.x[3] < self._moving_mps or duration_s > _LONGEST * self._step_s:
            return None
        if abs(duration_s - self._step_s) < 1e-6 * self._step_s:
            duration_s = self._step_s  # for exactly one step the model takes no remainder
        return Sample(state.recorded_ns, duration_s, np.array(first.x), u, np.array(state.x))


def _consecutive(before: StateRecord, after: StateRecord) -> bool:
    same_run = (before.epoch, before.run) == (after.epoch, after.run)
    return same_run and after.seq == before.seq + 1 and after.time_s > before.time_s
