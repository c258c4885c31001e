"""The car as a Model Exchange FMU: the dynamic model's values and derivatives, for any tool.

``test_fmu_misuse`` has what is refused.
"""

from collections.abc import Iterator
from typing import Any

import casadi as ca
import numpy as np
import pytest
from fmpy import instantiate_fmu, read_model_description, simulate_fmu

from bayesrace.arrays import Floats
from bayesrace.plant.simulator import Simulator
from bayesrace.vehicles import Car, default_car
from bayesrace.vehicles.models import (
    INPUTS,
    STATES,
    dynamic,
    dynamic_with_parameters,
)
from tests.car_fmu import packed_car, unpacked_car

KNOWN = (*STATES, *INPUTS, *default_car().equation_numbers)
DERIVATIVES = tuple(f"der_{name}" for name in STATES)


class Instance:
    """One instance in continuous-time mode."""

    def __init__(self) -> None:
        description = read_model_description(str(unpacked_car(3, "me")))
        self.reference = {v.name: v.valueReference for v in description.modelVariables}
        self.fmu: Any = instantiate_fmu(str(unpacked_car(3, "me")), description, "ModelExchange")
        self.fmu.enterInitializationMode(startTime=0.0)
        self.fmu.exitInitializationMode()
        self.fmu.updateDiscreteStates()
        self.fmu.enterContinuousTimeMode()

    def references(self, names: tuple[str, ...]) -> list[int]:
        return [self.reference[name] for name in names]

    def put(self, x: Floats, u: Floats) -> None:
        self.fmu.setFloat64(self.references(INPUTS), list(u))
        self.fmu.setFloat64(self.references(STATES), list(x))

    def rates(self) -> Floats:
        return np.array(self.fmu.getFloat64(self.references(DERIVATIVES)))

    def directional(self, seed: Floats) -> Floats:
        """d rates / d KNOWN * seed."""
        unknown, known = self.references(DERIVATIVES), self.references(KNOWN)
        return np.array(self.fmu.getDirectionalDerivative(unknown, known, list(seed)))


@pytest.fixture
def instance() -> Iterator[Instance]:
    one = Instance()
    yield one
    one.fmu.terminate()
    one.fmu.freeInstance()


def points(count: int, seed: int = 0) -> list[tuple[Floats, Floats]]:
    """States and inputs of a car at speed, standing, and rolling back."""
    random = np.random.default_rng(seed)
    low = np.array([-5, -5, -7, -0.5, -0.6, -6, -0.35, -0.1, -5])
    rows = random.uniform(low, [5, 5, 7, 4, 0.6, 6, 0.35, 1, 5], (count, 9))
    rows[::7, 3] = 0.0
    rows[::11, 3:6] = 0.0
    return [(row[:7], row[7:]) for row in rows]


def jacobian(car: Car) -> Any:
    """(x, u) -> d xdot / d KNOWN of the symbolic equations at this car's parameters."""
    ode = dynamic_with_parameters(car)
    x, u, p = ca.SX.sym("x", 7), ca.SX.sym("u", 2), ca.SX.sym("p", len(car.equation_numbers))
    full = ca.jacobian(ode(x, u, p), ca.vertcat(x, u, p))
    function = ca.Function("J", [x, u, p], [ca.densify(full)])
    values = list(car.equation_numbers.values())
    return lambda a, b: np.asarray(function(a, b, values))


def test_derivatives_are_the_dynamic_models(instance: Instance, car: Car) -> None:
    ode = dynamic(car).ode
    for x, u in points(200):
        instance.put(x, u)
        expected = np.asarray(ode(x, u)).ravel()
        np.testing.assert_allclose(instance.rates(), expected, rtol=1e-12, atol=1e-10)


def test_directional_derivatives_are_exact(instance: Instance, car: Car) -> None:
    exact = jacobian(car)
    random = np.random.default_rng(1)
    for x, u in points(60, 1):
        instance.put(x, u)
        expected = exact(x, u)
        seed, scale = random.normal(size=len(KNOWN)), np.abs(expected).max()
        forward = instance.directional(seed)
        np.testing.assert_allclose(forward, expected @ seed, rtol=1e-11, atol=1e-12 * scale)


def test_a_state_is_an_output_whose_derivative_is_one(instance: Instance) -> None:
    both = instance.references(("x", "delta", "der_delta"))
    known = instance.references(("x", "delta", "delta_rate"))
    out = instance.fmu.getDirectionalDerivative(both, known, [2.0, 3.0, 5.0])
    assert list(out) == [2.0, 3.0, 5.0]


@pytest.mark.parametrize(("d", "rate"), [(0.6, 0.3), (0.3, -0.2)])
def test_a_solver_of_variable_step_drives_like_the_plant(car: Car, d: float, rate: float) -> None:
    start = {"x": 1.0, "psi": 0.3, "vx": 1.0, "d": d, "delta_rate": rate}
    result = simulate_fmu(
        str(packed_car(3, "me")),
        fmi_type="ModelExchange",
        solver="CVode",
        relative_tolerance=1e-10,
        stop_time=1.0,
        output_interval=0.02,
        start_values=start,
        output=list(STATES),
    )
    simulator = Simulator(dynamic(car))
    simulator.reset([start.get(name, 0.0) for name in STATES])
    for _ in range(50):
        simulator.step((d, rate))
    assert result["time"][-1] == pytest.approx(1.0)
    last = [result[name][-1] for name in STATES]
    np.testing.assert_allclose(last, simulator.x, rtol=0, atol=1e-6)
