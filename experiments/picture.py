"""What is known of the cars in a network at one moment, and its form as JSON.

What ``bayesrace status --json`` prints is one object, ``{"cars": {NAME: {"plant": P, "controller":
P}}}``, where P is null if no such process is there, and otherwise holds, always:

- ``answering``: it has sent its status; all from ``phase`` on is null if not;
- ``fault``: why not, or null;
- ``processes``: how many answered under this name; more than one is a mistake;
- ``status_age_s``: since the status arrived here [s];
- ``phase``, ``epoch``, ``run``, ``text``, ``weights_version``, ``delay_s``: as in the message
  :class:`~bayesrace.messages.Status`;
- ``rate_hz``: of the loop, null in lockstep;
- ``state_age_s``: since the process received (controller) or sent (plant) its newest state [s],
  null before the first;
- ``counters``: name to number, everything counted since the process started.

With ``--watch`` there is a line for each heartbeat, about the car whose process it came from.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from bayesrace.messages import Status

__all__ = ["SOURCES", "Picture", "Process"]

SOURCES: Final = ("plant", "controller")
"""Processes that a car consists of."""

_SILENT_S: Final = 1.0
"""A process without a heartbeat for this long, ten of them, counts as not answering."""


@dataclass(frozen=True)
class Process:
    """What is known of a process that is there."""

    status: Status | None = None
    fault: str = ""
    """Why there is no status."""
    processes: int = 0
    """How many answered."""
    arrived_s: float = field(default_factory=time.monotonic)
    """Monotonic clock when the status arrived, or was missed."""

    def as_json(self, now_s: float) -> dict[str, Any]:
        """See the text of this module."""
        status = self.status
        known: dict[str, Any] = dict.fromkeys(
            ("phase", "epoch", "run", "text", "weights_version", "rate_hz", "state_age_s")
        )
        known |= {"delay_s": None, "counters": None}
        if status is not None:
            known = {name: getattr(status, name) for name in known}
            known["rate_hz"] = status.rate_hz or None
            known["state_age_s"] = None if status.state_age_s < 0 else status.state_age_s
            known["counters"] = dict(status.counters)
        return {
            "answering": status is not None,
            "fault": self.fault or None,
            "processes": self.processes,
            "status_age_s": round(max(now_s - self.arrived_s, 0.0), 4),
            **known,
        }


class Picture:
    """All cars as known at the moment."""

    def __init__(self, cars: Mapping[str, Mapping[str, Process]]) -> None:
        self.cars: dict[str, dict[str, Process]] = {car: dict(cars[car]) for car in sorted(cars)}

    @property
    def answering(self) -> bool:
        """Whether any process has sent its status."""
        return any(one.status for processes in self.cars.values() for one in processes.values())

    def put(self, car: str, source: str, process: Process | None) -> None:
        """What is new of a process; None: it is gone."""
        processes = self.cars.setdefault(car, {})
        if process is None:
            processes.pop(source, None)
        else:
            processes[source] = process
        if not processes:
            del self.cars[car]

    def silence(self, now_s: float) -> None:
        """Takes the status from those that have not sent it for a while."""
        for processes in self.cars.values():
            for source, one in processes.items():
                if one.status is not None and now_s - one.arrived_s > _SILENT_S:
                    processes[source] = Process(None, "silent", 0, one.arrived_s)

    def as_json(self, only: str | None = None) -> dict[str, Any]:
        """See the text of this module; ``only``: one car."""
        now_s = time.monotonic()
        names = sorted(self.cars) if only is None else [only]
        return {
            "cars": {
                car: {
                    source: _json(self.cars.get(car, {}).get(source), now_s) for source in SOURCES
                }
                for car in names
            }
        }


def _json(process: Process | None, now_s: float) -> dict[str, Any] | None:
    return None if process is None else process.as_json(now_s)
