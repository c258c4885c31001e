"""Delay compensation: the state at the moment from which the new input will act.

The plant tells, in its own time, how long after its basis each input began to act
(``State.answers``); the median of the newest ones is the delay. The input made now on the basis of
plant time t acts from t + delay on. Until then act the inputs that were sent before, each from its
own basis plus the delay on; the corrected model carries the state through them. No clocks have to
agree, and nothing is configured.
"""

from collections import deque
from collections.abc import Callable
from typing import Final, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from bayesrace.messages import State
from controller.interface import Array

__all__ = ["CompensationSettings", "DelayCompensator"]

_MEDIAN_OF: Final = 15
_HISTORY: Final = 1024
"""Inputs remembered: two seconds at 500 Hz, twice the longest prediction."""

Predict = Callable[[Array, Array, float], Array]
"""(x (7,), u (2,), duration [s]) to the state after it."""


class CompensationSettings(BaseModel):
    """Over which delay the state is predicted."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    mode: Literal["measured", "fixed", "off"] = Field(
        "measured", description="off: the state is taken as it is, as if everything were at once"
    )
    delay_s: float = Field(0.0, ge=0, le=1, description="delay from basis to acting if fixed")
    longest_s: float = Field(
        0.5, gt=0, le=1, description="no prediction goes farther; a longer delay is not covered"
    )


class DelayCompensator:
    """Keeps the measured delay and the inputs under way; see the module."""

    def __init__(self, settings: CompensationSettings, predict: Predict) -> None:
        self._settings = settings
        self._predict = predict
        self._delays_s: deque[float] = deque(maxlen=_MEDIAN_OF)
        self._sent: deque[tuple[float, float, float]] = deque(maxlen=_HISTORY)
        self._x = np.zeros(7)
        self._u = np.zeros(2)
        self.delay_s = settings.delay_s if settings.mode == "fixed" else 0.0
        """Delay from basis to acting that is compensated."""

    def reset(self) -> None:
        """Another run or plant: no input is under way; the delay is still the best guess."""
        self._sent.clear()

    def observe(self, state: State) -> None:
        """Takes note of the delays that the plant has measured."""
        if self._settings.mode != "measured":
            return
        acting_s = [delay_s for delay_s in state.answers[2::3] if delay_s >= 0]
        if acting_s:
            self._delays_s += acting_s
            ordered = sorted(self._delays_s)
            self.delay_s = min(ordered[(len(ordered) - 1) // 2], self._settings.longest_s)

    def sent(self, basis_s: float, d: float, delta_rate: float) -> None:
        """An input is on its way that was made on this basis (plant time)."""
        self._sent.append((basis_s, d, delta_rate))

    def as_measured(self, state: State) -> tuple[Array, Array]:
        """State (7,) and input (2,) as the plant told them, in the same arrays."""
        self._x[:] = state.x
        self._u[:] = state.u_applied
        return self._x, self._u

    def at_acting(self, state: State, basis_s: float) -> tuple[Array, Array]:
        """State (7,) when an input made on ``basis_s`` begins to act, and what acts just before.

        The arrays are overwritten by the next call.
        """
        x, u = self.as_measured(state)
        if self._settings.mode == "off":
            return x, u
        now_s = state.time_s
        while len(self._sent) > 1 and self._sent[1][0] + self.delay_s <= now_s:
            self._sent.popleft()  # has stopped acting
        end_s = min(basis_s + self.delay_s, now_s + self._settings.longest_s)
        for input_basis_s, d, delta_rate in self._sent:
            from_s = input_basis_s + self.delay_s
            if from_s >= end_s:
                break
            if from_s > now_s:
                x[:] = self._predict(x, u, from_s - now_s)
                now_s = from_s
            u[:] = d, delta_rate
        if end_s > now_s:
            x[:] = self._predict(x, u, end_s - now_s)
        return x, u
