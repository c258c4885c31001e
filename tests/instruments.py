"""A race whose controller sees the car through instruments alone, some of which may fail."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from msgspec import structs

from bayesrace.controller.process_settings import ControllerSettings
from bayesrace.messages import Reading, State
from bayesrace.operation.closed_loop import ClosedLoop
from bayesrace.plant.faults import ReadingFault
from bayesrace.sensors import BUILT_IN, Sensors
from tests.racing import Racing

__all__ = ["FINE", "ROUGH", "Arriving", "Seen", "mocap", "odometry", "reading"]

FINE, ROUGH = (0.5, 0.2), (1.0, 0.5)
"""Noise of a pose: mm, degrees."""

Arriving = Callable[[State, State], State | None]
"""What the controller gets of a state with readings, given the true one; None: it is lost."""


def mocap(noise: tuple[float, float] = FINE, rate_hz: float = 50) -> Sensors:
    """Late poses, with gaps of 100 ms every 2 s; 1 % of them are nowhere near."""
    mm, degrees = noise
    position = {"deviation": 1e-3 * mm, "outlier": 0.3}
    heading = {"deviation": np.deg2rad(degrees), "outlier": 0.3}
    pose = {
        "rate_hz": rate_hz, "delay_s": 0.02, "jitter_s": 0.005, "gap_s": 0.1, "gap_every_s": 2,
        "outliers": 0.01, "x_m": position, "y_m": position, "heading_rad": heading,
    }  # fmt: skip
    return Sensors.model_validate({"pose": pose})


def odometry(noise: tuple[float, float] = FINE) -> Sensors:
    """The same at 25 Hz; wheel speed and gyro at 200 Hz."""
    return Sensors({**BUILT_IN["odometry"].root, **mocap(noise, 25).root})


class Seen(ClosedLoop):
    """Its plant has sensors, one of which may fail."""

    def __init__(self, race: Racing, sensors: Sensors, seed: int = 0) -> None:
        settings = ControllerSettings(car=race.car)
        loop = race.car, race.track, race.line, race.controller()
        super().__init__(*loop, settings=settings, sensors=sensors, seed=seed)
        self.driver = self._cycle.driver
        self._observe = self.driver.observe
        self.driver.observe = self._see  # type: ignore[method-assign]
        self.arriving: Arriving = lambda seen, _: seen
        self.go_s = math.inf
        """When someone says go."""
        self.fail("", lambda reading, _: reading, 0.0, 0.0)

    def fail(self, name: str, fault: ReadingFault, begin_s: float, lasts_s: float) -> None:
        """What is measured from plant time begin_s on."""
        self._failing, self._fault, self._begin_s = name, fault, begin_s
        self._end_s = begin_s + lasts_s
        self._good: Reading | None = None
        self._bad = 0
        self.named: list[tuple[float, str, str, int]] = []
        """Of each state: plant time, the fault, its instrument, and how many readings of the fault
        there were before it, those that do not come included."""

    def _reported(self, one: Reading) -> Reading | None:
        if one.instrument != self._failing or not self._begin_s <= one.time_s < self._end_s:
            self._good = one if one.instrument == self._failing else self._good
            return one
        self._bad += 1
        assert self._good is not None
        return self._fault(one, self._good)

    def _see(self, state: State) -> bool:
        bad = self._bad
        known = [one for one in map(self._reported, state.readings) if one is not None]
        seen = structs.replace(state, readings=tuple(known))
        true = structs.replace(state, readings=(), estimated=False, x=self._true_x[-1])
        arrived = self.arriving(seen, true)
        if arrived is None:
            return False
        if state.time_s >= self.go_s:
            self.driver.go()
            self.go_s = math.inf
        new = self._observe(arrived)
        self.named.append((state.time_s, self.driver.fault, self.driver.faulty, bad))
        return new


def reading(instrument: str, time_s: float, deviation: Any, **values: float) -> Reading:
    pairs = zip(map(float, values.values()), map(float, deviation), strict=True)
    return Reading(
        instrument=instrument, time_s=time_s, values=dict(zip(values, pairs, strict=True))
    )
