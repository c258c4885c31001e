"""A real car behind the plant process: its instruments in plant time, and commands as they come.

Who has such a car writes a subclass of :class:`Hardware` that speaks the car's own protocol
(examples/mocap_car/mocap_plant.py). All else is as for a simulated car: guard, braking plan, runs,
laps.
"""

import logging
import math
import threading
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Mapping
from typing import Final, NamedTuple, Self

import msgspec
import numpy as np

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.integrators import PLANT_SUBSTEP_HZ
from bayesrace.messages import MOST_READINGS, Reading
from bayesrace.plant.vehicle import Command, Vehicle
from bayesrace.vehicles.parameters import Car

__all__ = ["Hardware", "Report"]

_log = logging.getLogger("bayesrace.plant")

_AGAIN_S: Final = 0.1
"""After a report that could not be received."""
_WINDOW_NS: Final = 5_000_000_000
"""For so long the least delay of a clock counts: clocks drift apart by up to 0.1 ms a second."""
_RESTARTED_NS: Final = 1_000_000_000
"""A delay that is longer by this is a clock that has been set anew."""
_LATEST_S: Final = 1e9
"""A clock that is farther from 0 is none."""
_POSE: Final = ("x", "y", "psi")
_POSES: Final = 12
"""Newest poses, by which the speed is known ..."""
_EACH: Final = 3
"""... and how many of them are one point: their median is no outlier."""
_SENT: Final = 100
"""Commands by which is known what has acted."""
_AHEAD: Final = (0.1, 10.0)
"""Wheelbases by which a car stands past the start line when a run begins ..."""
_ASIDE: Final = 5.0
_TURNED_RAD: Final = 0.5
"""... and the most that it is beside its point, and turned."""


class Report(NamedTuple):
    """What an instrument has measured at one moment."""

    instrument: str
    values: Mapping[str, tuple[float, float]]
    """As :attr:`.Reading.values`: value and standard deviation by quantity."""
    clock_s: float | None = None
    """By the instrument's own clock, wherever that begins; None: it has none."""


class _Instrument:
    """When an instrument measures: its clock is ahead of ours by at most what is seen, as delays
    only add to it."""

    def __init__(self, delay_s: float) -> None:
        self._delay_ns = round(delay_s * 1e9)
        self._least_ns = self._before_ns = self._until_ns = 0
        self.arrived_ns: deque[int] = deque(maxlen=100)

    def measured_ns(self, clock_s: float | None, arrived_ns: int) -> int:
        """The moment by our monotonic clock."""
        known = bool(self.arrived_ns)
        self.arrived_ns.append(arrived_ns)
        if clock_s is None:
            return arrived_ns - self._delay_ns
        clock_ns = round(clock_s * 1e9)
        late_ns = arrived_ns - clock_ns
        if not known or late_ns - self._least_ns > _RESTARTED_NS:
            self._least_ns = self._before_ns = late_ns
            self._until_ns = arrived_ns + _WINDOW_NS
        elif arrived_ns > self._until_ns:
            self._before_ns, self._least_ns = self._least_ns, late_ns
            self._until_ns = arrived_ns + _WINDOW_NS
        self._least_ns = min(self._least_ns, late_ns)
        return clock_ns + min(self._least_ns, self._before_ns) - self._delay_ns

    def __str__(self) -> str:
        times = self.arrived_ns
        silent_s = (time.monotonic_ns() - times[-1]) * 1e-9
        if silent_s > 1.0 or len(times) < 2:
            return f"silent for {silent_s:.1f} s"
        return f"{(len(times) - 1) / max((times[-1] - times[0]) * 1e-9, 1e-9):.0f} Hz"


