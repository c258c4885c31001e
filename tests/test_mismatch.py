"""What the corrected model errs by is estimated while driving: a car that has changed since it was
learned is driven by what it does now, and with care where that is not known."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from rich.console import Console
from scipy.stats import multivariate_normal

from bayesrace.arrays import Floats
from bayesrace.codegen.problems.tracking import tracking
from bayesrace.controller.assembly import PredictiveController, compiled_controller
from bayesrace.controller.driver import Driver
from bayesrace.controller.native_step import NativeStep
from bayesrace.controller.process_settings import ControllerSettings
from bayesrace.controller.settings import MpcSettings
from bayesrace.errors import InputError
from bayesrace.gp.weights import Weights
from bayesrace.integrators import PREDICTION
from bayesrace.learning.validation import predictive_sigma
from bayesrace.operation.closed_loop import ClosedLoop, built_in_car
from bayesrace.operation.preparation import prepare
from bayesrace.operation.settings import PreparationSettings
from bayesrace.operation.terminal.terminal import stages_on
from bayesrace.plant.simulator import Simulator
from bayesrace.sensors import Sensors, get_sensors
from bayesrace.vehicles import Car
from bayesrace.vehicles.models import e_kinematic
from bayesrace.vehicles.parts import DcMotor
from tests.conftest import CAUTIOUS, Circuit, Make
from tests.cycle_rig import state
from tests.instruments import ROUGH, mocap
from tests.racing import Racing, racing

STEP_S = PREDICTION.step_s


@pytest.fixture
def step(make: Make) -> NativeStep:
    return make(caution=0.95)


@dataclass
class Drive:
    """States (n + 1, 7) and inputs (n, 2) of a car that does in each step what the weights say, and
    an error; the widening of each step."""

    states: Floats
    inputs: Floats
    widening: list[float]


def drive(
    step: NativeStep,
    plain: NativeStep,
    circuit: Circuit,
    error: Callable[[Floats, Floats], Floats],
    count: int,
    prepared: bool = False,
) -> Drive:
    """``plain``: a controller of the same weights that has seen nothing. ``error``: of x and u,
    (3,), added to vx, vy, omega."""
    x, u = circuit.start(), np.zeros(2)
    states, inputs, widening = [x], [], []
    for _ in range(count):
        assert step.step(x, u).usable
        widening.append(step.info.widening)
        u = step.u.copy()
        if prepared:
            step.prepare()
        after = plain.predict(x, u, STEP_S)
        after[3:6] += error(x, u)
        step.observe(x, u, STEP_S, after)
        states.append(after)
        inputs.append(u)
        x = after
    return Drive(np.array(states), np.array(inputs), widening)


def constant(*error: float) -> Callable[[Floats, Floats], Floats]:
    return lambda x, u: np.array(error)


def of_state(x: Floats, u: Floats) -> Floats:
    """A weaker motor, and a car that turns less."""
    return np.array([-0.05 * u[0], 0.02 * x[5], -0.3 * x[5]])


def terms_of(plain: NativeStep, car: Car, x: Floats, u: Floats) -> Floats:
    """[1; features; changes by the model] in their units, (10,)."""
    problem = tracking(e_kinematic(car), PREDICTION)
    deviation = np.array([one.deviation for one in problem.states])
    effort = np.array([one.effort for one in problem.inputs])
    change = (plain.predict(x, u, STEP_S) - x)[3:6] / (0.1 * deviation[3:6])
    return np.concatenate([[1.0], x[3:] / deviation[3:], u / effort, change])


Variance = Callable[[Floats], float]


def regression(phi: Floats, y: Floats, r: Floats, prior: Floats) -> tuple[Floats, float]:
    """Weights, of these variances before, and log density of the errors y, of independent variances
    r, in another form than the compiled one: by the joint distribution of all errors."""
    covariance = np.diag(r) + phi * prior @ phi.T
    weights = prior * (phi.T @ np.linalg.solve(covariance, y))
    return weights, float(multivariate_normal(np.zeros(len(y)), covariance).logpdf(y))


def regressed(phi: Floats, y: Floats, r: Floats, odd: bool) -> tuple[Floats, Variance]:
    """Weights (10,) after all errors y (n,), which are limited, of variances r before they age; and
    what is not known of the mismatch at other terms."""
    asymmetric = np.array([0, 0, 1, 1, 1, 0, 1, 0, 1, 1]) != odd
    share = np.where(asymmetric, 0.01, 1.0)
    weights, prior, excess, surprise = np.zeros(10), 0.0, 0.0, 0.0
    age, taken = np.ones(0), np.zeros(0)
    for n in range(1, len(y) + 1):
        spread = np.sqrt(max(excess, 1.0) * r[n - 1])
        expected = phi[n - 1] @ weights
        off = np.clip((y[n - 1] - expected) / spread, -20, 20)
        surprise += (off**2 - surprise) / 10
        age = np.append(age * np.exp(-min(STEP_S / 8 * max(surprise / 2, 1.0), 0.1)), 1.0)
        taken = np.append(taken, expected + off * spread)
        usual = age.sum() / (age / r[:n]).sum()
        tried = np.clip(prior, 1e-4 * usual, 1e6 * usual) * np.array([0.25, 1.0, 4.0])
        scaled = max(excess, 1.0) * r[:n] / age
        fits = [(*regression(phi[:n], taken, scaled, one * share), one) for one in tried]
        weights, _, prior = max(fits, key=lambda fit: fit[1])
        scale = max(excess, 1.0)
        excess = float((age * (taken - phi[:n] @ weights) ** 2 / r[:n]).sum() / age.sum())
    information = (phi.T * age / r / scale) @ phi
    covariance = np.linalg.inv(information + np.diag(1 / (prior * share)))
    chance = 2 * float(np.sqrt(2 / age.sum()))
    unexplained = float(age.sum() / (age / r).sum()) * max(excess - 1.5 - chance, 0)

    def variance(at: Floats) -> float:
        of_weights = float(at @ covariance @ at)
        leverage = of_weights * float((age / r).sum()) / scale / len(at)
        return of_weights + unexplained + leverage * float(0.2 * at @ weights) ** 2

    return weights, variance


def test_the_error_is_the_regression_of_what_was_observed(
    make: Make, step: NativeStep, weights: Weights, car: Car, circuit: Circuit
) -> None:
    """Against NumPy, from all errors at each step, older ones with larger variances: what the model
    is corrected by, and what widens the band of a plan."""
    plain = make()
    seen = drive(step, plain, circuit, of_state, 60)
    plan_x, plan_u = (part.copy() for part in step.read_plan())
    assert step.solve(seen.states[-1], seen.inputs[-1], step.read_reference(), elapsed_s=0.0).usable
    stages = np.arange(7) * (len(plan_u) - 1) // 6
    at = np.array([terms_of(plain, car, plan_x[k], plan_u[k]) for k in stages])
    known = predictive_sigma(weights, np.column_stack([plan_x[stages, 3:], plan_u[stages]])) ** 2
    pairs = list(zip(seen.states[:-1], seen.inputs, strict=True))
    phi = np.array([terms_of(plain, car, x, u) for x, u in pairs])
    y = np.array([of_state(x, u) for x, u in pairs])
    noise = np.array([one.y_scale**2 * one.noise_variance for one in weights.outputs])
    total = predictive_sigma(weights, np.column_stack([seen.states[:-1, 3:], seen.inputs])) ** 2
    r = 10 * (total - noise) + noise
    used = len(y) - 1  # what is observed before a step counts from the one after it on
    x, u = seen.states[30], seen.inputs[30]
    found = [regressed(phi[:used], y[:used, j], r[:used, j], j > 0) for j in range(3)]
    unknown = np.array([[of(one) for _, of in found] for one in at])
    assert step.info.widening == pytest.approx(np.sqrt(1 + (unknown / known).max()), rel=1e-5)
    expected = np.array([one for one, _ in found]) @ terms_of(plain, car, x, u)
    ours = step.predict(x, u, STEP_S) - plain.predict(x, u, STEP_S)
    np.testing.assert_allclose(ours[3:6], expected, rtol=1e-5)
    np.testing.assert_allclose(ours[3:6], of_state(x, u), rtol=0.4, atol=5e-3)  # most of it


def averaged(measurements: list[tuple[Floats, Floats, Floats]], odd: bool) -> Floats:
    """Weights (10,) after all measurements, each of rows by (n, 10) and values (n,) with noise of
    variance 1, and terms; as above, and averaged with a model of no weights."""
    asymmetric = np.array([0, 0, 1, 1, 1, 0, 1, 0, 1, 1]) != odd
    share = np.where(asymmetric, 0.01, 1.0)
    weights, prior, excess, surprise = np.zeros(10), 0.0, 0.0, 0.0
    age = np.ones(0)
    for n in range(1, len(measurements) + 1):
        rows, y, _ = measurements[n - 1]
        off = float(((y - rows @ weights) ** 2).mean()) / max(excess, 1.0)
        surprise += (off - surprise) / 10
        age = np.append(age * np.exp(-min(STEP_S / 8 * max(surprise / 2, 1.0), 0.1)), 1.0)
        precision = sum(
            one * (rows**2).sum() / (phi @ phi)
            for one, (rows, _, phi) in zip(age, measurements, strict=False)
        )
        usual = age.sum() / precision
        all_rows = np.concatenate([rows for rows, _, _ in measurements[:n]])
        values = np.concatenate([y for _, y, _ in measurements[:n]])
        each = np.repeat(age, len(y))
        scaled = max(excess, 1.0) / each
        tried = np.clip(prior, 1e-4 * usual, 1e6 * usual) * np.array([0.25, 1.0, 4.0])
        fits = [(*regression(all_rows, values, scaled, one * share), one) for one in tried]
        found, evidence, prior = max(fits, key=lambda fit: fit[1])
        evidence -= multivariate_normal(np.zeros(len(values)), np.diag(scaled)).logpdf(values)
        excess = float((each * (values - all_rows @ found) ** 2).sum() / each.sum())
        weights = found / (1 + np.exp(3 - evidence))
    return weights


@pytest.mark.parametrize("size", [1e-4, 1e-3], ids=["noise", "a mismatch"])
def test_what_measurements_say_is_averaged_with_no_mismatch(
    make: Make, step: NativeStep, car: Car, circuit: Circuit, size: float
) -> None:
    """Against NumPy, from all measurements at each step."""
    plain, random, ffi = make(), np.random.default_rng(4), step.artefact.ffi
    true, x, u = size * random.normal(size=(3, 10)), circuit.start(), np.zeros(2)
    measurements: list[list[tuple[Floats, Floats, Floats]]] = [[], [], []]
    for _ in range(25):
        assert step.step(x, u).usable
        u, after = step.u.copy(), plain.predict(x, step.u, STEP_S)
        noise = ffi.new("br_mpc_noise *", {"values": 3.0})
        for j in range(3):
            rows = 1e3 * random.normal(size=(3, 10))
            y = rows @ true[j] + random.normal(size=3)
            measurements[j].append((rows, y, terms_of(plain, car, x, u)))
            noise.information[j] = (rows.T @ rows).tolist()
            noise.projection[j] = (rows.T @ y).tolist()
            noise.squares[j] = float(y @ y)
        given = [ffi.new("double[]", one.tolist()) for one in (x, u, after)]
        error = step.artefact.library.br_mpc_observe(
            step.handle, *given[:2], STEP_S, given[2], noise
        )
        assert not error
        x = after
    expected = np.array([averaged(one[:-2], j > 0) for j, one in enumerate(measurements)])
    ours = step.predict(x, u, STEP_S) - plain.predict(x, u, STEP_S)
    np.testing.assert_allclose(
        ours[3:6], expected @ terms_of(plain, car, x, u), rtol=1e-4, atol=1e-9
    )


def test_derivatives_are_those_of_what_is_predicted(
    make: Make, step: NativeStep, circuit: Circuit
) -> None:
    """Of the corrected model with its mismatch, by finite differences. What the mismatch does to
    the pose within a stage is linear in it, with the slope that the model has without."""
    seen = drive(step, make(), circuit, of_state, 30)
    v, costate = np.concatenate([seen.states[20], seen.inputs[20]]), np.arange(1.0, 8.0)
    ahead, jacobian, hessian = step.evaluate(v, costate)
    bends = []
    np.testing.assert_allclose(ahead, step.predict(v[:7], v[7:], STEP_S), atol=1e-5)
    size = 1e-5
    for i in range(9):
        beside = [step.evaluate(v + sign * size * np.eye(9)[i], costate) for sign in (-1, 1)]
        slope = (beside[1][0] - beside[0][0]) / (2 * size)
        bend = costate @ (beside[1][1] - beside[0][1]) / (2 * size)
        np.testing.assert_allclose(jacobian[3:, i], slope[3:], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(jacobian[:3, i], slope[:3], rtol=0, atol=1e-3)
        bends.append(bend)
    bent = np.array(bends)
    np.testing.assert_allclose(hessian, bent, rtol=0, atol=0.01 * np.abs(bent).max())


def test_a_model_that_is_right_stays_as_it_is(
    make: Make, step: NativeStep, weights: Weights, circuit: Circuit
) -> None:
    """A car that is as noisy as its weights say: less than a fifth of that is corrected."""
    plain, rng = make(), np.random.default_rng(0)
    noise = np.array([one.y_scale * np.sqrt(one.noise_variance) for one in weights.outputs])
    seen = drive(step, plain, circuit, lambda x, u: noise * rng.standard_normal(3), 100)
    for x, u in zip(seen.states[50:-1], seen.inputs[50:], strict=True):
        far = step.predict(x, u, STEP_S) - plain.predict(x, u, STEP_S)
        assert (np.abs(far[3:6]) < 0.2 * noise).all()
    assert max(seen.widening) < 1.1


def test_what_the_regression_does_not_explain_widens_the_band(
    make: Make, step: NativeStep, circuit: Circuit
) -> None:
    """An error that is another one each time."""
    signs = iter(np.random.default_rng(0).choice([-1.0, 1.0], 100))
    seen = drive(step, make(), circuit, lambda x, u: next(signs) * np.array([0.1, 0.1, 2.0]), 40)
    assert seen.widening[0] == 1.0
    assert seen.widening[-1] > 5


def test_the_preparation_changes_nothing(make: Make, car: Car, circuit: Circuit) -> None:
    """Also if parameters are set between it and the step."""
    ends = []
    for prepared in (False, True):
        step, plain = make(caution=0.95), make()
        first = drive(step, plain, circuit, of_state, 20, prepared)
        step.set_parameters(car, CAUTIOUS.model_copy(update={"caution": 0.9}))
        again = drive(step, plain, circuit, of_state, 5, prepared)
        ends.append((first.widening, again.widening, again.states.tobytes()))
    assert ends[0] == ends[1]


def test_other_weights_and_a_new_run_begin_without_mismatch(
    make: Make, step: NativeStep, weights: Weights, circuit: Circuit
) -> None:
    plain, x, u = make(), circuit.start(), np.array([0.3, 0.1])
    vx, vy, omega = weights.outputs
    other = replace(weights, outputs=(replace(vx, y_mean=vx.y_mean + 0.1), vy, omega))
    begins: list[tuple[NativeStep, Callable[[], object]]] = [
        (plain, step.reset), (make(other), lambda: step.set_weights(other))
    ]  # fmt: skip
    for expected, begin in begins:
        assert drive(step, plain, circuit, of_state, 15).widening[-1] > 1.3
        assert not np.allclose(step.predict(x, u, STEP_S), plain.predict(x, u, STEP_S))
        begin()
        np.testing.assert_array_equal(step.predict(x, u, STEP_S), expected.predict(x, u, STEP_S))
        assert step.step(x, u).usable
        assert step.info.widening == 1.0


def test_weights_that_are_in_use_already_change_nothing(
    make: Make, step: NativeStep, weights: Weights, circuit: Circuit
) -> None:
    plain, x, u = make(), circuit.start(), np.array([0.3, 0.1])
    drive(step, plain, circuit, of_state, 15)
    before = step.predict(x, u, STEP_S)
    assert not np.allclose(before, plain.predict(x, u, STEP_S))
    step.set_weights(weights)
    assert step.predict(x, u, STEP_S).tobytes() == before.tobytes()


def test_switched_off_and_on_caution_begins_anew(
    make: Make, step: NativeStep, car: Car, circuit: Circuit
) -> None:
    plain = make()
    x, u = drive(step, plain, circuit, of_state, 15).states[-1], np.zeros(2)
    for caution in (0.0, 0.95):
        step.set_parameters(car, CAUTIOUS.model_copy(update={"caution": caution}))
        for _ in range(2):
            np.testing.assert_array_equal(step.predict(x, u, STEP_S), plain.predict(x, u, STEP_S))
            assert step.step(x, u).usable
            assert step.info.widening == 1.0


def test_without_caution_nothing_is_corrected(make: Make, circuit: Circuit) -> None:
    """The paper's controller."""
    step, plain = make(), make()
    seen = drive(step, plain, circuit, constant(0.1, 0.1, 3.0), 20)
    assert set(seen.widening) == {1.0}
    x, u = seen.states[-1], seen.inputs[-1]
    np.testing.assert_array_equal(step.predict(x, u, STEP_S), plain.predict(x, u, STEP_S))


