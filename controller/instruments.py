"""What instruments report, in words: rates, shares refused, and how well the car is known."""

import math
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from bayesrace.controller.estimator import Belief
from bayesrace.messages import State

__all__ = ["Instruments", "Measured"]

_PERIOD_S: Final = 1.0
"""Of plant time, over which is counted."""


class Measured(Protocol):
    """What is known of the newest state, as :class:`.Driver` has it."""

    @property
    def newest(self) -> State | None:
        """The newest state that counts."""

    @property
    def belief(self) -> Belief | None:
        """What it is estimated to be; None: it is measured, or nothing is known."""

    @property
    def instruments(self) -> dict[str, Any]:
        """What has become of the readings of each instrument: a br_instrument."""


class Instruments:
    """Those of one driver; for its thread."""

    def __init__(self, driver: Measured) -> None:
        self._driver = driver
        self._run, self._since_s, self._span_s = (-1, -1), 0.0, 0.0
        self._before: dict[str, NDArray[np.int64]] = {}
        self._during: dict[str, list[int]] = {}

    def words(self) -> str:
        """Of the newest state; empty if it is measured as it is."""
        newest, belief = self._driver.newest, self._driver.belief
        if newest is None or not newest.estimated:
            return ""
        self._count((newest.epoch, newest.run), newest.time_s)
        said = [self._said(name, *counts) for name, counts in self._during.items()]
        seen = ", ".join(said) or "no instrument counted yet"
        if belief is None:
            return f"{seen}; no position yet"
        x, y, psi = (math.sqrt(belief.covariance[i, i]) for i in range(3))
        known = f"±{1e3 * math.hypot(x, y):.1f} mm, ±{math.degrees(psi):.2f}°"
        return f"{seen}; position and heading {known}"

    def _count(self, run: tuple[int, int], time_s: float) -> None:
        """Takes what has been counted when a period is over; a run begins with a new one."""
        if (began := run != self._run) or time_s - self._since_s >= _PERIOD_S:
            counts = {
                name: np.array([one.used, one.refused, one.lost])
                for name, one in self._driver.instruments.items()
            }
            self._span_s = 0.0 if began else time_s - self._since_s
            self._during = {
                name: (one - self._before.get(name, 0)).tolist() for name, one in counts.items()
            }
            self._before, self._run, self._since_s = counts, run, time_s

    def _said(self, name: str, used: int, refused: int, lost: int) -> str:
        if not self._span_s:
            return name
        if not (total := used + refused + lost):
            return f"{name} silent"
        shares = [
            f"{100 * part / total:.1f} % {word}"
            for part, word in ((refused, "refused"), (lost, "too late"))
            if part
        ]
        rate = f"{name} {total / self._span_s:.0f} Hz"
        return f"{rate} ({', '.join(shares)})" if shares else rate
