"""The known state of the cars in a network, and its form as JSON.

What ``bayesrace status --json`` prints is one object, ``{"cars": {NAME: {"plant": P, "controller":
P}}}``, where P is null if no such process is there, and otherwise holds, always:

- ``answering``: its status is known; all from ``phase`` on is null if not;
- ``fault``: why it is not, or null;
- ``processes``: how many answer under this name; more than one is a mistake;
- ``status_age_s``: since the status arrived here [s];
- ``phase``, ``epoch``, ``run``, ``text``, ``weights_version``, ``track``, ``delay_s``: as in the
  message :class:`~bayesrace.messages.Status`;
- ``rate_hz``: of the loop, null in lockstep;
- ``state_age_s``: since the process received (controller) or sent (plant) its newest state [s],
  null before the first;
- ``counters``: name to number, all counters since the process started.

With ``--watch`` there is a line for each heartbeat, about the car that it came from.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from bayesrace.messages import Status

__all__ = ["SOURCES", "NetworkStatus", "ProcessStatus"]

SOURCES: Final = ("plant", "controller")
"""Processes that a car consists of."""

_SILENT_S: Final = 1.0
"""A process without a heartbeat for this long, ten periods, counts as not answering."""


@dataclass(frozen=True)
class ProcessStatus:
    """What is known of a present process."""

    status: Status | None = None
    fault: str = ""
    """Why there is no status."""
    processes: int = 0
    """How many answered."""
    arrived_s: float = field(default_factory=time.monotonic)
    """Monotonic clock when the status arrived, or was missed."""

    def as_json(self, now_s: float) -> dict[str, Any]:
        """JSON as in the docstring of this module."""
        status = self.status
        known: dict[str, Any] = dict.fromkeys(
            ("phase", "epoch", "run", "text", "weights_version", "track", "rate_hz", "state_age_s")
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


class NetworkStatus:
    """All cars as known now."""

    def __init__(self, cars: Mapping[str, Mapping[str, ProcessStatus]]) -> None:
        self.cars: dict[str, dict[str, ProcessStatus]] = {
            car: dict(cars[car]) for car in sorted(cars)
        }

    @property
    def answering(self) -> bool:
        """Whether the status of any process is known."""
        return any(one.status for processes in self.cars.values() for one in processes.values())

    def put(self, car: str, source: str, process: ProcessStatus | None) -> None:
        """Update a process; None: it is gone."""
        processes = self.cars.setdefault(car, {})
        if process is None:
            processes.pop(source, None)
        else:
            processes[source] = process
        if not processes:
            del self.cars[car]

    def expire(self, now_s: float) -> None:
        """Drop each status whose process sends no heartbeats any more."""
        for processes in self.cars.values():
            for source, one in processes.items():
                if one.status is not None and now_s - one.arrived_s > _SILENT_S:
                    fault = f"no heartbeat for {_SILENT_S:g} s"
                    processes[source] = ProcessStatus(None, fault, 0, one.arrived_s)

    def as_json(self, only: str | None = None) -> dict[str, Any]:
        """JSON as in the docstring of this module; ``only``: one car."""
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


def _json(process: ProcessStatus | None, now_s: float) -> dict[str, Any] | None:
    return None if process is None else process.as_json(now_s)
