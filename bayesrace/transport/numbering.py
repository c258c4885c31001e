"""Counting what a numbered stream of messages has lost on its way."""

__all__ = ["Numbering"]


class Numbering:
    """Received and lost messages of one sender, by their numbers.

    A message that was overtaken counts as lost until it arrives after all. A sender that begins
    again at 0 starts afresh; what was under way from before then counts as received alone.
    """

    def __init__(self) -> None:
        self.received = 0
        self.lost = 0
        self._next: int | None = None

    def note(self, seq: int) -> None:
        """The next message, in the order of arrival."""
        self.received += 1
        if self._next is None or seq == 0:
            self._next = seq + 1
        elif seq >= self._next:
            self.lost += seq - self._next
            self._next = seq + 1
        elif self.lost > 0:
            self.lost -= 1
