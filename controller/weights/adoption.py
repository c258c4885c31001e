"""The control thread's part in new weights: it records states and adopts weights between cycles.

In real time nothing here decodes, compares, copies, waits or takes a lock. Nothing releases the
interpreter's lock or wakes another thread either: that would cost a hundred times the adoption.
"""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from bayesrace.errors import InputError
from bayesrace.messages import State
from bayesrace.vehicles import CarParameters
from controller.native_step import NativeStep
from controller.weights.states import ALL, SharedStates
from controller.weights.store import History, Store

__all__ = ["Adoption", "Offer", "WeightsPort"]

_PATIENCE_S: Final = 2.0
"""How long lockstep waits for the watch. Without waiting, one run would differ from the next."""
_POLL_S: Final = 5e-5


@dataclass
class WeightsPort:
    """What a predictive controller and its weights need of each other."""

    artefact: Path
    step: NativeStep
    car: CarParameters
    history: History
    store: Store | None = None


@dataclass(eq=False)
class Offer:
    """Staged weights; the control thread fills in what has become of them."""

    version: str
    revision: int
    """Of the weights in use: rises with each adoption, of new or of earlier ones."""
    watched: bool
    done: bool = False
    error: str = ""
    """Why they could not be adopted; else empty."""
    cycle: int = 0
    """First cycle that they can drive."""
    states: int = 0
    """States recorded before the adoption."""
    us: float = 0.0
    """Time that the adoption has taken."""


class Adoption:
    """Holds one offer at most: the update manager makes it, the control thread adopts it."""

    def __init__(self, states: SharedStates, adopt: Callable[[str], None], watched: bool) -> None:
        """``adopt`` puts what is staged into use, under its version's name. ``watched``: whether
        the weights in use are."""
        self._states, self._adopt = states, adopt
        self.record: Callable[[State, bool | None], None] = states.record
        self.offers: deque[Offer] = deque(maxlen=1)
        """The manager appends, and pops what the control thread does not take."""
        self.validator = False
        """The validator is running; set by the manager."""
        self._revision, self._watched = 0, watched
        self.newest_us = self.longest_us = 0.0
        self.missed = 0
        """Times that the watch did not keep up in lockstep."""

    def between_cycles(self, cycle: int, lockstep: bool = False) -> None:
        """Adopts what is offered; ``cycle``: number of the next one.

        In lockstep it lets the watch keep up first, as the plant lets the controller.
        """
        if lockstep and self._watched:
            self._wait_for_watch()
        if not self.offers:
            return
        begin_ns = time.perf_counter_ns()
        try:
            offer = self.offers.popleft()
        except IndexError:  # withdrawn at this moment
            return
        try:
            self._adopt(offer.version)
            self._revision, self._watched = offer.revision, offer.watched
        except InputError as error:
            offer.error = str(error)
        offer.cycle, offer.states = cycle, self._states.recorded
        self.newest_us = offer.us = (time.perf_counter_ns() - begin_ns) * 1e-3
        self.longest_us = max(self.longest_us, offer.us)
        offer.done = True

    def _wait_for_watch(self) -> None:
        """Until it has seen all states, or there is an offer: what it returns to, say."""
        recorded, deadline = self._states.recorded, time.monotonic() + _PATIENCE_S
        while self.validator and not self.offers:
            revision, seen, worse = self._states.progress
            if revision == self._revision and not worse and seen >= recorded:
                self._watched = seen < ALL
                return
            if time.monotonic() > deadline:
                self.missed, self._watched = self.missed + 1, False
                return
            time.sleep(_POLL_S)
