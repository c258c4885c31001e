"""The package slipx as the car: its double-track model behind the guard and the interface of ours.

An independent simulator in C++: four wheels, load transfer, tyres that saturate and lag, a locked
rear axle, motor, battery and a steering servo, none of which our equations have. Its axes are ours:
x ahead, y to the left, angles anticlockwise, SI units.

- Drive command: an acceleration, which slipx turns into a torque and limits by motor and battery.
- Steering: slipx has a servo of second order that is sent an angle. It follows a ramp a constant
  time late, 2 damping / bandwidth, so it is sent the angle that our rate leads to so much later.
  The state's delta is the angle of the wheels, and the rate that acted is by how much it changed.
"""

import math
from importlib.metadata import version
from typing import Any, Final

import slipx

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.plant.simulator import plant_discretisation
from bayesrace.plant.vehicle import Command, FmuFault, Vehicle
from bayesrace.vehicles.parameters import Car

__all__ = ["SlipxSimulator"]

_TOLERANCE: Final = 0.01
"""Relative difference of mass and geometry within which two cars are one."""


class SlipxSimulator(Vehicle):
    """slipx' reference car that advances by one sampling period per call; see ``plant.vehicle``."""

    def __init__(self, car: Car, rate_hz: float = 50.0) -> None:
        """``car``: whose limits the guard keeps; InputError if it is not the reference car."""
        discretisation = plant_discretisation(rate_hz)
        super().__init__(car, discretisation.step_s, discretisation.substeps)
        tier = slipx.Tier.L2_DoubleTrack
        self._parameters: Any = slipx.load_reference_car().params_for_tier(tier)
        self._lag_s = 2.0 * self._parameters.steer_damping / self._parameters.steer_bandwidth
        self._model: Any = slipx.VehicleModel.create(tier, self._parameters)
        self._state: Any = slipx.VehicleState()
        self._input: Any = slipx.DriveInput()
        self._check(car)

    def _check(self, car: Car) -> None:
        theirs = self._parameters
        names = {"lf_m": theirs.lf, "lr_m": theirs.lr, "mass_kg": theirs.mass}
        for name, value in names.items():
            ours = getattr(car, name)
            if not math.isclose(ours, value, rel_tol=_TOLERANCE):
                raise InputError(
                    f"slipx {version('slipx')} simulates its reference car, with {name} = "
                    f"{value:g}; the car '{car.name}' has {ours:g}: use --car slipx, or a car's "
                    "file with that value"
                )

    def _place(self, start: Floats) -> None:
        """The battery is full, and the wheels roll freely."""
        x, y, psi, vx, vy, omega, delta = start.tolist()
        state = self._state = slipx.VehicleState()
        state.pos = slipx.Vec3(x, y, 0.0)
        state.vel_body = slipx.Vec3(vx, vy, 0.0)
        state.rates = slipx.Vec3(0.0, 0.0, omega)
        state.yaw, state.steer = psi, delta
        state.pack_v = self._parameters.pack_v_full
        state.omega_w = [vx / self._parameters.wheel_radius] * 4
        self.x[:] = start

    def _hold(self, u: Command, count: int) -> tuple[float, float]:
        """For so many substeps; what acted."""
        substep_s = self.step_s / self.substeps
        d, rate = self.guard.apply(u, self.x, count * substep_s)
        delta = float(self.x[6])
        state, command = self._state, self._input
        command.accel_cmd = d
        for k in range(1, count + 1):
            command.steer_cmd = delta + rate * (k * substep_s + self._lag_s)
            self._model.step(state, command, substep_s)
        velocity = state.vel_body
        values = state.pos.x, state.pos.y, state.yaw, velocity.x, velocity.y, state.yaw_rate
        if not all(map(math.isfinite, values)):
            raise FmuFault(
                f"slipx {version('slipx')} at {self.time_s:.2f} s: its state is not finite"
            )
        self.x[:] = (*values, state.steer)
        return d, (state.steer - delta) / (count * substep_s)