class Hardware(Vehicle):
    """A real car; ``x`` is a guess by its newest poses, good enough to brake and to count laps.

    A context manager: a thread waits in :meth:`receive` meanwhile.
    """

    real = True

    def __init__(
        self,
        car: Car,
        rate_hz: float = 50.0,
        delays_s: Mapping[str, float] | None = None,
        command_s: float = 0.0,
        silent_s: float = 0.5,
    ) -> None:
        """``rate_hz``: of the states. ``delays_s``: by instrument, the least time from measuring to
        arrival. ``command_s``: from sending a command to its acting. ``silent_s``: after so long
        without a pose the car is stopped, the run over."""
        super().__init__(car, 1 / rate_hz, max(round(PLANT_SUBSTEP_HZ / rate_hz), 1))
        self.command_s = command_s
        self._delays_s, self._silent_ns = delays_s or {}, round(silent_s * 1e9)
        self._reports: deque[tuple[Report, int]] = deque(maxlen=1000)
        self._pending: deque[Reading] = deque(maxlen=MOST_READINGS)  # the newest count
        self._instruments: dict[str, _Instrument] = {}
        self._poses: deque[tuple[float, ...]] = deque(maxlen=_POSES)
        self._posed_ns = -self._silent_ns
        self._zero_ns: int | None = None
        self.unusable = 0
        """Reports that are no measurement."""
        self._fault = ""
        self._until_s = 0.0
        self._sent: deque[tuple[float, float, float, float]] = deque(maxlen=_SENT)
        """Since when which command: drive command, steering angle then, steering rate."""
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="instruments", daemon=True)

    @abstractmethod
    def receive(self) -> Report | None:
        """Waits for the next report; None: none has come for a while, 0.1 s at most."""

    @abstractmethod
    def send(self, d: float, delta_rad: float, rate_radps: float) -> None:
        """The drive command from now on, and the steering angle to go to, at this rate."""

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.set()
        self._thread.join()

    def _listen(self) -> None:
        while not self._closing.is_set():
            try:
                report = self.receive()
            except Exception as error:  # of a protocol that is not ours: the car stops unseen
                self.unusable += 1
                _log.warning("instruments: %s: %s", type(error).__name__, error)
                self._closing.wait(_AGAIN_S)
                continue
            if report is not None:
                self._reports.append((report, time.monotonic_ns()))

    # What the car says -------------------------------------------------------------------------

    def readings(self) -> tuple[Reading, ...]:
        """What instruments have measured by now, in plant time, and not been asked for yet."""
        self._take_reports()
        found = tuple(one for one in self._pending if one.time_s <= self.time_s)
        later = [one for one in self._pending if one.time_s > self.time_s]
        self._pending.clear()
        self._pending.extend(later)
        return found

    @property
    def silent(self) -> str:
        """Why the car has to stop: no pose arrives, or no command can be sent; else empty."""
        if self._fault:
            return f"no command reaches the car: {self._fault}"
        if time.monotonic_ns() - self._posed_ns <= self._silent_ns:
            return ""
        return f"no pose of the car for {self._silent_ns * 1e-9:g} s: is it seen, is it on?"

    def report(self) -> str:
        """Which instruments report, and where the car is, for the plant's status."""
        self._take_reports()
        words = [f"{name} {one}" for name, one in sorted(self._instruments.items())]
        if self._poses:
            _, x, y, psi = self._poses[-1]
            turned = math.degrees(math.remainder(psi, 2 * math.pi))
            words += [f"the car at x {x:.3f} m, y {y:.3f} m, heading {turned:.1f}°"]
        words += [f"{self.unusable} unusable reports"] if self.unusable else []
        return ", ".join(words) or "nothing heard of the car"

    def _take_reports(self) -> None:
        for _ in range(len(self._reports)):  # no more, whatever comes meanwhile
            one, arrived_ns = self._reports.popleft()
            try:
                values = dict(one.values)
                found = msgspec.convert(
                    {"instrument": one.instrument, "time_s": 0.0, "values": values}, Reading
                )
                if one.clock_s is not None and not abs(one.clock_s) <= _LATEST_S:
                    raise ValueError("no clock")
            except (ValueError, TypeError):
                self.unusable += 1
                continue
            delay_s = self._delays_s.get(one.instrument, 0.0)
            known = self._instruments.setdefault(one.instrument, _Instrument(delay_s))
            measured_ns = known.measured_ns(one.clock_s, arrived_ns)
            if set(_POSE) <= values.keys():
                self._posed_ns = arrived_ns
                self._poses.append((measured_ns * 1e-9, *(values[name][0] for name in _POSE)))
            if self._zero_ns is not None:
                time_s = (measured_ns - self._zero_ns) * 1e-9
                self._pending.append(msgspec.structs.replace(found, time_s=time_s))

    def _guess(self) -> None:
        """``x`` but for the steering angle."""
        if len(self._poses) < _POSES:
            return
        poses = np.array(self._poses)
        poses[:, 3] = np.unwrap(poses[:, 3])
        first, last = np.median(poses[:_EACH], axis=0), np.median(poses[-_EACH:], axis=0)
        self.x[:3] = last[1:]
        moved = (last[1:3] - first[1:3]) @ (np.cos(last[3]), np.sin(last[3]))
        self.x[3] = moved / max(last[0] - first[0], 1e-3)

    # Commands ----------------------------------------------------------------------------------

    def actuate(self, u: Command) -> None:
        """A command that acts from now on, its steering rate for a period if no other comes."""
        now_s, here = time.monotonic(), self.x.copy()
        _, here[6] = self._wanted(now_s)
        d, rate = self.guard.apply(u, here, self.step_s)
        delta_rad = float(here[6])
        self._sent.append((now_s, d, delta_rad, rate))
        try:
            self.send(d, delta_rad + rate * self.step_s, abs(rate))
            self._fault = ""
        except OSError as error:
            self._fault = str(error)

    def _wanted(self, at_s: float) -> tuple[float, float]:
        """Drive command and steering angle as they were sent by then."""
        since_s, d, delta_rad, rate = next(
            (one for one in reversed(self._sent) if one[0] <= at_s), self._sent[0]
        )
        return d, delta_rad + rate * min(max(at_s - since_s, 0.0), self.step_s)

    # As the plant has it -----------------------------------------------------------------------

    def begins(self, zero_ns: int) -> None:
        """Plant time 0 is at this moment of the monotonic clock."""
        self._zero_ns, self._until_s = zero_ns, time.monotonic() - self.command_s

    def step_switched(self, commands: object) -> None:
        """A period is over, in which these acted: :meth:`actuate` has taken them."""
        until_s = time.monotonic() - self.command_s
        moments = np.linspace(self._until_s, until_s, self.substeps + 1)[1:].tolist()
        acted = [self._wanted(one) for one in moments]
        delta_rad = acted[-1][1]
        self.u_applied = (
            sum(d for d, _ in acted) / len(acted),
            (delta_rad - float(self.x[6])) / self.step_s,
        )
        self.x[6], self._until_s = delta_rad, until_s
        self.steps += 1
        self._take_reports()
        self._guess()

    def _hold(self, u: Command, count: int) -> tuple[float, float]:
        raise NotImplementedError("a real car does not wait for its periods")

    def _place(self, start: Floats) -> None:
        """Whether it stands there; InputError if it does not."""
        self._zero_ns = None
        self._pending.clear()
        self._take_reports()
        if self.silent or len(self._poses) < _POSES:
            raise InputError(self.silent or "too few poses of the car so far; start once more")
        self._guess()
        ahead, aside = np.array(
            [[np.cos(start[2]), np.sin(start[2])], [-np.sin(start[2]), np.cos(start[2])]]
        ) @ (self.x[:2] - start[:2])
        turned = math.remainder(float(self.x[2] - start[2]), 2 * math.pi)
        low, high, beside = (self.car.wheelbase_m * one for one in (*_AHEAD, _ASIDE))
        if not (low <= ahead <= high and abs(aside) <= beside and abs(turned) <= _TURNED_RAD):
            raise InputError(
                f"the car is {ahead:.2f} m past the start line's point, {aside:.2f} m to its left, "
                f"turned by {math.degrees(turned):.0f}°: put it {low:.2f} to {high:.2f} m past it, "
                "in the direction of driving"
            )
        self.x[3:] = 0.0
        self._sent.clear()
        self._sent.append((time.monotonic(), 0.0, 0.0, 0.0))
