"""Which states count: those of the plant and the run under way, each newer than the one before."""

from collections import deque

from bayesrace.messages import State
from bayesrace.transport import Numbering

__all__ = ["StateStream"]


class StateStream:
    """Takes states in the order of arrival and tells the new ones from the old.

    A plant that was restarted has another epoch, so its low sequence numbers are new; what is left
    of the former plant's messages is stale from then on.
    """

    def __init__(self) -> None:
        self.newest: State | None = None
        self.stale = 0
        """States that were not newer than one before, or of a plant that has been replaced."""
        self.interval_s = 0.0
        """Plant time between two states in a row; 0: not known."""
        self._numbering = Numbering()
        self._replaced: deque[int] = deque(maxlen=16)

    @property
    def received(self) -> int:
        """States received."""
        return self._numbering.received

    @property
    def lost(self) -> int:
        """States lost, by the gaps in their numbers."""
        return self._numbering.lost

    def accept(self, state: State) -> bool:
        """Whether this is now the newest state."""
        newest = self.newest
        if state.epoch in self._replaced:
            self.stale += 1
            return False
        if newest is not None and state.epoch != newest.epoch:
            self._numbering.restart()
        self._numbering.note(state.seq)
        if newest is not None and state.epoch == newest.epoch:
            if state.seq <= newest.seq:
                self.stale += 1
                return False
            if state.run == newest.run and state.seq == newest.seq + 1:
                self.interval_s = max(state.time_s - newest.time_s, 0.0)
        elif newest is not None:
            self._replaced.append(newest.epoch)
            self.interval_s = 0.0
        self.newest = state
        return True

    def forget(self) -> None:
        """Nothing has come for long, so nothing is left over: any plant may be the next."""
        self._replaced.clear()
        self.interval_s = 0.0
