"""Starts runs, follows and records them; what a log holds of a drive."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec.structs
import numpy as np
import zenoh

from bayesrace.errors import InputError
from bayesrace.log import LogReader
from bayesrace.messages import (
    ACTUATION,
    HEARTBEAT,
    STATE,
    TELEMETRY,
    Actuation,
    State,
    Status,
    car_key,
    decode,
)
from bayesrace.operation.run_plan import RunPlan, run_request
from bayesrace.recorder import Recorder
from bayesrace.tracks import Track
from bayesrace.transport import Director, Endpoints, open_session
from tests.programs import PATIENCE_S, until

__all__ = [
    "STANDING_MPS",
    "Journey",
    "Observer",
    "drive_on",
    "observing",
]

STANDING_MPS = 0.05
"""Speed below which a car counts as standing."""

_ENDLESS_S = 1e5


def drive_on(follower: "Observer", away_m: float = 0.8) -> None:
    """Waits until the car is that far from where it is now: it drives, and by itself."""
    until(lambda: bool(follower.state()), "a first state")
    begin = follower.state()["x"]
    until(lambda: math.dist(follower.state()["x"][:2], begin[:2]) > away_m, f"{away_m} m driven")


def _fields(message: Any) -> dict[str, Any]:
    return msgspec.structs.asdict(message)


class Observer:
    """Follows one car over an open session."""

    def __init__(self, session: Any, name: str, track: Track) -> None:
        self.director = Director(session, name)
        self._track = track
        self._newest = b""
        self._subscriber = session.declare_subscriber(
            car_key(STATE.key, name), zenoh.handlers.Callback(self._hear, indirect=False)
        )

    def _hear(self, sample: Any) -> None:
        self._newest = sample.payload.to_bytes() or self._newest

    def start(self, run: int) -> int:
        """Starts a run without end, in real time, once both processes are there."""
        self.director.wait_for(("plant", "controller"), PATIENCE_S)
        plan = RunPlan(run, "test", 1, _ENDLESS_S, lockstep=False)
        request = msgspec.structs.replace(run_request(self._track, plan), laps=0)
        self.director.start(request)
        return run

    def newest(self) -> State | None:
        """The newest state; None before the first."""
        return decode(STATE.message, self._newest) if self._newest else None

    def state(self) -> dict[str, Any]:
        """Its fields."""
        newest = self.newest()
        return {} if newest is None else _fields(newest)

    def status(self, source: str) -> dict[str, Any]:
        """Fields of the status."""
        try:
            return _fields(self.director.status(source))
        except InputError as error:
            return {"error": str(error)}

    def stop(self) -> None:
        """Ends the run."""
        self.director.stop("the test is over")


@contextmanager
def observing(endpoints: Sequence[str], name: str, track: Track, log: Path) -> Iterator[Observer]:
    """Follows and records from this process."""
    with open_session(Endpoints(connect=tuple(endpoints))) as session, Recorder(session, name, log):
        yield Observer(session, name, track)


class Journey:
    """The messages of a log in the order of arrival."""

    def __init__(self, log: Path, track: Track) -> None:
        reader = LogReader(log)
        self._track = track
        topics = (STATE, ACTUATION, TELEMETRY, HEARTBEAT)
        messages = [entry.message for entry in reader.messages(topics)]
        self.states = [one for one in messages if isinstance(one, State)]
        self.actuations = [one for one in messages if isinstance(one, Actuation)]
        self.heartbeats = [one for one in messages if isinstance(one, Status)]
        # Once in some hundred drives over a link that fails, the transport has delivered a garbled
        # telemetry message to the recorder; it is refused, as it should be.
        assert reader.refused <= 1, reader.last_reason
        assert not reader.truncated

    def between(self, begin_ns: int, end_ns: int) -> list[State]:
        """States sampled in this interval."""
        return [one for one in self.states if begin_ns <= one.source_time_ns < end_ns]

    def off_track_m(self, states: Sequence[State] | None = None) -> float:
        """How far outside of the track the car got at most (all states); negative inside."""
        chosen = self.states if states is None else states
        xy = np.array([state.x[:2] for state in chosen])
        return float(self._track.project_path(xy).off_track_m.max())

    def phases(self, begin_ns: int, end_ns: int) -> set[str]:
        """What the controller said of itself in this interval."""
        return {
            one.phase
            for one in self.heartbeats
            if one.source == "controller" and begin_ns <= one.source_time_ns < end_ns
        }