def test_durations_and_numbers_that_are_none_are_refused(step: NativeStep) -> None:
    for duration_s in (0.0, -0.1, 1.5, np.nan):
        with pytest.raises(InputError, match="a time"):
            step.observe(np.zeros(7), np.zeros(2), duration_s, np.zeros(7))
    with pytest.raises(InputError, match="not finite"):
        step.observe(np.zeros(7), np.zeros(2), STEP_S, np.full(7, np.nan))


def test_an_error_counts_by_stages(make: Make, circuit: Circuit) -> None:
    """Twice as much in twice the time is the same one."""
    last = []
    for stages in (1.0, 1.5):
        step, plain = make(caution=0.95), make()
        x, u = circuit.start(), np.zeros(2)
        for _ in range(20):
            assert step.step(x, u).usable
            after = plain.predict(x, u, stages * STEP_S)
            after[3] += 0.5 * stages
            step.observe(x, u, stages * STEP_S, after)
        last.append((step.predict(x, u, STEP_S) - plain.predict(x, u, STEP_S))[3])
    assert last[0] == pytest.approx(0.5, rel=0.05)
    assert last[1] == pytest.approx(last[0], rel=0.02)


def test_one_wrong_measurement_does_not_count_for_long(
    make: Make, step: NativeStep, circuit: Circuit
) -> None:
    """It is taken for twenty usual errors, once."""
    plain, x, u = make(), circuit.start(), np.zeros(2)
    widening = []
    for k in range(60):
        assert step.step(x, u).usable
        after = plain.predict(x, u, STEP_S)
        if k == 20:
            after[3:6] += 50.0
        step.observe(x, u, STEP_S, after)
        widening.append(step.info.widening)
    assert widening[20] < 1.1 < widening[22] < 30
    assert widening[-1] < widening[22]
    far = step.predict(x, u, STEP_S) - plain.predict(x, u, STEP_S)
    assert np.abs(far[3:6]).max() < 0.02


