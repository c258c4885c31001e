"""The car by the true equations of its dynamics; deterministic to the bit."""

from typing import Any, Final

import numpy as np

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.integrators import PLANT_SCHEME, PLANT_SUBSTEP_HZ, Discretisation
from bayesrace.plant.vehicle import Command, Compile, Vehicle
from bayesrace.plant.world import UNCHANGED, World, changed_car
from bayesrace.vehicles.models import Model

__all__ = ["PLANT", "Simulator", "plant_discretisation"]


def plant_discretisation(rate_hz: float = 50.0) -> Discretisation:
    """How the plant integrates when it samples its state at this rate.

    Raises InputError unless a period is a whole number of integration steps.
    """
    substeps = round(PLANT_SUBSTEP_HZ / rate_hz) if rate_hz > 0 else 0
    if substeps < 1 or abs(substeps * rate_hz - PLANT_SUBSTEP_HZ) > 1e-6:
        raise InputError(
            f"the plant cannot sample at {rate_hz:g} Hz: its period must be a whole number of "
            "milliseconds; 50, 100, 200, 250 or 500 Hz will do"
        )
    step_s = substeps / PLANT_SUBSTEP_HZ
    return Discretisation(scheme=PLANT_SCHEME, step_s=step_s, substeps=substeps)


PLANT: Final = plant_discretisation()


class _Substeps:
    """A CasADi map x_next = F(x, u, p), applied to x and u in place.

    An ordinary call converts to and from DM, which costs more than the integration itself.
    """

    def __init__(self, function: Any, x: Floats, u: Floats, p: Floats) -> None:
        self._x, self._x_next = x, np.zeros_like(x)
        buffers = []
        for before, after in ((x, self._x_next), (self._x_next, x)):
            buffer, evaluate = function.buffer()
            for i, argument in enumerate((before, u, p)):
                buffer.set_arg(i, argument.data)
            buffer.set_res(0, after.data)
            buffers.append((buffer, evaluate))
        self._evaluate = tuple(evaluate for _, evaluate in buffers)
        self._alive = function, p, buffers  # the buffers do not keep what they refer to

    def advance(self, count: int) -> None:
        """So many substeps."""
        forth, back = self._evaluate
        for _ in range(count // 2):
            forth()
            back()
        if count % 2:
            forth()
            self._x[:] = self._x_next


class Simulator(Vehicle):
    """The built-in car."""

    def __init__(
        self,
        model: Model,
        discretisation: Discretisation = PLANT,
        compiled: Compile | None = None,
        world: World = UNCHANGED,
    ) -> None:
        """``world``: what changes while the car drives; its commands are guarded as those of the
        car without.

        Without ``compiled``, CasADi interprets the equations, which takes five times as long."""
        super().__init__(model.car, discretisation.step_s, discretisation.substeps)
        self._u: Floats = np.zeros(len(model.inputs))
        substep = Discretisation(
            scheme=discretisation.scheme, step_s=self.step_s / self.substeps, substeps=1
        )
        self._world, self._shares = world, UNCHANGED.shares(0.0, 0.0, 0.0)
        self._parameters = np.array(model.parameters, dtype=np.float64)
        function = substep.for_any_car(model)
        function = compiled(function) if compiled else function
        self._equations = _Substeps(function, self.x, self._u, self._parameters)

    def _place(self, start: Floats) -> None:
        self.x[:] = start

    def _change(self) -> None:
        """To the car as it is at this time and place."""
        shares = self._world.shares(self.time_s, float(self.x[0]), float(self.x[1]))
        if shares != self._shares:
            self._shares = shares
            numbers = changed_car(self.car, shares).equation_numbers
            self._parameters[:] = list(numbers.values())

    def _hold(self, u: Command, count: int) -> tuple[float, float]:
        """For so many substeps; what acted."""
        x, duration_s = self.x, self.step_s * count / self.substeps
        if self._world.root:
            self._change()
        delta = float(x[6])
        applied = self.guard.apply(u, x, duration_s)
        self._u[0], self._u[1] = applied
        self._equations.advance(count)
        x[6] = self.guard.angle_after(delta, applied[1], duration_s)
        return applied
