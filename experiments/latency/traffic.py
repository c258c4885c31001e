"""Messages sent, received and lost, by the counters of both processes."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from bayesrace.messages import Status
from experiments.latency.results import Traffic

__all__ = ["STREAMS", "Counted", "counted", "numbers", "traffic"]

STREAMS: Final = {"states": ("plant", "controller"), "actuations": ("controller", "plant")}
"""Direction to sender and receiver; the counters are named after the direction."""


@dataclass(frozen=True)
class Counted:
    """How far counters went between two answers of a process."""

    counters: Mapping[str, int]
    restarted: bool
    """The process began anew: what it counted before that is not known."""

    def __getitem__(self, name: str) -> int:
        return self.counters.get(name, 0)


def counted(begin: Status, end: Status) -> Counted:
    """The difference of two answers of one process."""
    before, after = numbers(begin), numbers(end)
    restarted = any(after.get(name, 0) < value for name, value in before.items())
    if restarted:
        before = {}
    return Counted({name: after[name] - before.get(name, 0) for name in after}, restarted)


def numbers(status: Status) -> dict[str, int]:
    """The counters of a process."""
    return {name: value for name, value in status.counters.items() if type(value) is int}


def traffic(
    by: Mapping[str, Counted], rate_hz: float = 0.0, apart_s: float = 0.0
) -> dict[str, Traffic]:
    """Each direction by itself.

    ``apart_s``: for counters read while messages are under way, time between reading the one
    process's and the other's, both ends added up; what could be sent meanwhile may differ.
    """
    most = math.ceil(rate_hz * apart_s)
    found = {}
    for name, (sender, receiver) in STREAMS.items():
        sent = by[sender][f"{name}_sent"]
        received, lost = by[receiver][f"{name}_received"], by[receiver][f"{name}_lost"]
        in_flight = sent - received - lost
        found[name] = Traffic(
            sent=sent,
            received=received,
            lost=lost,
            in_flight=in_flight,
            complete=abs(in_flight) <= most,
        )
    return found
