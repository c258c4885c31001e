"""Messages sent, received and lost: the sender's numbers against the receiver's counters.

A heartbeat of the receiver says what it had received and counted as lost until then; what had been
sent until then follows from the numbers and times in the log. Messages are counted between two
heartbeats, of the first and of the last second, at which the fewest were in flight.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from experiments.latency.clocks import ClockMap
from experiments.latency.columns import Columns, Tables, fallen
from experiments.latency.results import Traffic

__all__ = ["heartbeats", "traffic"]

Ints = NDArray[np.int64]

_SECOND: Final = 10
"""Heartbeats in a second."""

_IN_FLIGHT: Final = 2
"""So many messages more at the one end than at the other may be in flight."""


def traffic(parts: Sequence[tuple[Tables, ClockMap]]) -> dict[str, Traffic]:
    """Each direction, all parts of a log together; nothing without heartbeats."""
    counted: dict[str, list[Ints]] = {"states": [], "actuations": []}
    for tables, clock in parts:
        plant, controller = (heartbeats(tables, one) for one in (False, True))
        states, actuations = tables["states"], tables["actuations"]
        actuations = actuations[actuations["state"] >= states["seq"][0]]  # none of the warm-up
        at = clock.to_plant(controller["sent"])
        counted["states"] += _count(states["seq"], states["sampled"], controller, at)
        at = clock.to_plant(actuations["sent"])
        counted["actuations"] += _count(actuations["seq"], at, plant, plant["sent"])
    found = {}
    for name, counts in counted.items():
        if counts:
            sent, received, lost = np.sum(counts, axis=0).tolist()
            left = sent - received - lost
            complete = abs(left) <= len(counts) * _IN_FLIGHT
            found[name] = Traffic(
                sent=sent, received=received, lost=lost, in_flight=left, complete=complete
            )
    return found


def heartbeats(tables: Tables, controller: bool) -> Columns:
    """Those of one process, up to a restart of it: its counters begin anew there."""
    beats = tables["heartbeats"]
    beats = beats[beats["controller"] == controller]
    return np.split(beats, np.flatnonzero(fallen(beats)) + 1)[0]


def _count(numbers: Ints, sent_at: Ints, beats: Columns, at: Ints) -> list[Ints]:
    """Sent, received, lost, if there are heartbeats between the messages.

    ``sent_at`` of the messages and ``at`` of the receiver's heartbeats are on one clock.
    """
    before = np.searchsorted(sent_at, at, side="right")
    inside = (before > 0) & (before < len(sent_at))
    if not inside.any():
        return []
    sums = np.array([numbers[before[inside] - 1], beats["received"][inside], beats["lost"][inside]])
    left = sums[0] - sums[1] - sums[2]
    begin, end = left[:_SECOND].argmin(), len(left) - 1 - left[::-1][:_SECOND].argmin()
    return [sums[:, end] - sums[:, begin]]
