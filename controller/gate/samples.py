"""Samples of what the car did within one Ts, made of states as they come."""

from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from controller.gate.memory import Noted

__all__ = ["Sample", "Sampler"]

_LONGEST: Final = 5.0
"""Sampling times that a sample lasts at most: where states come seldom, each makes one."""


class Sample(NamedTuple):
    """The car went from ``x`` to ``x_next`` with input ``u``, the mean of what acted."""

    number: int
    """Number of the state that ended it."""
    at_ns: int
    duration_s: float
    x: npt.NDArray[np.float64]
    u: npt.NDArray[np.float64]
    x_next: npt.NDArray[np.float64]


class Sampler:
    """Joins states in a row until they are a sampling time apart; a gap begins anew."""

    def __init__(self, step_s: float, moving_mps: float) -> None:
        """Samples that begin slower than ``moving_mps`` are left out."""
        self._step_s, self._moving_mps = step_s, moving_mps
        self._first: Noted | None = None
        self._last: Noted | None = None
        self._pushed = np.zeros(2)

    def add(self, noted: Noted) -> Sample | None:
        """The sample that this state completes, if it does."""
        first, last, self._last = self._first, self._last, noted
        if first is None or last is None or not _in_a_row(last, noted):
            self._begin(noted)
            return None
        self._pushed += (noted.time_s - last.time_s) * np.array(noted.u_applied)
        duration_s = noted.time_s - first.time_s
        if duration_s < self._step_s * (1 - 1e-6):
            return None
        u = self._pushed / duration_s
        self._begin(noted)
        if first.x[3] < self._moving_mps or duration_s > _LONGEST * self._step_s:
            return None
        if abs(duration_s - self._step_s) < 1e-6 * self._step_s:
            duration_s = self._step_s  # else the model takes another way
        x, x_next = np.array(first.x), np.array(noted.x)
        return Sample(noted.number, noted.at_ns, duration_s, x, u, x_next)

    def _begin(self, noted: Noted) -> None:
        self._first = noted
        self._pushed = np.zeros(2)


def _in_a_row(before: Noted, after: Noted) -> bool:
    same_drive = (before.epoch, before.run) == (after.epoch, after.run)
    return same_drive and after.seq == before.seq + 1 and after.time_s > before.time_s
