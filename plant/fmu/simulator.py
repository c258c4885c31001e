"""An FMU as the car: the same guard in front of it, and the same interface, as the equations."""

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, Protocol

import numpy as np
import numpy.typing as npt

from bayesrace.errors import InputError
from bayesrace.vehicles.models import STATES
from bayesrace.vehicles.parameters import CarParameters
from plant.fmu.faults import FmuFault
from plant.fmu.host import FmuHost, Value
from plant.fmu.map import read_map, wire
from plant.fmu.package import read_description
from plant.simulator import PlantGuard, checked_start, hold_in_turn, plant_discretisation

__all__ = ["FmuSimulator", "communication_step", "open_fmu"]

Array = npt.NDArray[np.float64]

_STEP_S: Final = 1e-3
"""Communication step of an FMU that takes any: the built-in car's substep."""

_LIMIT: Final = 1e6
"""Beyond this no number of a state can be sent, nor be a car's."""


class Connection(Protocol):
    """What wires the car to an FMU's variables: :class:`plant.fmu.wiring.Wiring`."""

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    step_s: float | None
    timeout_s: float
    startup_s: float

    def start_values(self, x0: Sequence[float]) -> dict[str, Value]:
        """What to set before initialisation."""

    def begin(self, outputs: Sequence[float], x0: Sequence[float]) -> Array:
        """State (7,) after initialisation."""

    def to_inputs(self, u: Sequence[float], delta_rad: float, duration_s: float) -> list[float]:
        """The FMU's inputs while ``u`` acts."""

    def state(self, outputs: Sequence[float], u: Sequence[float], duration_s: float) -> Array:
        """State (7,) after ``u`` acted."""


def communication_step(description: Any, wanted_s: float | None, period_s: float) -> float:
    """Step [s] in which an FMU (fmpy's description) is driven; it divides the plant's period.

    That of the map; else 1 ms if the FMU takes any; else the FMU's own, or the period. Raises
    InputError if the map's does not divide the period.
    """
    if wanted_s is not None:
        if not _divides(wanted_s, period_s):
            raise InputError(
                f"the map's step_s = {wanted_s:g} does not divide the plant's period of "
                f"{period_s:g} s; set it in [fmu] to a whole part of it, or change --rate"
            )
        return wanted_s
    interface, experiment = description.coSimulation, description.defaultExperiment
    internal_s = _number(interface.fixedInternalStepSize)
    if interface.canHandleVariableCommunicationStepSize:
        if internal_s is None or _divides(internal_s, _STEP_S):
            return _STEP_S
        return internal_s if _divides(internal_s, period_s) else _STEP_S
    for step_s in (internal_s, _number(experiment.stepSize) if experiment else None):
        if step_s is not None and _divides(step_s, period_s):
            return step_s
    return period_s


def _divides(step_s: float, period_s: float) -> bool:
    if not (math.isfinite(step_s) and 0 < step_s <= period_s * (1 + 1e-9)):
        return False
    return abs(round(period_s / step_s) * step_s - period_s) <= 1e-9 * period_s


def _number(text: Any) -> float | None:
    try:
        return None if text is None else float(text)
    except ValueError:
        return None


class FmuSimulator:
    """A :class:`plant.vehicle.Vehicle` that an FMU computes; close it when done.

    A command that holds for a while is one step of an FMU that takes steps of any size, and as
    many communication steps as fit of any other.
    """

    def __init__(
        self, car: CarParameters, host: FmuHost, wiring: Connection, rate_hz: float = 50.0
    ) -> None:
        self.car = car
        self.step_s = plant_discretisation(rate_hz).step_s
        self.guard = PlantGuard(car)
        self.u_applied: tuple[float, float] = (0.0, 0.0)
        self.steps = 0
        self.x: Array = np.zeros(len(STATES))
        self._host = host
        self._wiring = wiring
        self._part_s = communication_step(host.description, wiring.step_s, self.step_s)
        self.substeps = round(self.step_s / self._part_s)
        # A step size that somebody asked for is kept, whatever else the FMU could do.
        any_size = host.description.coSimulation.canHandleVariableCommunicationStepSize
        self._any_size = bool(any_size) and wiring.step_s is None
        self._last_good: Array = self.x.copy()

    @property
    def time_s(self) -> float:
        """Time since the reset, exact multiples of the period."""
        return self.steps * self.step_s

    def reset(self, x0: Sequence[float]) -> None:
        """A new instance of the FMU in state ``x0`` at time zero.

        Raises InputError if it cannot be in it, FmuFault if it fails.
        """
        start = checked_start(x0, self.car)
        outputs = self._host.start(self._wiring.start_values(start.tolist()))
        self._take(self._wiring.begin(outputs, start.tolist()))
        self.u_applied = (0.0, 0.0)
        self.steps = 0

    def step(self, u: Sequence[float] | None) -> None:
        """Hold the command ``u`` = (d, delta_rate) for one period; None brakes."""
        self.u_applied = self._hold(u, self.substeps)
        self.steps += 1

    def step_switched(self, commands: Sequence[tuple[int, Sequence[float] | None]]) -> None:
        """One period in which the command changes: (substeps, command) in order of time."""
        self._last_good[:] = self.x
        try:
            self.u_applied = hold_in_turn(commands, self.substeps, self._hold)
        except FmuFault:
            self.x[:] = self._last_good
            raise
        self.steps += 1

    def close(self) -> None:
        """End the FMU."""
        self._host.close()

    def __enter__(self) -> "FmuSimulator":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _hold(self, u: Sequence[float] | None, count: int) -> tuple[float, float]:
        """Holds a command for ``count`` communication steps; what acted."""
        vx, delta = float(self.x[3]), float(self.x[6])
        guard, wiring, part_s = self.guard, self._wiring, self._part_s
        # Whole periods are the period itself, to the bit.
        duration_s = self.step_s if count == self.substeps else count * part_s
        applied = guard.brake(vx) if u is None else guard.apply(u, vx, delta, duration_s)
        inputs = wiring.to_inputs(applied, delta, duration_s)
        first = wiring.to_inputs(applied, delta, part_s) if count > 1 else inputs
        if first != inputs:  # one that follows the steering angle, which turns meanwhile
            inputs = first + [
                value
                for k in range(2, count + 1)
                for value in wiring.to_inputs(applied, delta, k * part_s)
            ]
            outputs = self._host.step(inputs, part_s, count)
        elif self._any_size:
            outputs = self._host.step(inputs, duration_s, 1)
        else:
            outputs = self._host.step(inputs, part_s, count)
        self._take(wiring.state(outputs, applied, duration_s))
        return applied

    def _take(self, x: Array) -> None:
        """Makes it the state, if it is one."""
        if not np.all(np.abs(x) <= _LIMIT):
            for name, value in zip(STATES, x.tolist(), strict=True):
                if not abs(value) <= _LIMIT:
                    raise self._host.fault(f"its outputs make {name} = {value:g}, which no car has")
        self.x[:] = x


def open_fmu(
    car: CarParameters,
    path: str | os.PathLike[str],
    map_path: str | os.PathLike[str] | None = None,
    rate_hz: float = 50.0,
) -> FmuSimulator:
    """The FMU in ``path`` as ``car``, its variables named by the map file or ours.

    Raises InputError if the FMU, the map, or both together are not usable.
    """
    map_ = None if map_path is None else read_map(Path(map_path))
    wiring = wire(read_description(path), map_)
    host = FmuHost(path, wiring.inputs, wiring.outputs, wiring.timeout_s, wiring.startup_s)
    try:
        return FmuSimulator(car, host, wiring, rate_hz)
    except BaseException:
        host.close()
        raise
