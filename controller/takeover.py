"""The control thread's part in new weights: notes states for the gate, takes over between cycles.

Nothing here decodes, checks, copies or waits while the car drives by the wall clock: that is done
by :mod:`controller.courier`, another thread, and :mod:`controller.gatekeeper`, another process.
"""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from bayesrace.errors import InputError
from bayesrace.messages import State
from bayesrace.vehicles import CarParameters
from controller.gate.memory import ALL_SEEN, Memory
from controller.gate.store import Accepted
from controller.native_step import NativeStep

__all__ = ["Offer", "Takeover", "WeightsPort"]

_PATIENCE_S: Final = 2.0
"""Lockstep: how long the watch is waited for. Without, one run would differ from the next."""

_LOOK_S: Final = 5e-5


@dataclass
class WeightsPort:
    """What a predictive controller has to do with weights: where they go, what is there already."""

    artefact: Path
    step: NativeStep
    car: CarParameters
    history: list[Accepted]
    """Oldest first, the ones in use last; never empty."""
    next_number: int = 1
    withdrawn: list[str] = field(default_factory=list)
    """Digests of what is not to be taken again."""
    store: Path | None = None


@dataclass(eq=False)
class Offer:
    """Staged weights; the control thread fills in when it took them over."""

    version: str
    number: int
    kind: str
    """weights: sent; previous: back on request; give_up: back because of the watch."""
    watched: bool
    """The watch looks at what they predict."""
    text: str = ""
    cycle: int = -1
    """First cycle that they can drive; -1: they could not be taken."""
    noted: int = 0
    """States noted before."""


class Takeover:
    """For the control thread; the courier puts offers in, and looks for what has been taken.

    Nothing here gives the interpreter's lock away, or wakes another thread: that would cost a
    hundred times what the takeover does.
    """

    def __init__(self, memory: Memory, adopt: Callable[[str], None]) -> None:
        """``adopt``: puts what is staged into use under its version's name."""
        self._memory, self._adopt = memory, adopt
        self.note: Callable[[State, bool | None], None] = memory.note
        """Keeps a state for the gate."""
        self.offers: deque[Offer] = deque()
        self.taken: deque[Offer] = deque()
        self.gatekeeper = False
        """It runs; kept by the courier."""
        self.watching = False
        """Whether those in use are watched; for lockstep, where one waits for it."""
        self.taken_us = self.longest_us = 0.0
        """What the newest takeover, and the longest one, cost the control thread."""
        self.unwatched = 0
        """Lockstep: how often the watch did not keep up."""

    def between_cycles(self, cycle: int) -> None:
        """Takes over what is offered; ``cycle``: number of the next one."""
        if self.offers:
            self._take(cycle)

    def in_lockstep(self, cycle: int) -> None:
        """The same; and lets the watch keep up, as the plant lets the controller."""
        if self.offers:
            self._take(cycle)
        elif self.watching:
            self._wait_for_watch(cycle)

    def _take(self, cycle: int) -> None:
        begin_ns = time.perf_counter_ns()
        try:
            offer = self.offers.popleft()
        except IndexError:  # withdrawn at this moment
            return
        try:
            self._adopt(offer.version)
            offer.cycle = cycle
            self.watching = offer.watched
        except InputError as error:
            offer.text = str(error)
        offer.noted = self._memory.noted
        self.taken_us = (time.perf_counter_ns() - begin_ns) * 1e-3
        self.longest_us = max(self.longest_us, self.taken_us)
        self.taken.append(offer)

    def _wait_for_watch(self, cycle: int) -> None:
        noted, deadline = self._memory.noted, time.monotonic() + _PATIENCE_S
        while self.gatekeeper:
            if self.offers:  # what it wants to go back to, or something newer
                return self._take(cycle)
            seen, goes_back = self._memory.watched
            if seen >= ALL_SEEN:
                self.watching = False
                return None
            if seen >= noted and not goes_back:
                return None
            if time.monotonic() > deadline:
                self.unwatched += 1
                self.watching = False
                return None
            time.sleep(_LOOK_S)
        return None