@pytest.mark.parametrize(
    ("numbers", "vx_mps", "widens"),
    [(range(12), 1.0, True), (range(0, 24, 2), 1.0, False), (range(12), 0.0, False)],
    ids=["in a row", "gaps", "standing"],
)
def test_the_cycle_shows_states_in_a_row_of_a_car_that_moves(
    step: NativeStep,
    car: Car,
    circuit: Circuit,
    numbers: range,
    vx_mps: float,
    widens: bool,
) -> None:
    """Its yaw rate is another each time, which no model predicts, and no monitor would believe."""
    settings = ControllerSettings(stale_s=0.1, sensor_tolerance=0)
    driver = Driver(PredictiveController(step), car, settings)
    for number in numbers:
        x = circuit.start()
        x[3], x[5] = vx_mps, 8.0 * (-1) ** number
        driver.observe(state(number, x=tuple(x)))
        driver.decide(number * STEP_S)
        driver.prepare(STEP_S)
    assert driver.output is not None
    widening = driver.output.numbers["widening"]
    assert widening > 2 if widens else widening == 1.0


def slippery(race: Racing) -> Simulator:
    """A fifth of the tyre forces of the car that the weights and the line are made for."""
    return built_in_car(race.car.model_copy(update={"tyres": race.car.true_tyres.with_grip(0.8)}))


