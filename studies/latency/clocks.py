"""The clock of the controller in terms of the plant's, measured by the control messages themselves.

A state and its answer are an exchange of four timestamps, as in NTP (RFC 5905, section 8): the
plant samples, the controller receives and later sends the answer, and the plant receives that.
Neither message arrives before it was sent, so the offset between both clocks is bounded from both
sides: the middle is wrong by at most half of the round trip less the controller's own time, however
unequal the two ways are. An exchange counts if none near it bounds the offset at its time more
closely, drift included. Between two that count the offset is interpolated, so the truth stays
within the bounds as long as the clocks run evenly from one to the next.
"""

from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from bayesrace.arrays import Floats

__all__ = ["ClockMap"]


_DRIFT: Final = 200e-6
"""Of one clock against another at most: quartz is within 100 ppm on either side."""


@dataclass(frozen=True, eq=False)
class ClockMap:
    """The offset of the controller's clock, controller minus plant, at some times [ns]."""

    shared: bool
    """It is one clock: no exchange contradicts an offset of zero."""
    exchanges: int
    uncertainty: float
    """The largest of the run, from the first exchange to the last one; 0 if shared."""
    at: Floats
    """Controller's clock, rising."""
    offset: Floats

    @classmethod
    def of(cls, sampled: Floats, received: Floats, sent: Floats, arrived: Floats) -> Self | None:
        """The map that exchanges give, in the order of their four times: the first and the last one
        by the plant's clock, the others by the controller's. None without any."""
        if not len(received):
            return None
        order = np.argsort(received, kind="stable")
        at, most, least = received[order], (received - sampled)[order], (sent - arrived)[order]
        shared = bool((most >= 0).all() and (least <= 0).all())
        # The clocks run apart also during an exchange.
        half = (most - least) / 2 + _DRIFT * (arrived - sampled)[order]
        drifted = _DRIFT * (at - at[0])
        before = np.minimum.accumulate(half - drifted) + drifted
        after = np.minimum.accumulate((half + drifted)[::-1])[::-1] - drifted
        bound = np.minimum(before, after) + 1.0
        best = half <= bound
        offset = (most + least)[best] / 2
        return cls(shared, len(at), 0.0 if shared else float(bound.max()), at[best], offset)

    def to_plant(self, controller: Floats) -> Floats:
        """Readings of the controller's clock in terms of the plant's."""
        offset = 0.0 if self.shared else np.interp(controller, self.at, self.offset)
        return np.asarray(controller - offset)
