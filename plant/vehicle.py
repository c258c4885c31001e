"""What a run drives: the built-in equations, an FMU or slipx, behind one interface."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.vehicles.models import dynamic
from bayesrace.vehicles.parameters import CarParameters
from plant.settings import SimulatorName
from plant.simulator import Command, Compile, PlantGuard, Simulator, plant_discretisation

__all__ = ["Vehicle", "open_vehicle"]


class Vehicle(Protocol):
    """A car that advances by one sampling period per call, its actuators guarded.

    :meth:`step` and :meth:`step_switched` raise :class:`plant.fmu.faults.FmuFault` when the car
    itself fails; ``x``, ``u_applied`` and ``steps`` are then those of the last good sample, and
    the next :meth:`reset` begins with a car as new.
    """

    car: CarParameters
    """Whose limits the guard keeps."""
    step_s: float
    """Sampling period."""
    substeps: int
    """Parts of a period at whose beginnings a command can change."""
    guard: PlantGuard
    u_applied: tuple[float, float]
    """What acted during the last period; the mean over it if it changed within."""
    steps: int
    """Periods since the reset."""
    x: Floats
    """State (7,) after the last step: read it, but do not write into it."""

    @property
    def time_s(self) -> float:
        """Time since the reset, exact multiples of the period."""

    def reset(self, x0: Sequence[float]) -> None:
        """Put the car into state ``x0`` at time zero.

        InputError if it cannot be in it, FmuFault if the car fails at that.
        """

    def step(self, u: Command) -> None:
        """Hold the command ``u`` = (d, delta_rate) for one period; None brakes."""

    def step_switched(self, commands: Sequence[tuple[int, Command]]) -> None:
        """One period in which the command changes: (substeps, command) in order of time."""


@contextmanager
def open_vehicle(
    car: CarParameters,
    fmu: Path | None = None,
    fmu_map: Path | None = None,
    rate_hz: float = 50.0,
    compiled: Compile | None = None,
    *,
    simulator: SimulatorName = "equations",
) -> Iterator[Vehicle]:
    """The car by the built-in equations, by slipx, or by an FMU and the map of its variables.

    ``compiled``: of the equations, see :class:`plant.simulator.Simulator`.

    Raises InputError if the FMU, the map, the rate or the car cannot be used.
    """
    if fmu is None:
        if fmu_map is not None:
            raise InputError(f"map {fmu_map} without an FMU to apply it to: add --fmu")
        if simulator == "slipx":
            from plant.slipx_car import SlipxSimulator

            yield SlipxSimulator(car, rate_hz)
            return
        yield Simulator(dynamic(car), plant_discretisation(rate_hz), compiled)
        return
    if simulator != "equations":
        raise InputError(f"--simulator {simulator} and --fmu {fmu}: only one can be the car")
    from plant.fmu.simulator import open_fmu  # the built-in car does not wait for fmpy

    with open_fmu(car, fmu, fmu_map, rate_hz) as vehicle:
        yield vehicle
