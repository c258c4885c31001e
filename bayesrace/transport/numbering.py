"""Counting what a numbered stream of messages has lost on its way."""

from typing import Final

__all__ = ["Numbering"]

_OVERTAKEN: Final = 1024
"""No message is overtaken by more: a number farther back is that of a sender that began again."""


class Numbering:
    """Received and lost messages of one sender, by their numbers.

    A message that was overtaken counts as lost until it arrives after all. A sender that begins
    again starts afresh.
    """

    def __init__(self) -> None:
        self.received = 0
        self.lost = 0
        self._next: int | None = None

    def restart(self) -> None:
        """Whatever number comes next is the first of another sender."""
        self._next = None

    def note(self, seq: int) -> None:
        """The next message, in the order of arrival."""
        self.received += 1
        if self._next is None or seq == 0 or seq < self._next - _OVERTAKEN:
            self._next = seq + 1
        elif seq >= self._next:
            self.lost += seq - self._next
            self._next = seq + 1
        elif self.lost > 0:
            self.lost -= 1
