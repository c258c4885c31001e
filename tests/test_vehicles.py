"""Vehicle models: the paper's table 1 at speed, and sane behaviour through standstill."""

import casadi as ca
import numpy as np
import pytest

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.integrators import Discretisation
from bayesrace.vehicles import Car, get_car
from bayesrace.vehicles.models import (
    BLEND_SPEED_MPS,
    MODELS,
    ROLL_SPEED_MPS,
    Model,
    dynamic,
    e_kinematic,
    kinematic,
)
from tests.conftest import TRUTH

MIRROR = np.array([1.0, -1, -1, 1, -1, -1, -1])
EPS = 1e-7


def rate(model: Model, x: Floats, u: Floats) -> Floats:
    return np.asarray(model.ode(x, u), dtype=float).ravel()


def at_speed(count: int, seed: int = 0) -> list[tuple[Floats, Floats]]:
    """Random states and inputs well inside what the car does, above the blend speed."""
    random = np.random.default_rng(seed)
    low = np.array([-5, -5, -7, 0.3, -0.6, -6, -0.35, -0.1, -5])
    high = np.array([5, 5, 7, 4, 0.6, 6, 0.35, 1, 5])
    points = random.uniform(low, high, (count, 9))
    points[:, 4] *= points[:, 3] / 4  # slip stays below a quarter turn
    points[:, 5] *= points[:, 3] / 4
    return [(p[:7], p[7:]) for p in points]


def table_1_dynamic(car: Car, x: Floats, u: Floats) -> Floats:
    """Written from the paper, not from the code."""
    _, _, psi, vx, vy, omega, delta = x
    alpha_f = delta - np.arctan((omega * car.lf_m + vy) / vx)
    alpha_r = np.arctan((omega * car.lr_m - vy) / vx)
    p = car.equation_numbers
    f_fy = p["front_d"] * np.sin(p["front_c"] * np.arctan(p["front_b"] * alpha_f))
    f_ry = p["rear_d"] * np.sin(p["rear_c"] * np.arctan(p["rear_b"] * alpha_r))
    f_rx = (p["cm1"] - p["cm2"] * vx) * u[0] - p["cr0"] - p["cr2"] * vx**2
    return np.array(
        [
            vx * np.cos(psi) - vy * np.sin(psi),
            vx * np.sin(psi) + vy * np.cos(psi),
            omega,
            (f_rx - f_fy * np.sin(delta) + car.mass_kg * vy * omega) / car.mass_kg,
            (f_ry + f_fy * np.cos(delta) - car.mass_kg * vx * omega) / car.mass_kg,
            (f_fy * car.lf_m * np.cos(delta) - f_ry * car.lr_m) / car.inertia_kgm2,
            u[1],
        ]
    )


def table_1_e_kinematic(car: Car, x: Floats, u: Floats) -> Floats:
    _, _, psi, vx, vy, omega, delta = x
    p = car.equation_numbers
    ax = (p["cm1"] - p["cm2"] * vx) * u[0] / car.mass_kg
    turn = (u[1] * vx + delta * ax) / (car.lf_m + car.lr_m)
    return np.array(
        [
            vx * np.cos(psi) - vy * np.sin(psi),
            vx * np.sin(psi) + vy * np.cos(psi),
            omega,
            ax,
            car.lr_m * turn,
            turn,
            u[1],
        ]
    )


def table_1_kinematic(car: Car, x: Floats, u: Floats) -> Floats:
    _, _, psi, v, delta = x
    beta = np.arctan(car.lr_m / (car.lf_m + car.lr_m) * np.tan(delta))
    return np.array(
        [v * np.cos(psi + beta), v * np.sin(psi + beta), v / car.lr_m * np.sin(beta), *u]
    )


def test_dynamic_model_is_table_1_at_speed(car: Car) -> None:
    model = dynamic(car)
    for x, u in at_speed(200):
        expected = table_1_dynamic(car, x, u)
        np.testing.assert_allclose(rate(model, x, u), expected, rtol=1e-11, atol=1e-11)


def test_e_kinematic_model_is_table_1(car: Car) -> None:
    model = e_kinematic(car)
    for x, u in at_speed(200, seed=1):
        expected = table_1_e_kinematic(car, x, u)
        np.testing.assert_allclose(rate(model, x, u), expected, rtol=1e-12, atol=1e-12)


def test_kinematic_model_is_table_1(car: Car) -> None:
    model = kinematic(car)
    for x7, u in at_speed(200, seed=2):
        x = x7[[0, 1, 2, 3, 6]]
        expected = table_1_kinematic(car, x, u)
        np.testing.assert_allclose(rate(model, x, u), expected, rtol=1e-12, atol=1e-12)


def derivatives(model: Model) -> ca.Function:
    """xdot, first and second derivative with respect to vx."""
    x, u = ca.SX.sym("x", 7), ca.SX.sym("u", 2)
    value = model.ode(x, u)
    first = ca.jacobian(value, x[3])
    return ca.Function("d", [x, u], [value, first, ca.jacobian(first, x[3])])


