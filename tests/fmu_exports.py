"""The car's FMUs driven beside the built-in plant."""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.plant.simulator import Simulator, plant_discretisation
from bayesrace.vehicles.models import STATES, dynamic
from bayesrace.vehicles.parameters import CarParameters
from tests.car_fmu import packed_car, unpacked_car
from tests.fmu_master import Slave

__all__ = ["Commands", "built_in", "commands", "driven", "slave"]

Commands = Sequence[tuple[float, float]]
Version = Literal[2, 3]
Kind = Literal["cs", "me"]


def slave(version: Version = 3) -> Slave:
    """A new instance of the Co-Simulation FMU."""
    return Slave(packed_car(version), unpacked_car(version))


def commands(count: int, seed: int = 0, bad: bool = True) -> list[tuple[float, float]]:
    """Drives with turns and stops, beyond all limits; ``bad``: also some that are not finite."""
    random = np.random.default_rng(seed)
    rows: list[tuple[float, float]] = []
    while len(rows) < count:
        d, rate = random.uniform(-0.4, 1.3), random.uniform(-9, 9)
        row = [(d, rate), (d, -rate), (0.4, rate / 9), (-1.0, 0.0)][random.integers(4)]
        rows += [row] * int(random.integers(1, 40))
        if bad and random.random() < 0.3:
            rows.append([(np.nan, 1.0), (0.5, np.inf), (-np.inf, np.nan)][random.integers(3)])
    return rows[:count]


def driven(car: Slave, inputs: Commands, h: float = 0.02) -> Floats:
    """State and applied input after each step of an initialised instance, (n, 9)."""
    rows = np.zeros((len(inputs), 9))
    for row, (d, rate) in zip(rows, inputs, strict=True):
        car.set({"d": d, "delta_rate": rate})
        car.step(h)
        row[:] = car.get(*STATES, "d_applied", "delta_rate_applied")
    return rows


def built_in(
    car: CarParameters, inputs: Commands, h: float = 0.02, x0: Sequence[float] = (0.0,) * 7
) -> Floats:
    """The same from the built-in plant."""
    simulator = Simulator(dynamic(car), plant_discretisation(1 / h))
    simulator.reset(x0)
    rows = np.zeros((len(inputs), 9))
    for row, u in zip(rows, inputs, strict=True):
        simulator.step(u)
        row[:] = [*simulator.x, *simulator.u_applied]
    return rows
