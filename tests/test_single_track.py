"""The car on linear tyres against CommonRoad's own single-track model, by the chain rule."""

import math
from collections.abc import Iterator
from typing import Any

import casadi as ca
import numpy as np
import pytest
from vehiclemodels.parameters_vehicle2 import parameters_vehicle2
from vehiclemodels.utils.acceleration_constraints import acceleration_constraints
from vehiclemodels.utils.vehicle_dynamics_ks_cog import vehicle_dynamics_ks_cog
from vehiclemodels.vehicle_dynamics_st import vehicle_dynamics_st
from vehiclemodels.vehicle_parameters import VehicleParameters

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.plant.simulator import Simulator
from bayesrace.plant.vehicle import PlantGuard
from bayesrace.vehicles import Car, get_car
from bayesrace.vehicles.models import dynamic, e_kinematic, top_command
from bayesrace.vehicles.parts import LinearTyres
from tests.cars import with_numbers

CAR = get_car("f1tenth")
TYRES, DRIVE = CAR.tyres, CAR.drive
assert isinstance(TYRES, LinearTyres)
SWITCH_MPS = TYRES.switch_mps


def same(one: Any, other: Any) -> None:
    np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


class Axles:
    """CommonRoad's tyres: it knows one stiffness, and reads it for the front, then the rear."""

    def __init__(self, mu: float, front: float, rear: float) -> None:
        self.p_dy1 = mu
        self._stiffness = front, rear
        self._reads = 0

    @property
    def p_ky1(self) -> float:
        self._reads += 1
        return -self.p_dy1 * self._stiffness[(self._reads - 1) % 2]


def theirs(car: Car) -> Any:
    """The car as the package takes it, with actuators that can do anything."""
    numbers = car.equation_numbers
    one = VehicleParameters()
    one.a, one.b, one.m, one.I_z = car.lf_m, car.lr_m, car.mass_kg, car.inertia_kgm2
    one.h_s = numbers["height_m"]
    one.tire = Axles(numbers["mu"], numbers["front_stiffness"], numbers["rear_stiffness"])
    one.steering.min, one.steering.max = -9.0, 9.0
    one.steering.v_min, one.steering.v_max = -99.0, 99.0
    one.longitudinal.v_min, one.longitudinal.v_max = -99.0, 99.0
    one.longitudinal.a_max, one.longitudinal.v_switch = 99.0, 99.0
    return one


def in_their_form(x: Floats, rates: Floats) -> Floats:
    """Rates of [x, y, delta, v, psi, omega, beta] of v = |(vx, vy)| and beta = atan2(vy, vx)."""
    vx, vy = x[3:5]
    v = math.hypot(vx, vy)
    v_rate = (vx * rates[3] + vy * rates[4]) / v
    beta_rate = (vx * rates[4] - vy * rates[3]) / v**2
    return np.array([rates[0], rates[1], rates[6], v_rate, rates[2], rates[5], beta_rate])


def state(theirs: Any) -> Floats:
    """[x, y, psi, vx, vy, omega, delta] of theirs."""
    x, y, delta, v, psi, omega, beta = theirs
    return np.array([x, y, psi, v * math.cos(beta), v * math.sin(beta), omega, delta])


def ours(car: Car, their_state: Any, their_u: Any) -> Floats:
    x = state(their_state)
    rates = np.asarray(dynamic(car).ode(x, [their_u[1], their_u[0]]), dtype=float).ravel()
    return in_their_form(x, rates)


def samples(count: int, low_mps: float, high_mps: float) -> Iterator[tuple[Floats, Floats]]:
    """Random states and inputs in their form, slip angles up to 57 degrees among them."""
    random = np.random.default_rng(5)
    for _ in range(count):
        x = random.uniform([-9, -9, -0.42, low_mps, -7, -9, -1], [9, 9, 0.42, high_mps, 7, 9, 1])
        yield x, random.uniform([-3.2, CAR.d_min], [3.2, CAR.d_max])


def test_it_is_commonroads_model_above_the_switching_speed() -> None:
    one = theirs(CAR)
    for x, u in samples(300, SWITCH_MPS, 20.0):
        same(ours(CAR, x, u), vehicle_dynamics_st(x, u, one))


