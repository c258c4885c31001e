"""The car as a run drives it: the built-in equations, an FMU or slipx, behind one interface."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.plant.guard import Command, PlantGuard
from bayesrace.plant.settings import SimulatorName
from bayesrace.vehicles.parameters import CarParameters

if TYPE_CHECKING:
    import casadi as ca

__all__ = ["Compile", "FmuFault", "Vehicle", "open_vehicle"]

Compile = Callable[["ca.Function"], "ca.Function"]
"""Makes machine code of a function, to the same bits."""

_STATES: Final = 7


class FmuFault(RuntimeError):  # noqa: N818 - the car failed, not this program
    """The simulated car crashed, hung, refused a step, gave an unusable value or ended the run.

    The message names it, what happened, when (plant time), and its last message. The input
    was not bad: the run ends, the plant process goes on.
    """


class Vehicle(ABC):
    """A car that advances by one sampling period per call, its actuators guarded.

    :meth:`reset`, :meth:`step` and :meth:`step_switched` raise :class:`FmuFault` when the car
    itself fails; ``x``, ``u_applied`` and ``steps`` are then those of the last good sample, and the
    next :meth:`reset` begins with a car as new.
    """

    def __init__(self, car: CarParameters, step_s: float, substeps: int) -> None:
        self.car = car
        """Whose limits the guard keeps."""
        self.step_s = step_s
        """Sampling period."""
        self.substeps = substeps
        """Parts of a period at whose beginnings a command can change."""
        self.guard = PlantGuard(car)
        self.u_applied: tuple[float, float] = (0.0, 0.0)
        """What acted during the last period; the mean over it if it changed within."""
        self.steps = 0
        """Periods since the reset."""
        self.x: Floats = np.zeros(_STATES)
        """State (7,) after the last step: read it, but do not write into it."""

    @property
    def time_s(self) -> float:
        """Time since the reset, exact multiples of the period."""
        return self.steps * self.step_s

    def reset(self, x0: Sequence[float]) -> None:
        """Put the car into state ``x0`` at time zero; InputError if it cannot be in it."""
        start = np.asarray(x0, dtype=np.float64)
        if start.shape != (_STATES,) or not np.isfinite(start).all():
            raise InputError(f"start state needs {_STATES} finite numbers, got {x0!r}")
        if abs(start[6]) > self.car.delta_max_rad:
            raise InputError(
                f"start state has a steering angle of {start[6]:.3f} rad; "
                f"{self.car.name} steers within ±{self.car.delta_max_rad} rad"
            )
        self._place(start)
        self.u_applied = (0.0, 0.0)
        self.steps = 0

    def step(self, u: Command) -> None:
        """Hold the command ``u`` = (d, delta_rate) for one period; None brakes."""
        self.u_applied = self._hold(u, self.substeps)
        self.steps += 1

    def step_switched(self, commands: Sequence[tuple[int, Command]]) -> None:
        """One period in which the command changes: (substeps, command) in order of time.

        The substeps must add up to :attr:`substeps`.
        """
        if sum(count for count, _ in commands) != self.substeps:
            raise ValueError(f"the commands must last {self.substeps} substeps together")
        if len(commands) == 1:
            self.step(commands[0][1])
            return
        before, d_sum, rate_sum = self.x.copy(), 0.0, 0.0
        try:
            for count, u in commands:
                if count == 0:
                    continue
                d, rate = self._hold(u, count)
                d_sum += count * d
                rate_sum += count * rate
        except Exception:
            self.x[:] = before
            raise
        self.u_applied = d_sum / self.substeps, rate_sum / self.substeps
        self.steps += 1

    @abstractmethod
    def _place(self, start: Floats) -> None:
        """Begin at time zero in this state (7,)."""

    @abstractmethod
    def _hold(self, u: Command, count: int) -> tuple[float, float]:
        """Hold a command for so many substeps; what acted. On a fault ``x`` stays."""


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

    ``compiled``: of the equations, see :class:`bayesrace.plant.simulator.Simulator`.

    Raises InputError if the FMU, the map, the rate or the car cannot be used.
    """
    if fmu is None:
        if fmu_map is not None:
            raise InputError(f"map {fmu_map} without an FMU to apply it to: add --fmu")
        if simulator == "slipx":
            from bayesrace.plant.slipx_car import SlipxSimulator

            yield SlipxSimulator(car, rate_hz)
            return
        from bayesrace.plant.simulator import Simulator, plant_discretisation
        from bayesrace.vehicles.models import dynamic

        yield Simulator(dynamic(car), plant_discretisation(rate_hz), compiled)
        return
    if simulator != "equations":
        raise InputError(f"--simulator {simulator} and --fmu {fmu}: only one can be the car")
    from bayesrace.plant.fmu.simulator import open_fmu  # the built-in car does not wait for fmpy

    with open_fmu(car, fmu, fmu_map, rate_hz) as vehicle:
        yield vehicle
