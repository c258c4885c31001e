"""Counting what a numbered stream of messages has lost on its way."""

from typing import Final

__all__ = ["Numbering"]

_FAR: Final = 1024
"""No message is overtaken by more, and few losses are longer: a number farther from the one that is
due, either way, or 0, counts once the next one confirms it."""


class Numbering:
    """Received and lost messages of one sender, by their numbers.

    A message that was overtaken counts as lost until it arrives after all. A sender that begins
    again starts afresh. A single number far off does not change the losses.
    """

    def __init__(self) -> None:
        self.received = 0
        self.lost = 0
        self._next: int | None = None
        self._far: int | None = None
        """Number of the message before, if it waits to be confirmed."""

    def restart(self) -> None:
        """Whatever number comes next is the first of another sender."""
        self._next = self._far = None

    def note(self, seq: int) -> None:
        """The next message, in the order of arrival."""
        self.received += 1
        far, self._far = self._far, None
        due = self._next
        if due is None:
            self._next = seq + 1
        elif far is not None and seq == far + 1 != due:
            self.lost += max(seq - due - 1, 0)
            self._next = seq + 1
        elif abs(seq - due) > _FAR or seq == 0:
            self._far = seq
        elif seq >= due:
            self.lost += seq - due
            self._next = seq + 1
        elif self.lost > 0:
            self.lost -= 1
