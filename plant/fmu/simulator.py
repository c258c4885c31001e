"""An FMU as the car: the same guard in front of it, and the same interface, as the equations."""

import os
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, Final

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.plant.fmu.host import FmuHost
from bayesrace.plant.fmu.inspection import inspect, steps_s
from bayesrace.plant.fmu.map import FmuMap, read_map, wire
from bayesrace.plant.fmu.wiring import Wiring
from bayesrace.plant.simulator import plant_discretisation
from bayesrace.plant.vehicle import Command, Vehicle
from bayesrace.vehicles.models import STATES
from bayesrace.vehicles.parameters import Car

__all__ = ["FmuSimulator", "communication_step", "open_fmu"]


_STEP_S: Final = 1e-3
"""Communication step of an FMU that takes any: the built-in car's substep."""

_LIMIT: Final = 1e6
"""Beyond this no number of a state can be sent, nor be a car's."""


def communication_step(fmu: Any, wanted_s: float | None, period_s: float) -> float:
    """Step [s] in which an FMU is driven; it divides the plant's period.

    That of the map; else 1 ms if the FMU takes any; else the FMU's own, or the period. Raises
    InputError if the map's does not divide the period.
    """
    if wanted_s is not None:
        if _divides(wanted_s, period_s):
            return wanted_s
        raise InputError(
            f"the map's step_s = {wanted_s:g} does not divide the plant's period of "
            f"{period_s:g} s; set it in [fmu] to a whole part of it, or change --rate"
        )
    stated_s, otherwise_s = steps_s(fmu), period_s
    if (
        fmu.coSimulation.canHandleVariableCommunicationStepSize
    ):  # but not finer than its own, nor between its own
        stated_s, otherwise_s = [one for one in stated_s[:1] if not _divides(one, _STEP_S)], _STEP_S
    return next((one for one in stated_s if _divides(one, period_s)), otherwise_s)


def _divides(step_s: float, period_s: float) -> bool:
    whole = round(period_s / step_s) if 0 < step_s <= period_s * (1 + 1e-9) else 0
    return abs(whole * step_s - period_s) <= 1e-9 * period_s


class FmuSimulator(Vehicle):
    """A car that an FMU computes.

    A command that holds for a while is one step of an FMU that takes steps of any size, and as
    many communication steps as fit of any other.
    """

    def __init__(
        self, car: Car, host: FmuHost, wiring: Wiring, *, period_s: float, part_s: float,
        any_size: bool,
    ) -> None:  # fmt: skip
        """``part_s``: communication step; ``any_size``: other steps are as good."""
        super().__init__(car, period_s, round(period_s / part_s))
        self._host, self._wiring = host, wiring
        self._part_s, self._any_size = part_s, any_size

    def _place(self, start: Floats) -> None:
        """A new instance of the FMU."""
        outputs = self._host.start(self._wiring.start_values(start))
        self._take(self._wiring.begin(outputs, start))

    def _hold(self, u: Command, count: int) -> tuple[float, float]:
        """Holds a command for ``count`` communication steps; what acted."""
        delta, wiring, part_s = float(self.x[6]), self._wiring, self._part_s
        # Whole periods are the period itself, to the bit.
        duration_s = self.step_s if count == self.substeps else count * part_s
        applied = self.guard.apply(u, self.x, duration_s)
        if self._any_size and not wiring.follows_angle:
            part_s, count = duration_s, 1
        times_s = [k * part_s for k in range(1, (count if wiring.follows_angle else 1) + 1)]
        outputs = self._host.step(wiring.to_inputs(applied, delta, times_s), part_s, count)
        self._take(wiring.state(outputs, applied, duration_s))
        return applied

    def _take(self, x: Floats) -> None:
        """Makes it the state, if it is one."""
        for name, value in zip(STATES, x.tolist(), strict=True):
            if not abs(value) <= _LIMIT:
                raise self._host.fault(f"its outputs make {name} = {value:g}, which no car has")
        self.x[:] = x


@contextmanager
def open_fmu(
    car: Car,
    path: str | os.PathLike[str],
    map_path: str | os.PathLike[str] | None = None,
    rate_hz: float = 50.0,
) -> Iterator[FmuSimulator]:
    """The FMU in ``path`` as ``car``, its variables named by the map file or ours.

    Raises InputError if the FMU, the map, or both together are not usable.
    """
    period_s = plant_discretisation(rate_hz).step_s
    fmu = inspect(Path(path))
    map_ = None if map_path is None else read_map(Path(map_path))
    wiring, run = wire(fmu, map_, car.drive.unit), (map_ or FmuMap()).fmu
    part_s = communication_step(fmu, run.step_s, period_s)
    # A step size that the map asks for is kept, whatever else the FMU could do.
    any_size = run.step_s is None and fmu.coSimulation.canHandleVariableCommunicationStepSize
    limits = {"timeout_s": run.timeout_s, "startup_s": run.startup_s}
    with closing(FmuHost(Path(path), fmu, wiring.inputs, wiring.outputs, **limits)) as host:
        yield FmuSimulator(car, host, wiring, period_s=period_s, part_s=part_s, any_size=any_size)