@pytest.mark.check
@pytest.mark.parametrize("sensors", [get_sensors("exact"), mocap(ROUGH)], ids=["exact", "1 mm"])
def test_a_car_that_has_lost_grip_since_it_was_learned_stays_on_the_track(
    sensors: Sensors,
) -> None:
    race = racing("random:8")
    deepest_m = []
    for mpc in (MpcSettings(caution=0.0), MpcSettings()):
        controller = compiled_controller(
            race.artefact, race.car, race.track, race.line, race.weights, mpc
        )
        loop = ClosedLoop(
            race.car, race.track, race.line, controller, slippery(race), sensors=sensors
        )
        driven = loop.drive(3)
        deepest_m.append(float(driven.off_track_m.max()))
    assert deepest_m[0] > 0.02
    assert deepest_m[1] < 1e-3
    assert len(driven.laps_s) == 3
    assert driven.laps_s[2] < 6.0


def test_estimates_that_the_mismatch_corrects_need_no_preparation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """To the bit: a step that was not prepared in time is no other."""
    race, prepare = racing(), Driver.prepare
    driven = []
    for made in (prepare, lambda *_: None):
        monkeypatch.setattr(Driver, "prepare", made)
        loop = ClosedLoop(
            race.car, race.track, race.line, race.controller(), slippery(race), sensors=mocap(ROUGH)
        )
        driven.append(loop.drive(1, 4.0).x)
    assert len(driven[0]) == 201
    assert driven[0].tobytes() == driven[1].tobytes()


