"""A race whose controller sees the car through instruments alone, some of which may fail."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from msgspec import structs

from bayesrace.arrays import Floats
from bayesrace.controller.process_settings import ControllerSettings
from bayesrace.messages import Reading, State
from bayesrace.operation.closed_loop import ClosedLoop
from tests.racing import Racing

__all__ = ["FINE", "ROUGH", "Arriving", "Fault", "Kit", "Seen", "mocap", "odometry", "reading"]

STEP_S = 0.02
FINE, ROUGH = (0.5, 0.2), (1.0, 0.5)
"""Noise of a pose: mm, degrees."""

Fault = Callable[[Reading, Reading], Reading | None]
"""What an instrument reports in place of a reading, given the last one before the fault."""

Arriving = Callable[[State, State], State | None]
"""What the controller gets of a state with readings, given the true one; None: it is lost."""


@dataclass(frozen=True)
class Kit:
    """Instruments: poses every so many periods, one period late; wheel speed and gyro four times a
    period or not at all."""

    noise: tuple[float, float] = FINE
    every: int = 1
    fast: bool = False
    gaps: bool = True
    """Of poses, 100 ms every 2 s; 1 % of poses are nowhere near."""


def mocap(noise: tuple[float, float] = FINE, every: int = 1) -> Kit:
    return Kit(noise, every)


def odometry(noise: tuple[float, float] = FINE) -> Kit:
    """Pose at 25 Hz, wheel speed and gyro at 200 Hz."""
    return Kit(noise, 2, fast=True)


class Seen(ClosedLoop):
    """All that its controller gets are readings."""

    def __init__(
        self, race: Racing, kit: Kit, seed: int = 0, controller: Any = None, **how: Any
    ) -> None:
        settings = ControllerSettings(car=race.car)
        controller = controller or race.controller()
        super().__init__(race.car, race.track, race.line, controller, settings=settings, **how)
        self._kit, self._seed = kit, seed
        self.driver = self._cycle.driver
        self._observe = self.driver.observe
        self.driver.observe = self._see  # type: ignore[method-assign]
        self.seen: list[State] = []
        """As the controller gets them."""
        self.arriving: Arriving = lambda seen, _: seen
        self.go_s = math.inf
        """When someone says go."""
        self.fail("", lambda reading, _: reading, 0.0, 0.0)

    def fail(self, name: str, fault: Fault, begin_s: float, lasts_s: float) -> None:
        """From plant time begin_s on."""
        self._failing, self._fault, self._begin_s = name, fault, begin_s
        self._end_s = begin_s + lasts_s
        self._random = np.random.default_rng(self._seed)
        self._good: Reading | None = None
        self.bad = 0
        """Readings of the fault so far, those that do not come included."""
        self.named: list[tuple[float, str, str, int]] = []
        """Of each state: plant time, the fault, its instrument, and those."""

    def _pose(self, time_s: float, x: Floats) -> Reading:
        mm, degrees = self._kit.noise
        deviation = np.array([1e-3 * mm, 1e-3 * mm, np.deg2rad(degrees)])
        value = self._random.normal(x[:3], deviation)
        if self._random.random() < 0.01:
            value = value + self._random.normal(0, 0.3, 3)
        return reading("pose", time_s, x=value[0], y=value[1], psi=value[2], deviation=deviation)

    def _readings(self) -> list[Reading]:
        now = len(self._true_x) - 1
        then, found = now - 1, []
        if then >= 0 and then % self._kit.every == 0 and (STEP_S * then + 1) % 2 > 0.1:
            found.append(self._pose(STEP_S * then, np.array(self._true_x[then])))
        for k in range(1, 5) if self._kit.fast and now else ():
            part = k / 4
            x = (1 - part) * np.array(self._true_x[now - 1]) + part * np.array(self._true_x[now])
            time_s = STEP_S * (now - 1 + part)
            speed = max(0.01 * abs(x[3]), 0.005)
            gyro, wheel = self._random.normal([x[5] + 0.05, x[3]], [0.02, speed])
            found.append(reading("gyro", time_s, omega=gyro, deviation=(0.02,)))
            found.append(reading("wheel", time_s, vx=wheel, deviation=(speed,)))
        return found

    def _reported(self, one: Reading) -> Reading | None:
        if one.instrument != self._failing or not self._begin_s <= one.time_s < self._end_s:
            self._good = one if one.instrument == self._failing else self._good
            return one
        self.bad += 1
        assert self._good is not None
        return self._fault(one, self._good)

    def _see(self, state: State) -> bool:
        known = [one for one in map(self._reported, self._readings()) if one is not None]
        seen = structs.replace(state, x=(0.0,) * 7, estimated=True, readings=tuple(known))
        arrived = self.arriving(seen, state)
        if arrived is None:
            return False
        self.seen.append(arrived)
        if state.time_s >= self.go_s:
            self.driver.go()
            self.go_s = math.inf
        new = self._observe(arrived)
        self.named.append((state.time_s, self.driver.fault, self.driver.faulty, self.bad))
        return new


def reading(instrument: str, time_s: float, deviation: Any, **values: float) -> Reading:
    pairs = zip(map(float, values.values()), map(float, deviation), strict=True)
    return Reading(
        instrument=instrument, time_s=time_s, values=dict(zip(values, pairs, strict=True))
    )
