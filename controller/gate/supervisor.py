"""Keeps a gatekeeper running: starts it, notices that it ended or hangs, starts the next one."""

import time
from collections.abc import Callable
from typing import Any, Final

from controller.gate.channel import Message
from controller.gate.link import Link

__all__ = ["Supervisor"]

_START_S: Final = 15.0
"""Until then a gatekeeper is there or something is wrong."""

_RESTART_S: Final = 1.0
_LONGEST_PAUSE_S: Final = 30.0
"""From an end to the next start, doubled for each that ends before it was ready: one that cannot
start must not keep a CPU busy beside the control loop."""

_LOOKS: Final = 4
"""Within the time after which it hangs."""


class Supervisor:
    """One gatekeeper after the other; for one thread, which calls :meth:`look` again and again.

    Whenever a method says that it is lost, ``text`` says why; the next one is started by itself.
    """

    def __init__(
        self,
        start: Callable[[], Link],
        alive_s: Callable[[], float],
        hang_s: float,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        """``start``: starts one and tells it where things stand; OSError if the system refuses.
        ``alive_s``: when, by ``clock_s``, the one that is ready last gave a sign of life; one
        silent for longer than ``hang_s`` is replaced."""
        self._start, self._alive_s, self._hang_s, self._clock_s = start, alive_s, hang_s, clock_s
        self._link: Link | None = None
        self._pause_s = _RESTART_S
        self._due_s = clock_s()
        """When the next one is to be started, or must be ready."""
        self.ready = False
        """It works."""
        self.text = ""
        """Why there is none; empty while one works, and before the first was lost."""
        self.starts = 0

    def fileno(self) -> int | None:
        """What to wait at for its messages; None while there is none."""
        return None if self._link is None else self._link.fileno()

    @property
    def patience_s(self) -> float:
        """How long nothing has to be looked after, as far as is known."""
        if self.ready:
            return self._hang_s / _LOOKS
        return max(self._due_s - self._clock_s(), 0.0)

    def look(self, may_start: bool = True) -> bool:
        """Does what is due; False if it is lost, or could not be started.

        ``may_start`` False puts the next start off.
        """
        now_s = self._clock_s()
        if self._link is None:
            return now_s < self._due_s or not may_start or self._started(now_s)
        if self.ready:
            if now_s - self._alive_s() > self._hang_s:
                self.lose(f"hung, without a sign of life for {self._hang_s:g} s")
        elif now_s > self._due_s:
            self.lose(f"was not ready within {_START_S:g} s")
        return self._link is not None

    def tell(self, kind: str, payload: bytes = b"", **fields: Any) -> None:
        """If there is one."""
        if self._link is not None:
            self._link.tell(kind, payload, **fields)

    def hear(self) -> Message | None:
        """What it says, once there is something to read; None if it is lost."""
        heard = None if self._link is None else self._link.hear()
        if heard is None:
            self.lose("ended or hung (killed, or by a fault)")
        elif heard[0]["kind"] == "ready":
            self.ready, self._pause_s, self.text = True, _RESTART_S, ""
        return heard

    def lose(self, what: str) -> None:
        """Ends it, and says ``what`` it did."""
        self.close()
        self._put_off(
            f"the gatekeeper {what}: weights in use stay and are not watched until it is there "
            "again"
        )

    def close(self) -> None:
        """Ends it."""
        if self._link is not None:
            self._link.close()
            self._link = None

    def _started(self, now_s: float) -> bool:
        try:
            self._link = self._start()
        except OSError as error:
            self._put_off(f"the gatekeeper cannot be started: {error.strerror or error}")
            return False
        self.starts += 1
        self._due_s = now_s + _START_S
        return True

    def _put_off(self, text: str) -> None:
        """Until the next start; the longer, the more often there was none that worked."""
        self._pause_s = _RESTART_S if self.ready else min(2 * self._pause_s, _LONGEST_PAUSE_S)
        self._due_s = self._clock_s() + self._pause_s
        self.ready, self.text = False, text