@pytest.mark.check
def test_a_car_that_is_not_its_file_drives_as_one_that_is_known() -> None:
    """Longer, heavier and weaker by a tenth each: laps against those by its own equations."""
    race = racing("harbour")
    car, motor = race.car, race.car.drive
    assert isinstance(motor, DcMotor)
    other = car.model_copy(
        update={
            "lf_m": 1.1 * car.lf_m, "lr_m": 1.1 * car.lr_m, "mass_kg": 1.1 * car.mass_kg,
            "drive": motor.model_copy(update={"cm1": 0.9 * motor.cm1}),
        }
    )  # fmt: skip
    with stages_on(Console(quiet=True)) as stages:
        known = prepare(PreparationSettings(car=other), ("harbour",), stages, ("dynamic",))
    laps_s = []
    for controller in (
        compiled_controller(known.artefacts[0], other, race.track, race.line),
        race.controller(),
        compiled_controller(
            race.artefact, car, race.track, race.line, race.weights, MpcSettings(caution=0.0)
        ),
    ):
        driven = ClosedLoop(other, race.track, race.line, controller, built_in_car(other)).drive(2)
        assert driven.off_track_m.max() <= 0
        laps_s.append(driven.laps_s)
    first, flying = (ours / best for best, ours in zip(*laps_s[:2], strict=True))
    assert first < 1.01
    assert flying < 1.003
    assert laps_s[2][1] / laps_s[0][1] > 1.008, "that of the paper is slower"
