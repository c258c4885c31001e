"""The built-in car as an FMU, made once for all tests, and driven beside the built-in plant."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Final, Literal

import numpy as np
from fmpy import extract

from bayesrace.arrays import Floats
from bayesrace.cache import cpu_identity, software
from bayesrace.codegen.compiler import FLAGS, find_compiler
from bayesrace.codegen.fmu import car_fmu, pack
from bayesrace.plant.simulator import Simulator, plant_discretisation
from bayesrace.vehicles import Car, get_car
from bayesrace.vehicles.models import STATES, dynamic
from tests.fmu_master import Slave
from tests.shared import shared_folder

__all__ = ["built_in", "commands", "driven", "packed_car", "slave", "unpacked_car"]

_SOURCES: Final = (".", "vehicles", "codegen", "codegen/fmu", "codegen/fmu/native")

Version = Literal[2, 3]
Kind = Literal["cs", "me"]
Commands = Sequence[tuple[float, float]]


def packed_car(version: Version = 3, kind: Kind = "cs") -> Path:
    """The FMU for this platform."""
    return _folder(version, kind, None) / "car.fmu"


def unpacked_car(
    version: Version = 3, kind: Kind = "cs", platforms: tuple[str, ...] | None = None
) -> Path:
    """The same as a folder named after the version; ``platforms``: others than this one."""
    return _folder(version, kind, platforms) / str(version)


@cache
def _folder(version: Version, kind: Kind, platforms: tuple[str, ...] | None) -> Path:
    compiler = find_compiler()
    made_by = [*compiler.command, compiler.version, *FLAGS, cpu_identity()]
    packages = ("casadi", "fmpy", *(("ziglang",) if platforms else ()))
    parts = [str(version), kind, str(platforms), *made_by, *software(_SOURCES, packages)]

    def make(folder: Path) -> None:
        fmu = pack(car_fmu(get_car("orca"), version, kind), folder / "car.fmu", platforms)
        extract(str(fmu), unzipdir=str(folder / str(version)))

    return shared_folder("car-fmu", parts, make)


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
    car: Car, inputs: Commands, h: float = 0.02, x0: Sequence[float] = (0.0,) * 7
) -> Floats:
    """The same from the built-in plant."""
    simulator = Simulator(dynamic(car), plant_discretisation(1 / h))
    simulator.reset(x0)
    rows = np.zeros((len(inputs), 9))
    for row, u in zip(rows, inputs, strict=True):
        simulator.step(u)
        row[:] = [*simulator.x, *simulator.u_applied]
    return rows