def test_the_packages_own_test_vector() -> None:
    """Of its unit tests: a BMW 320i, whose drive limits the acceleration that is asked for."""
    p = parameters_vehicle2()
    stiffness = -p.tire.p_ky1 / p.tire.p_dy1
    bmw = with_numbers(
        CAR,
        {
            "lf_m": p.a, "lr_m": p.b, "mass_kg": p.m, "inertia_kgm2": p.I_z,
            "mu": p.tire.p_dy1, "front_stiffness": stiffness, "rear_stiffness": stiffness,
            "height_m": p.h_s, "d_max": p.longitudinal.a_max,
            "power_speed_mps": p.longitudinal.v_switch, "speed_max_mps": p.longitudinal.v_max,
        },
    )  # fmt: skip
    x = [
        2.0233348142065677, 0.0041907137716636, 0.0197545248559617, 15.7216236334290116,
        0.0025857914776859, 0.0529001056654038, 0.0033012170610298,
    ]  # fmt: skip
    acting = min(0.63 * 9.81, float(top_command(bmw, x[3], bmw.d_max)))
    expected = [
        15.7213512030862397, 0.0925527979719355, 0.1500000000000000, 5.3536773276413925,
        0.0529001056654038, 0.6435589397748606, 0.0313297971641291,
    ]  # fmt: skip
    same(ours(bmw, x, [0.15, acting]), expected)


def test_it_rolls_as_commonroads_kinematic_model_below_half_the_switching_speed() -> None:
    """On states that such a car can have. The slip angle's rate is that of the slip angle.

    The package squares tan(delta)**2 in it, which is right to third order in delta only.
    """
    one = theirs(CAR)
    share = CAR.lr_m / CAR.wheelbase_m
    for x, u in samples(200, 0.05, 0.499 * SWITCH_MPS):
        beta = math.atan(share * math.tan(x[2]))
        kinematic = vehicle_dynamics_ks_cog(x[:5], u, one)
        x[5:] = kinematic[4], beta
        slope_rate = u[0] / math.cos(x[2]) ** 2
        beta_rate = share * slope_rate / (1 + math.tan(beta) ** 2)
        turn_rate = u[1] * math.cos(beta) * math.tan(x[2])
        turn_rate -= x[3] * math.sin(beta) * beta_rate * math.tan(x[2])
        turn_rate += x[3] * math.cos(beta) * slope_rate
        expected = [*kinematic, turn_rate / CAR.wheelbase_m, beta_rate]
        same(ours(CAR, x, u), expected)
        if x[3] < 0.1 and abs(x[2]) < 0.02:  # where the package is kinematic, and right
            np.testing.assert_allclose(ours(CAR, x, u), vehicle_dynamics_st(x, u, one), atol=3e-4)


def test_the_passage_is_smooth() -> None:
    """Twice continuously differentiable at both of its ends, and without a number that is none."""
    x, u = ca.SX.sym("x", 7), ca.SX.sym("u", 2)
    first = ca.jacobian(dynamic(CAR).ode(x, u), x)
    second = ca.jacobian(first[:, 3], x)
    function = ca.Function("d", [x, u], [dynamic(CAR).ode(x, u), first, second])
    for speed in (0.5 * SWITCH_MPS, SWITCH_MPS):
        before, after = (
            function([0, 0, 0.2, speed + side, 0.0, 0.3, 0.1], [2.0, 1.0]) for side in (-1e-7, 1e-7)
        )
        for one, other in zip(before, after, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-3)
    for speed in (0.0, -0.0, 1e-12, -0.3, -2.0):
        for vy in (0.0, 0.4):
            for value in function([0, 0, 0, speed, vy, 1.0, 0.3], [1.0, -1.0]):
                assert np.isfinite(np.asarray(ca.densify(value))).all()


def test_throttle_slows_a_car_that_slides_backwards() -> None:
    x = np.array([0, 0, 0, -5.0, 0.5, 0, 0])
    rates = np.asarray(dynamic(CAR).ode(x, [3.0, 0.0]), dtype=float).ravel()
    assert x[3:5] @ rates[3:5] < -2.9 * 5


def test_the_slip_of_a_rolling_car_fades() -> None:
    simulator = Simulator(dynamic(CAR))
    simulator.reset([0, 0, 0, 0.3, 0.1, 2.0, 0.2])
    for _ in range(25):
        simulator.step((0.0, 0.0))
    vx, vy, omega = simulator.x[3:6]
    turn = vx * math.tan(0.2)
    assert vy == pytest.approx(CAR.lr_m / CAR.wheelbase_m * turn, abs=1e-4)
    assert omega == pytest.approx(turn / CAR.wheelbase_m, abs=1e-4)


