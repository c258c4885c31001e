"""What a log holds of a drive, on the clock of the machine that all processes share."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bayesrace.log import LogReader
from bayesrace.messages import ACTUATION, HEARTBEAT, STATE, TELEMETRY, Actuation, State, Status
from bayesrace.tracks import Track

__all__ = ["STANDING_MPS", "Journey"]

STANDING_MPS = 0.05
"""Speed below which a car counts as standing."""


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
