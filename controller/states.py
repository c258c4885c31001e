"""Which states count: those of the plant and the run under way, each newer than the one before."""

from typing import Final

from bayesrace.messages import State
from bayesrace.transport import Numbering

__all__ = ["StateStream"]

_AHEAD: Final = 16
"""A number farther ahead than this is not taken for the next of the run under way at once."""
_AHEAD_S: Final = 0.3
"""The same as a time, where the interval of the states is known and this allows more of them ..."""
_FARTHEST: Final = 256
"""... but no more than these."""

_CONFIRMED: Final = 4
"""States in a row that belong together, and nothing else, are a stream of their own."""


class StateStream:
    """Takes states in the order of arrival and tells the new ones from the old and the foreign.

    A run is one stream: one plant (epoch), one run number, rising sequence numbers. A message that
    does not continue it is not driven on, so that no single one, whoever sent it, can lock out the
    plant: another stream is followed once the run has ended, once nothing has come for long, or
    once it has sent several states in a row while the former one was silent.
    """

    def __init__(self) -> None:
        self.newest: State | None = None
        self.stale = 0
        """States of the run under way that were not newer than one before."""
        self.foreign = 0
        """States of another plant or run, or with a number far ahead, that were not driven on."""
        self.interval_s = 0.0
        """Plant time between two states in a row; 0: not known."""
        self._numbering = Numbering()
        self._ended = self._silent = True
        self._other: State | None = None
        """The newest that did not continue the stream, and how many before it belong to it."""
        self._others = 0

    @property
    def received(self) -> int:
        """States received, foreign ones left out."""
        return self._numbering.received

    @property
    def lost(self) -> int:
        """States lost, by the gaps in their numbers."""
        return self._numbering.lost

    def accept(self, state: State) -> bool:
        """Whether this is now the newest state."""
        newest = self.newest
        same = newest is not None and (state.epoch, state.run) == (newest.epoch, newest.run)
        if not self._welcome(state) and not self._confirmed(state):
            self._refuse(state, same)
            return False
        if newest is not None and state.epoch != newest.epoch:
            self._numbering.restart()
        self._numbering.note(state.seq)
        if newest is not None and same and state.seq == newest.seq + 1:
            self.interval_s = max(state.time_s - newest.time_s, 0.0)
        elif not same:
            self.interval_s = 0.0
        self.newest, self._other, self._others = state, None, 0
        self._ended = self._silent = False
        return True

    def end(self) -> None:
        """The run is over, or its plant has gone: another may follow."""
        self._ended = True

    def forget(self) -> State | None:
        """Nothing has come for long: anything may follow.

        Returns the last state that was refused, if it is one of a lockstep run: its plant may still
        want an answer.
        """
        self._ended = self._silent = True
        self.interval_s = 0.0
        other, self._other = self._other, None
        return other if other is not None and other.lockstep else None

    def _welcome(self, state: State) -> bool:
        """Whether it continues the stream, or nothing speaks against another one."""
        newest = self.newest
        if newest is None or self._silent:
            return True
        if (state.epoch, state.run) != (newest.epoch, newest.run):
            return self._ended
        return self._follows(state, newest)

    def _confirmed(self, state: State) -> bool:
        """Whether it is the last of several in a row that are a stream of their own."""
        other = self._other
        belongs = (
            other is not None
            and (state.epoch, state.run) == (other.epoch, other.run)
            and self._follows(state, other)
        )
        self._others = self._others + 1 if belongs else 1
        self._other = state
        return self._others >= _CONFIRMED

    def _refuse(self, state: State, same: bool) -> None:
        if same and self.newest is not None and state.seq <= self.newest.seq:
            self.stale += 1
            self._numbering.note(state.seq)
        else:
            self.foreign += 1

    def _follows(self, state: State, before: State) -> bool:
        in_time = _AHEAD_S / self.interval_s if self.interval_s > 0 else 0.0
        return 0 < state.seq - before.seq <= min(max(in_time, _AHEAD), _FARTHEST)