def test_the_guard_limits_the_acceleration_as_commonroad_does() -> None:
    p = parameters_vehicle2().longitudinal
    p.v_min, p.v_max, p.a_max = 0.0, 20.0, CAR.d_max
    p.v_switch = CAR.guard_numbers["power_speed_mps"]
    guard = PlantGuard(CAR)

    def at(v: float) -> Floats:
        return np.array([0, 0, 0, 0.8 * v, 0.6 * v, 0, 0])

    for v in np.linspace(0.5, 18.9, 40):
        for a in (*np.linspace(-CAR.d_max, 12.0, 13), 0.0):
            acting, _ = guard.apply((a, 0.0), at(v), 0.02)
            assert acting == pytest.approx(acceleration_constraints(v, a, p), rel=1e-12)
    assert guard.apply((5.0, 0.0), at(20.0), 0.02)[0] == 0.0
    assert guard.apply((-99.0, 0.0), at(10.0), 0.02)[0] == CAR.d_min


@pytest.mark.parametrize("command", [None, (CAR.d_min, 0.0), (math.nan, 0.0)])
def test_a_braking_car_stops_and_does_not_reverse(command: tuple[float, float] | None) -> None:
    simulator = Simulator(dynamic(CAR))
    simulator.reset([0, 0, 0, 3.0, 0, 0, 0])
    speeds = []
    for _ in range(60):
        simulator.step(command)
        speeds.append(simulator.x[3])
    assert min(speeds) >= -1e-9
    assert speeds[-1] < 1e-3


def test_the_nominal_model_takes_the_acceleration_as_it_is() -> None:
    rates = np.asarray(e_kinematic(CAR).ode([0, 0, 0, 3, 0.1, 1, 0.2], [2.0, 0.5])).ravel()
    turn = (0.5 * 3 + 0.2 * 2.0) / CAR.wheelbase_m
    same(rates[3:], [2.0, CAR.lr_m * turn, turn, 0.5])


def test_saturating_tyres_have_the_stiffness_at_rest_and_the_friction() -> None:
    soft, p = CAR.on_tyres("pacejka"), CAR.equation_numbers
    assert soft.on_tyres("pacejka") is soft
    with pytest.raises(InputError, match="has pacejka tyres"):
        soft.on_tyres("linear")
    q = soft.equation_numbers
    for axle, lever in (("front", CAR.lr_m), ("rear", CAR.lf_m)):
        load = CAR.mass_kg * 9.81 * lever / CAR.wheelbase_m
        stiffness = q[f"{axle}_b"] * q[f"{axle}_c"] * q[f"{axle}_d"]
        assert stiffness == pytest.approx(p["mu"] * p[f"{axle}_stiffness"] * load)
        assert q[f"{axle}_d"] == pytest.approx(1.0489 * load)


def growth(v_mps: float, command_mps2: float) -> float:
    """Rate [1/s] at which slip angle and yaw rate grow straight ahead; above 0 the car spins."""
    x, u = ca.SX.sym("x", 7), ca.SX.sym("u", 2)
    lateral = dynamic(get_car("f1tenth")).ode(x, u)[4:6]
    rates = ca.Function("rates", [x, u], [ca.jacobian(lateral, x[4:6])])
    matrix = np.array(rates([0, 0, 0, v_mps, 0, 0, 0], [command_mps2, 0]))
    matrix[0, 0] -= command_mps2 / v_mps  # of vy / v: it grows as v falls
    return float(np.linalg.eigvals(matrix).real.max())


def test_the_brake_without_a_controller_is_stable_and_near_the_hardest_that_is() -> None:
    """By the equations' own linearisation, at every speed at which the tyres slide."""
    car = get_car("f1tenth")
    _, least, slow = car.brake_numbers.values()
    assert least == pytest.approx(1.58, abs=0.01)
    for v_mps in np.linspace(1.05, car.drive.top_speed_mps(car.d_max), 40):
        brake = min(least + slow / v_mps**2, -car.d_min)
        assert growth(v_mps, -brake) < 0
        if brake < -car.d_min:
            assert growth(v_mps, -1.36 * brake) > 0


def test_a_car_that_braking_cannot_spin_is_braked_fully() -> None:
    """Without height no load moves; what oversteers at rest is not mended by braking less."""
    car = get_car("f1tenth")
    assert isinstance(car.tyres, LinearTyres)
    for changes in ({"height_m": 0.0}, {"front_stiffness": 2 * car.tyres.rear_stiffness}):
        other = car.model_copy(update={"tyres": car.tyres.model_copy(update=changes)})
        assert other.brake_numbers["brake_d"] > 10 * -car.d_min
    assert car.on_tyres("pacejka").brake_numbers["brake_d"] > 10 * -car.d_min
    assert get_car("orca").brake_numbers["brake_d"] > 10 * -get_car("orca").d_min
