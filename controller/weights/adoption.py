"""The control thread's part in new weights: it records states and adopts weights between cycles.

In real time nothing here decodes, compares, copies more than a state, waits or takes a lock.
Nothing releases the interpreter's lock or wakes another thread either: that would cost a hundred
times the adoption.
"""

import math
import struct
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from bayesrace.errors import InputError
from bayesrace.messages import State
from bayesrace.vehicles import CarParameters
from bayesrace.vehicles.parts import GRAVITY_MPS2
from controller.interface import Environment
from controller.native_step import NativeStep
from controller.weights.prediction import StateRecord
from controller.weights.settings import GateSettings
from controller.weights.store import History, Store

__all__ = ["RECORDED", "Adoption", "Offer", "WeightsPort", "limits_at", "slowed_down"]

RECORDED: Final = 8192
"""States kept: 16 s at 500 Hz, which is more than the validator looks back."""
_RECORD: Final = struct.Struct("=5q10d2b")
"""One of them, packed: as objects they would take five times the memory, and the process would grow
for minutes."""

_PATIENCE_S: Final = 2.0
"""How long lockstep waits for the watch. Without waiting, one run would differ from the next."""
_POLL_S: Final = 5e-5

_BEND: Final = 5.0
"""Wheelbases: radius of the bend that a car still takes at its limit where it is slowed down."""


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
    """Staged weights; the control thread fills in the result of their adoption."""

    version: str
    keeps_limit: bool = False
    """The speed limit, if there is one, goes on: nothing better is known."""
    done: bool = False
    error: str = ""
    """Why they could not be adopted; else empty."""
    cycle: int = 0
    """First cycle that they can drive."""
    states: int = 0
    """States recorded before the adoption."""
    us: float = 0.0
    """Time that the adoption has taken."""


def slowed_down(settings: GateSettings, car: CarParameters, fastest_mps: float) -> Environment:
    """The limit of a car that has driven so fast with weights that are worse for it."""
    bend_m = _BEND * car.wheelbase_m
    least_mps = math.sqrt(car.friction * GRAVITY_MPS2 * bend_m)
    limit_mps = max(settings.slow_share * fastest_mps, least_mps)
    return Environment(limit_mps, car.tuning.driving.stop_mps2)


def limits_at(vx_mps: float, slow: Environment) -> Environment:
    """The limit in a cycle: a faster car slows down from its own speed."""
    if vx_mps > slow.speed_limit_mps:
        return slow._replace(speed_limit_mps=vx_mps)
    return slow._replace(speed_limit_rate_mps2=0.0)


class Adoption:
    """Holds one offer at most: the update manager makes it, the control thread adopts it."""

    def __init__(self, adopt: Callable[[str], None]) -> None:
        """``adopt`` puts what is staged into use, under its version's name."""
        self._adopt = adopt
        # Written once, so that all of it is resident from the start.
        self._states = bytearray(b"\xff") * (RECORDED * _RECORD.size)
        self.recorded = 0
        """Number of states recorded so far."""
        self.offers: deque[Offer] = deque(maxlen=1)
        """The manager appends, and pops what the control thread does not take."""
        self.validator = False
        """A validator works; set by the manager."""
        self.allowed = math.inf
        """Number of states up to which the watch lets lockstep go on; set by the manager."""
        self.slow: Environment | None = None
        """Largest speed with the weights in use, and how fast to slow down to it; set by the
        manager. None: no limit."""
        self.awaited_s = -math.inf
        """Monotonic clock when lockstep has waited for the watch."""
        self.longest_us = 0.0
        self.missed = 0
        """Times that the watch did not keep up in lockstep."""

    def record(self, state: State, fallen_back: bool | None) -> None:
        """Keeps a state; ``fallen_back``: see :class:`StateRecord`."""
        _RECORD.pack_into(
            self._states, self.recorded % RECORDED * _RECORD.size,
            self.recorded, state.epoch, state.run, state.seq, time.monotonic_ns(), state.time_s,
            *state.x, *state.u_applied, state.lockstep, -1 if fallen_back is None else fallen_back,
        )  # fmt: skip
        self.recorded += 1

    def limits(self, vx_mps: float) -> Environment | None:
        """What limits the car in the next cycle."""
        return None if self.slow is None else limits_at(vx_mps, self.slow)

    def states(self, begin: int, most: int) -> list[StateRecord]:
        """For the manager: at most so many states from number ``begin`` on, or the oldest kept."""
        begin = max(begin, self.recorded - RECORDED)
        numbers = range(begin, min(begin + most, self.recorded))
        return [self._state(number) for number in numbers]

    def _state(self, number: int) -> StateRecord:
        at = number % RECORDED * _RECORD.size
        number, epoch, run, seq, at_ns, time_s, *x_u, lockstep, fallen_back = _RECORD.unpack_from(
            self._states, at
        )
        known = None if fallen_back < 0 else bool(fallen_back)
        x, u = tuple(x_u[:7]), tuple(x_u[7:])
        return StateRecord(number, epoch, run, seq, time_s, at_ns, x, u, bool(lockstep), known)

    def between_cycles(self, cycle: int, lockstep: bool = False) -> None:
        """Adopts what is offered; ``cycle``: number of the next one.

        In lockstep it lets the watch keep up first, as the plant lets the controller.
        """
        if lockstep and self.allowed < self.recorded:
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
            self.allowed = -1
            self.slow = self.slow if offer.keeps_limit else None
        except InputError as error:
            offer.error = str(error)
        offer.cycle, offer.states = cycle, self.recorded
        offer.us = (time.perf_counter_ns() - begin_ns) * 1e-3
        self.longest_us = max(self.longest_us, offer.us)
        offer.done = True

    def _wait_for_watch(self) -> None:
        """Returns when the watch allows the next cycle, or when there is an offer."""
        self.awaited_s = time.monotonic()
        deadline = self.awaited_s + _PATIENCE_S
        while self.validator and not self.offers and self.allowed < self.recorded:
            if time.monotonic() > deadline:  # it is not waited for until it answers again
                self.missed, self.allowed = self.missed + 1, math.inf
            time.sleep(_POLL_S)