@pytest.mark.parametrize("speed", [BLEND_SPEED_MPS, ROLL_SPEED_MPS, -ROLL_SPEED_MPS])
def test_dynamic_model_is_c2_through_the_blend_speeds(car: Car, speed: float) -> None:
    function = derivatives(dynamic(car))
    u = np.array([0.3, 0.5])

    def sides(h: float) -> list[float]:
        low, high = (
            function(np.array([0, 0, 0.2, speed + side, 0.01, 0.2, 0.0]), u) for side in (-h, h)
        )
        return [float(np.abs(np.asarray(b - a)).max()) for a, b in zip(low, high, strict=True)]

    # the one-sided limits meet: the difference across the seam vanishes with its width
    for wide, narrow in zip(sides(1e-5), sides(1e-8), strict=True):
        assert narrow <= 1e-2 * wide + 1e-7


@pytest.mark.parametrize("name", ["dynamic", "e_kinematic"])
@pytest.mark.parametrize("vx", [0.0, -0.0, 1e-12, -1e-3, -0.1, -0.5])
def test_nothing_is_nan_at_and_below_standstill(car: Car, name: str, vx: float) -> None:
    x, u = ca.SX.sym("x", 7), ca.SX.sym("u", 2)
    model = MODELS[name](car)
    xdot = model.ode(x, u)
    jacobian = ca.jacobian(xdot, ca.vertcat(x, u))
    curvature = ca.jacobian(ca.vec(jacobian), ca.vertcat(x, u))
    function = ca.Function("all", [x, u], [xdot, jacobian, curvature])
    for vy, omega, delta in [(0, 0, 0), (0, 0, 0.35), (0.1, -1, -0.35)]:
        for out in function(np.array([0, 0, 0, vx, vy, omega, delta]), np.array([0.2, 1.0])):
            assert np.isfinite(np.asarray(ca.densify(out))).all()


@pytest.mark.parametrize("name", sorted(MODELS))
def test_a_standing_car_stays_where_it_is(car: Car, name: str) -> None:
    model = MODELS[name](car)
    x = np.zeros(len(model.states))
    x[-1] = 0.2  # steering turned
    np.testing.assert_array_equal(rate(model, x, np.zeros(2)), 0.0)


def test_a_coasting_car_stops_and_rolling_resistance_never_pushes_it_back(
    car: Car,
) -> None:
    step = TRUTH.discretise(dynamic(car))
    for delta in (0.0, 0.3):
        x = np.array([0.0, 0, 0, 0.8, 0, 0, delta])
        speeds = []
        for _ in range(150):
            x = np.asarray(step(x, np.zeros(2)), dtype=float).ravel()
            speeds.append(x[3])
        assert min(speeds) >= -1e-9
        assert speeds[-1] < 1e-6


def test_rolling_resistance_opposes_the_motion_on_both_sides(car: Car) -> None:
    model = dynamic(car)
    for v in (1e-4, 0.01, 0.05, 1.0):
        forward, backward = (
            rate(model, np.array([0, 0, 0, side * v, 0, 0, 0.0]), np.zeros(2))[3]
            for side in (1.0, -1.0)
        )
        assert forward < 0 < backward
        assert forward == -backward


@pytest.mark.parametrize("name", ["dynamic", "e_kinematic"])
def test_mirror_symmetry(car: Car, name: str) -> None:
    model = MODELS[name](car)
    slow = [(np.array([0.3, 1, 0.5, v, 0.02, 1, 0.2]), np.array([0.5, -2])) for v in (0, 0.05)]
    for x, u in [*at_speed(50, seed=3), *slow]:
        mirrored = rate(model, x * MIRROR, u * [1, -1])
        np.testing.assert_allclose(mirrored, rate(model, x, u) * MIRROR, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("delta", [0.02, 0.04])
def test_e_kinematic_equals_kinematic_in_a_gentle_turn(car: Car, delta: float) -> None:
    """Steering slowly to delta: the same path up to terms of second order in delta."""
    v, ends = 1.5, []
    for model in (kinematic(car), e_kinematic(car)):
        step = Discretisation(substeps=10).discretise(model)
        x = np.zeros(len(model.states))
        x[3] = v
        for _ in range(50):  # within one second
            x = np.asarray(step(x, np.array([0.0, delta])), dtype=float).ravel()
        ends.append(x)
    simple, extended = ends
    yaw_rate = rate(kinematic(car), simple, np.zeros(2))[2]
    assert extended[5] == pytest.approx(yaw_rate, rel=delta**2)
    assert extended[4] == pytest.approx(car.lr_m * yaw_rate, rel=delta**2)
    np.testing.assert_allclose(extended[:3], simple[:3], atol=v * delta**2)


def test_unknown_car_is_an_input_error_that_names_the_known_ones() -> None:
    with pytest.raises(InputError, match=r"unknown car 'kart'.*orca"):
        get_car("kart")
