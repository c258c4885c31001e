"""Integrators: the order that they claim is measured; the identity names what matters."""

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.integrate import solve_ivp

from bayesrace.arrays import Floats
from bayesrace.integrators import PERFECT, PREDICTION, SCHEMES, Discretisation
from bayesrace.vehicles import Car
from bayesrace.vehicles.models import MODELS, Model, dynamic, e_kinematic
from tests.cars import with_numbers

X = np.array([0.3, -0.2, 0.7, 1.8, 0.1, 1.0, 0.12])
U = np.array([0.6, -1.5])


def exact(model: Model, x: Floats, u: Floats, time_s: float) -> Floats:
    """scipy's eighth-order solution to round-off."""

    def rate(_: float, state: Floats) -> Floats:
        return np.asarray(model.ode(state, u), dtype=float).ravel()

    solution = solve_ivp(rate, (0, time_s), x, method="DOP853", rtol=1e-13, atol=1e-13)
    assert solution.success
    return np.asarray(solution.y[:, -1])


def one(discretisation: Discretisation, model: Model) -> Floats:
    return np.asarray(discretisation.discretise(model)(X, U), dtype=float).ravel()


@pytest.mark.parametrize("name", ["dynamic", "e_kinematic"])
@pytest.mark.parametrize("scheme", sorted(SCHEMES))
def test_the_order_measured_by_halving_is_the_order_claimed(
    car: Car, scheme: str, name: str
) -> None:
    model, (order, _) = MODELS[name](car), SCHEMES[scheme]
    truth = exact(model, X, U, 0.2)
    counts = np.array([16, 32, 64])
    errors = [
        np.linalg.norm(one(Discretisation(scheme=scheme, step_s=0.2, substeps=n), model) - truth)
        for n in counts
    ]
    measured = np.log2(errors[1] / errors[2])
    assert measured == pytest.approx(order, abs=0.25), errors


@pytest.mark.parametrize("scheme", sorted(SCHEMES))
def test_substeps_are_the_same_as_shorter_steps(car: Car, scheme: str) -> None:
    model = dynamic(car)
    short = Discretisation(scheme=scheme, step_s=0.005).discretise(model)
    x = X
    for _ in range(4):
        x = np.asarray(short(x, U), dtype=float).ravel()
    whole = one(Discretisation(scheme=scheme, step_s=0.02, substeps=4), model)
    np.testing.assert_allclose(whole, x, rtol=1e-13, atol=1e-13)


def test_the_perfect_discretisation_is_stable_and_accurate_from_standstill(
    car: Car,
) -> None:
    """Tyre forces are stiff at low speed: too few sub-steps oscillate."""
    model = dynamic(car)
    x = np.array([0.0, 0, 0, 0.1, 0, 0, 0.2])
    u = np.array([1.0, 0.0])
    ours = np.asarray(PERFECT.discretise(model)(x, u), dtype=float).ravel()
    np.testing.assert_allclose(ours, exact(model, x, u, 0.02), atol=2e-3)


def exact_pose(start: Floats, end: Floats, time_s: float) -> Floats:
    """Pose when vx, vy and omega go linearly from those in ``start`` to ``end`` (3,)."""

    def rate(t: float, pose: Floats) -> Floats:
        vx, vy, omega = start[3:6] + (end - start[3:6]) * t / time_s
        c, s = np.cos(pose[2]), np.sin(pose[2])
        return np.array([vx * c - vy * s, vx * s + vy * c, omega])

    solution = solve_ivp(rate, (0, time_s), start[:3], method="DOP853", rtol=1e-13, atol=1e-13)
    return np.asarray(solution.y[:, -1])


def test_the_interpolated_pose_follows_the_corrected_velocities(car: Car) -> None:
    """Heading exactly; position with an error that falls by 2^5 when the step is halved."""
    model, errors = e_kinematic(car), []
    correction = np.array([0.05, -0.04, 0.6])
    for step_s in (0.08, 0.04):
        discretisation = Discretisation(step_s=step_s, pose="interpolated")
        f = discretisation.corrected(model)
        x_next = np.asarray(f(X, U, correction * step_s / 0.08), dtype=float).ravel()
        truth = exact_pose(X, x_next[3:6], step_s)
        assert x_next[2] == pytest.approx(truth[2], abs=1e-13)
        errors.append(float(np.linalg.norm(x_next[:2] - truth[:2])))
    assert errors[0] < 1e-5
    assert errors[0] / errors[1] > 2**4


def test_the_correction_reaches_the_velocities_and_the_pose_only_if_interpolated(
    car: Car,
) -> None:
    correction = np.array([0.01, 0.02, 0.3])
    for pose in ("integrated", "interpolated"):
        discretisation = PREDICTION.model_copy(update={"pose": pose})
        f = discretisation.corrected(e_kinematic(car))
        with_it, without = (
            np.asarray(f(X, U, e), dtype=float).ravel() for e in (correction, np.zeros(3))
        )
        np.testing.assert_array_equal(without, one(discretisation, e_kinematic(car)))
        np.testing.assert_allclose((with_it - without)[3:6], correction, rtol=1e-12)
        assert with_it[6] == without[6]
        assert (with_it[:3] != without[:3]).all() == (pose == "interpolated")


@pytest.mark.parametrize(
    "other",
    [
        {"scheme": "euler"},
        {"scheme": "heun"},
        {"step_s": 0.025},
        {"step_s": 0.0200001},
        {"substeps": 2},
        {"pose": "integrated"},
    ],
)
def test_identity_changes_with_the_discretisation(car: Car, other: dict[str, object]) -> None:
    changed = PREDICTION.model_copy(update=other)
    ours = PREDICTION.identity("e_kinematic", car)
    assert changed.identity("e_kinematic", car) != ours
    assert PREDICTION.identity("dynamic", car) != ours


@pytest.mark.parametrize(
    "field", ["lf_m", "lr_m", "mass_kg", "inertia_kgm2", "cm1", "cm2", "cr0", "front_b"]
)
def test_identity_changes_with_the_car(car: Car, field: str) -> None:
    changed = with_numbers(car, {field: 1.01 * car.equation_numbers[field]})
    assert PREDICTION.identity("dynamic", changed) != PREDICTION.identity("dynamic", car)


@pytest.mark.parametrize("field", ["friction", "width_m", "length_m"])
def test_identity_ignores_friction_and_outline(car: Car, field: str) -> None:
    changed = car.model_copy(update={field: 1.5 * getattr(car, field)})
    assert changed.model_copy(update={"name": "x"}).digest() == car.digest()
    assert PREDICTION.identity("dynamic", changed) == PREDICTION.identity("dynamic", car)


@pytest.mark.parametrize(
    "bad", [{"scheme": "rk5"}, {"step_s": 0.0}, {"step_s": float("nan")}, {"substeps": 0}]
)
def test_senseless_settings_are_refused(bad: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        Discretisation.model_validate(bad)
