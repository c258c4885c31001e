"""Simulated cars that differ from their file, which is all that the controller knows."""

from collections.abc import Callable, Mapping
from typing import Final

import casadi as ca
import numpy as np

from bayesrace.codegen.compiler import compiled
from bayesrace.plant.simulator import Simulator
from bayesrace.vehicles import Car
from bayesrace.vehicles.models import Model, dynamic

__all__ = ["CHANGES", "changed", "trimmed"]

TRIM_RAD: Final = float(np.deg2rad(1.0))


def _motor(car: Car, share: float) -> Car:
    force = {name: share * getattr(car.drive, name) for name in ("cm1", "cm2")}
    return car.model_copy(update={"drive": car.drive.model_copy(update=force)})


CHANGES: Final[Mapping[str, Callable[[Car], Car]]] = {
    "as in the file": lambda car: car,
    "wheelbase + 10 %": lambda car: car.model_copy(
        update={"lf_m": 1.1 * car.lf_m, "lr_m": 1.1 * car.lr_m}
    ),
    "motor - 10 %": lambda car: _motor(car, 0.9),
    "motor + 10 %": lambda car: _motor(car, 1.1),
    "mass + 20 %": lambda car: car.model_copy(update={"mass_kg": 1.2 * car.mass_kg}),
    "grip 0.9": lambda car: car.model_copy(update={"tyres": car.true_tyres.with_grip(0.9)}),
    "grip 0.8": lambda car: car.model_copy(update={"tyres": car.true_tyres.with_grip(0.8)}),
    "trim 1 degree": lambda car: car,
}


def changed(car: Car, how: str) -> Simulator:
    """The car that drives."""
    turned = TRIM_RAD if how == "trim 1 degree" else 0.0
    return Simulator(trimmed(dynamic(CHANGES[how](car)), turned), compiled=compiled)


def trimmed(model: Model, by_rad: float) -> Model:
    """A car whose wheels are turned by so much where it believes that they are straight."""
    if by_rad == 0:
        return model
    assert model.any_car is not None
    x, u, p = ca.SX.sym("x", 7), ca.SX.sym("u", 2), ca.SX.sym("p", len(model.parameters))
    turned = ca.vertcat(x[:6], x[6] + by_rad)
    named = ["x", "u"], ["xdot"]
    ode = ca.Function(model.name, [x, u], [model.ode(turned, u)], *named)
    every = ca.Function(
        model.name, [x, u, p], [model.any_car(turned, u, p)], ["x", "u", "p"], ["xdot"]
    )
    return Model(model.name, model.car, ode, any_car=every, parameters=model.parameters)
