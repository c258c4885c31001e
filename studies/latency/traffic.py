"""Messages sent, received and lost: the sender's numbers against the receiver's counters.

A heartbeat of the receiver carries what it had received and counted as lost until then; what had
been sent until then follows from the numbers and times in the log. Messages are counted between two
heartbeats, of the first and of the last second, at which the fewest were in flight.
"""

from typing import Final

import numpy as np

from bayesrace.arrays import Floats
from studies.latency.clocks import ClockMap
from studies.latency.columns import Columns, Tables, begins_anew

__all__ = ["heartbeats", "traffic"]


_SECOND: Final = 10
"""Heartbeats in a second."""


def traffic(tables: Tables, clock: ClockMap) -> dict[str, float]:
    """``states_sent``, ``…_received``, ``…_lost``, ``actuations_sent`` and so on; of a direction
    without heartbeats nothing."""
    states, actuations = tables["states"], tables["actuations"]
    actuations = actuations[actuations["state"] >= states["seq"][0]]  # none of the warm-up
    plant, controller = (heartbeats(tables, one) for one in (False, True))
    at = clock.to_plant(controller["sent"])
    found = _counted("states", states["seq"], states["sampled"], controller, at)
    at = clock.to_plant(actuations["sent"])
    return found | _counted("actuations", actuations["seq"], at, plant, plant["sent"])


def heartbeats(tables: Tables, controller: bool) -> Columns:
    """Those of one process, up to a restart of it: its counters begin anew there."""
    beats = tables["heartbeats"]
    beats = beats[beats["controller"] == controller]
    return np.split(beats, np.flatnonzero(begins_anew(beats)) + 1)[0]


def _counted(
    stream: str, numbers: Floats, sent_at: Floats, beats: Columns, at: Floats
) -> dict[str, float]:
    """``sent_at`` of the messages and ``at`` of the receiver's heartbeats are on one clock."""
    before = np.searchsorted(sent_at, at, side="right")
    inside = (before > 0) & (before < len(sent_at))
    if not inside.any():
        return {}
    sent, beats = numbers[before[inside] - 1], beats[inside]
    left = sent - beats["received"] - beats["lost"]
    begin, end = left[:_SECOND].argmin(), len(left) - 1 - left[::-1][:_SECOND].argmin()
    columns = {"sent": sent, "received": beats["received"], "lost": beats["lost"]}
    return {f"{stream}_{name}": one[end] - one[begin] for name, one in columns.items()}
