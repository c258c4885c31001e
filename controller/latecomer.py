"""A controller that joins late asks others of its car for what they have accepted."""

import time
from typing import Any, Final

from bayesrace.messages import ACCEPTED
from bayesrace.transport import fetch

__all__ = ["Latecomer"]

_ASK_S: Final = (0.2, 1.0, 3.0)
"""When, after the start: connections take a moment, and then there is nobody."""


class Latecomer:
    """Asks a few times, until somebody has an answer or there is no need any more."""

    def __init__(self, session: Any, name: str, needed: bool) -> None:
        self._session, self._name = session, name
        self._begin_s = time.monotonic()
        self._due_s = list(_ASK_S) if needed else []

    @property
    def asking(self) -> bool:
        """Whether there is a question left."""
        return bool(self._due_s)

    def ask(self) -> bytes:
        """The weights file of another controller, if it is time to ask and one has any."""
        if not self._due_s or time.monotonic() - self._begin_s < self._due_s[0]:
            return b""
        self._due_s.pop(0)
        data = fetch(self._session, ACCEPTED, self._name)
        if data:
            self.stop()
        return data

    def stop(self) -> None:
        """It has weights."""
        self._due_s.clear()
