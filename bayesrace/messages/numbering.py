"""How losses of messages are counted: by the numbers that their sender gives them."""

from typing import Final

__all__ = ["Numbering"]

_FAR: Final = 1024
"""Reordering is shorter, and so are most losses: a number farther from the expected one, or 0,
counts once the next one confirms it."""


class Numbering:
    """Received and lost messages of one sender.

    A late message counts as lost until it arrives. A restarted sender begins a new count. A single
    number far off does not change the losses.
    """

    def __init__(self) -> None:
        self.received = 0
        self.lost = 0
        self._next: int | None = None
        self._far: int | None = None
        """Number of the previous message, if it waits to be confirmed."""

    def restart(self) -> None:
        """Take the next number, whatever it is, as the first of another sender."""
        self._next = self._far = None

    def note(self, seq: int) -> None:
        """Count the next message, in the order of arrival."""
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
