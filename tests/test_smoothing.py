"""Smoothed states against dense conditioning, their covariance against their errors, and laps of
what is learned from them."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs

from bayesrace.arrays import Floats
from bayesrace.columns import columns_of
from bayesrace.controller.assembly import compiled_controller
from bayesrace.controller.native_step import NativeStep
from bayesrace.controller.process_settings import ControllerSettings
from bayesrace.errors import InputError
from bayesrace.gp.weights import Weights
from bayesrace.integrators import PREDICTION
from bayesrace.learning import smoothing
from bayesrace.learning.dataset import Dataset, concatenate
from bayesrace.learning.drives import Drive, Event, Measured
from bayesrace.learning.gaussian_process import PairDistances, likelihood
from bayesrace.learning.kalman import Smoothed, backward, forward
from bayesrace.learning.settings import TrainingSettings
from bayesrace.learning.smoothing import smooth
from bayesrace.learning.sources import (
    CYCLES,
    STATES,
    dataset_from_columns,
    dataset_from_npz,
    write_npz,
)
from bayesrace.learning.training import fit
from bayesrace.learning.validation import predictive_sigma
from bayesrace.messages import Reading, State, Telemetry
from bayesrace.operation.closed_loop import ClosedLoop
from bayesrace.vehicles import Car
from bayesrace.vehicles.models import dynamic
from tests.conftest import Make, smooth_drive
from tests.driven import CAR, QUICK, STEP_S, drive, logged, telemetry
from tests.racing import Racing, prepared, racing

POSE = (0.0005, 0.0005, np.deg2rad(0.2))
NAMES = ("x", "y", "psi", "vx", "vy", "omega", "delta")


def read(
    random: np.random.Generator, time_s: float, names: Sequence[str], x: Floats, by: Sequence[float]
) -> Reading:
    """With normal errors of these deviations."""
    true = [x[NAMES.index(name)] for name in names]
    values = zip(map(float, random.normal(true, by)), map(float, by), strict=True)
    return Reading(
        instrument="+".join(names), time_s=time_s, values=dict(zip(names, values, strict=True))
    )


def poses(random: np.random.Generator, x: Floats, by: Sequence[float] = POSE) -> list[Reading]:
    """At each state, as :func:`pose`."""
    found = (pose(random, k, one, by) for k, one in enumerate(x))
    return [one for one in found if one is not None]


def pose(random: np.random.Generator, k: int, x: Floats, by: Sequence[float]) -> Reading | None:
    """At the k-th state; None in gaps of 100 ms every 2 s. After the first ones, of a hundred one
    is nowhere near."""
    if (STEP_S * k + 1) % 2 <= 0.1:
        return None
    off = np.r_[random.normal(0, 0.3, 3) * (random.random() < 0.01) * (k > 4), np.zeros(4)]
    return read(random, STEP_S * k, NAMES[:3], x + off, by)


def of(x: Floats, u: Floats, readings: Sequence[Reading]) -> Drive:
    time_s: Floats = STEP_S * np.arange(len(x), dtype=np.float64)
    return Drive(time_s, np.vstack((np.zeros(2), u[: len(x) - 1])), tuple(readings))


def dense(
    step: NativeStep, weights: Weights, car: Car, one: Drive, found: Smoothed
) -> tuple[Floats, Floats]:
    """Means (e, 9) and covariance (9 e, 9 e) at all events, of all readings at once: the joint
    Gaussian of the chain that the C code linearises, conditioned by its textbook formula."""
    events, path = one.events, found.path
    tuning = car.tuning
    begin, drift = (tuning.estimation(nominal=False)[name] for name in ("start", "drift"))
    p = np.diag(np.square(begin))
    p[3:6] *= 100
    p[:3, :3], p[6, 6], p[8, 8] = np.diag(np.square(POSE)), 0, 0
    first = events[0].measured
    assert first is not None
    mean = [np.r_[first.value, path[0, 3:6], first.time_s * one.u[1, 1], 0, 0]]
    blocks, rows, new, noise = {(0, 0): p}, list[Floats](), list[float](), list[float]()
    for i, event in enumerate(events[1:], start=1):
        f, q, h = np.eye(9), np.zeros((9, 9)), event.duration_s
        x = mean[-1]
        if i == 1 or events[i - 1].period >= 0:
            start = path[i - 1, :7]
        if h > 0:
            before = path[i - 1, :7]
            variance = predictive_sigma(weights, np.r_[start[3:], event.u][None])[0] ** 2
            ahead, f[:7, :7], _, q[:7, :7] = step.propagate(before, event.u, h, variance, start)
            q += np.diag(np.square(drift)) * h
            x = np.r_[ahead, path[i - 1, 7:]] + f @ (mean[-1] - path[i - 1])
        mean.append(x)
        for j in range(i):
            blocks[i, j] = f @ (blocks[i - 1, j] if (i - 1, j) in blocks else blocks[j, i - 1].T)
        blocks[i, i] = f @ blocks[i - 1, i - 1] @ f.T + q
        if event.measured is not None:
            for state, value, var in zip(*event.measured[1:4], strict=True):
                row = np.zeros((len(events), 9))
                row[i, state] = 1
                row[i, 7] = state == 5
                error = value - row[i] @ x
                new.append(np.remainder(error + np.pi, 2 * np.pi) - np.pi if state == 2 else error)
                rows.append(row.ravel())
                noise.append(var)
    n = len(events)
    prior = np.block([[blocks[max(i, j), min(i, j)] if i >= j else blocks[j, i].T
                       for j in range(n)] for i in range(n)])  # fmt: skip
    seen = np.array(rows)
    gain = np.linalg.solve(seen @ prior @ seen.T + np.diag(noise), seen @ prior).T
    posterior = np.concatenate(mean) + gain @ np.array(new)
    return posterior.reshape(n, 9), prior - gain @ seen @ prior


def test_it_is_what_all_readings_at_once_say(
    make: Make, car: Car, weights: Weights, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Poses between the ends of periods and a gyro with an offset, reported in any order."""
    monkeypatch.setattr(smoothing, "_LINEARISED", 5)
    random, step = np.random.default_rng(2), make()
    _, u = smooth_drive(car, 14, 2)
    x = [np.array([0.3, -0.2, 3.0, 1.5, 0, 0, 0])]
    readings = []
    for k, given in enumerate(u):
        part, end = (step.predict(x[-1], given, h) for h in (0.007, STEP_S))
        readings.append(read(random, STEP_S * k + 0.007, NAMES[:3], part, POSE))
        gyro = end + 0.05 * np.eye(7)[5]
        readings.append(read(random, STEP_S * (k + 1), ("omega",), gyro, (0.02,)))
        x.append(end)
    one = of(np.array(x), u, readings)
    shuffled = replace(one, readings=tuple(readings[i] for i in random.permutation(len(readings))))
    found = smooth(shuffled, car, PREDICTION, weights)
    assert found is not None
    mean, covariance = dense(step, weights, car, one, found)
    ends = [i for i, event in enumerate(one.events) if event.period >= 0]
    blocks = covariance.reshape(len(mean), 9, len(mean), 9)
    scale = np.sqrt(np.abs(np.array([np.diag(blocks[i, :, i]) for i in ends]))) + 1e-9
    assert np.abs((found.x - mean[ends]) / scale).max() < 1e-3
    for k, i in enumerate(ends):
        unit = np.outer(scale[k], scale[k])
        assert np.abs((found.covariance[k] - blocks[i, :, i]) / unit).max() < 1e-3
        if k:
            unit = np.outer(scale[k], scale[k - 1])
            assert np.abs((found.cross[k - 1] - blocks[i, :, ends[k - 1]]) / unit).max() < 1e-3


def test_covariances_stay_symmetric_where_the_model_is_unstable() -> None:
    """Rounding would grow with the model, and be taken for a covariance."""
    m, count = 9, 1500
    f = np.eye(m)
    f[0, 3] = f[1, 4] = f[2, 5] = 0.01
    f[4, 4], f[4, 5] = 1.036, 0.1
    random = np.random.default_rng(1)
    pose = partial(Measured, states=(0, 1, 2), variance=np.full(3, 1e-6), instrument="camera")
    events = [
        Event(0.01, k, np.zeros(2), pose(time_s=0.01 * k, value=random.normal(0, 1e-3, 3)))
        for k in range(count)
    ]

    def go(_: int, x: Floats) -> tuple[Floats, Floats, Floats]:
        return x @ f.T, f, 1e-6 * np.eye(m)

    found = forward(events, np.zeros((1, m)), np.eye(m)[None], go, gate=0)
    p = found.p[-1, 0]
    scale = np.sqrt(np.diag(p))
    assert np.abs((p - p.T) / np.outer(scale, scale)).max() < 1e-12
    assert np.isfinite(backward(events, found).x).all()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("times", [1e4, 1e25])
def test_nothing_is_made_of_a_drive_that_the_model_cannot_follow(
    make: Make, car: Car, weights: Weights, times: float
) -> None:
    """It runs away, to where no car can be, or beyond all numbers."""
    random, step = np.random.default_rng(2), make()
    _, u = smooth_drive(car, 40, 2)
    x = [np.array([0.3, -0.2, 3.0, 1.5, 0, 0, 0])]
    for given in u:
        x.append(step.predict(x[-1], given, STEP_S))
    readings = poses(random, np.array(x))
    vx, vy, omega = weights.outputs
    wild = replace(weights, outputs=(vx, vy, replace(omega, y_scale=times * omega.y_scale)))
    assert smooth(of(np.array(x), u, readings), car, PREDICTION, weights) is not None
    assert smooth(of(np.array(x), u, readings), car, PREDICTION, wild) is None


def test_what_one_instrument_reads_does_not_keep_another_from_being_heard(
    car: Car,
) -> None:
    """The pose jumps for good while a gyro, whose readings pass, reads between the poses."""
    random, readings = np.random.default_rng(1), []
    x = np.zeros((100, 7))
    x[:, 3], x[:, 0] = 1, STEP_S * np.arange(100)
    x[50:, 1] += 0.5
    for k, one in enumerate(x):
        readings.append(read(random, STEP_S * k, NAMES[:3], one, POSE))
        readings.append(read(random, STEP_S * k + 0.01, ("omega",), one, (0.02,)))
    found = smooth(of(x, np.zeros((99, 2)), readings), car, PREDICTION, None)
    assert found is not None
    assert np.abs(found.x[-1, 1] - 0.5) < 0.01


def test_what_it_refuses_is_what_is_wrong() -> None:
    """Of a learned car's laps at the limit, over three seeds."""
    race = racing()
    x, inputs = race.driven.x, np.array([one.u_applied for one in race.driven.states[1:]])
    for seed in range(3):
        drive = of(x, inputs, poses(np.random.default_rng(seed), x))
        found = smooth(drive, race.car, PREDICTION, None)
        assert found is not None
        for event, refused in zip(drive.events, found.refused, strict=True):
            if (one := event.measured) is not None:
                apart = np.abs(one.value[:2] - x[round(one.time_s / STEP_S), :2])
                assert refused == (apart.max() > 0.01)


@pytest.mark.parametrize("by", [POSE, (0.001, 0.001, np.deg2rad(0.5))])
def test_its_covariance_is_that_of_its_errors(by: tuple[float, ...]) -> None:
    """On a learned car's own lap, over three seeds; outliers and gaps included. The random walk is
    no model of the car: its errors may be smaller than it states."""
    race = racing()
    x = race.driven.x[:400]
    inputs = np.array([one.u_applied for one in race.driven.states[1:400]])
    nees: dict[str, list[float]] = {"walk": [], "weights": []}
    for seed in range(3):
        drive = of(x, inputs, poses(np.random.default_rng(seed), x, by))
        for name, weights in (("walk", None), ("weights", race.weights)):
            found = smooth(drive, race.car, PREDICTION, weights)
            assert found is not None
            drive = replace(drive, path=found.path, refused=found.refused)
            error = found.x[:, :6] - x[found.rows, :6]
            error[:, 2] = np.remainder(error[:, 2] + np.pi, 2 * np.pi) - np.pi
            solved = np.linalg.solve(found.covariance[:, :6, :6], error[..., None])[..., 0]
            nees[name].append((error * solved).sum(axis=1).mean() / 6)
    assert 0.7 < np.mean(nees["weights"]) < 1.35
    assert 0.3 < np.mean(nees["walk"]) < 1.3


def test_known_noise_of_samples_is_in_likelihood_and_gradient() -> None:
    random = np.random.default_rng(4)
    z, y, known = random.normal(size=(30, 6)), random.normal(size=30), random.uniform(0, 2, 30)
    pairs, theta = PairDistances(z), np.log([2.0, *[1.5] * 6, 0.1])
    value, gradient = likelihood("rbf", pairs, y, theta, known)
    k = 2 * np.exp(-((z[:, None] - z) ** 2).sum(axis=2) / 2 / 1.5**2) + np.diag(0.1 + known)
    expected = -0.5 * (y @ np.linalg.solve(k, y) + np.linalg.slogdet(k)[1])
    assert value == pytest.approx(expected - 15 * np.log(2 * np.pi))
    for i, d in enumerate(1e-6 * np.eye(8)):
        ahead, back = (likelihood("rbf", pairs, y, theta + s * d, known)[0] for s in (1, -1))
        assert gradient[i] == pytest.approx((ahead - back) / 2e-6, abs=1e-5)


def seen(data: Dataset, seed: int, by: Sequence[float] = POSE) -> list[State]:
    """The states of a drive as motion capture shows them, a period late."""
    random, states = np.random.default_rng(seed), logged(data, 0)
    blind = [blinded(states[0], None)]
    for k, one in enumerate(states[1:]):
        blind.append(blinded(one, pose(random, k, np.array(states[k].x), by)))
    return blind


def blinded(state: State, read: Reading | None) -> State:
    return structs.replace(
        state, x=(0.0,) * 7, estimated=True, readings=() if read is None else (read,)
    )


class Blind(ClosedLoop):
    """A race whose controller and learning see late poses alone."""

    def __init__(self, race: Racing, weights: Weights, seed: int) -> None:
        controller = compiled_controller(race.artefact, race.car, race.track, race.line, weights)
        settings = ControllerSettings(car=race.car)
        super().__init__(race.car, race.track, race.line, controller, settings=settings)
        self._random, driver = np.random.default_rng(seed), self._cycle.driver
        self._observe = driver.observe
        driver.observe = self._see  # type: ignore[method-assign]

    def _see(self, state: State) -> bool:
        k = len(self._true_x) - 2
        late = pose(self._random, k, np.array(self._true_x[k]), POSE) if k >= 0 else None
        self._states[-1] = blinded(state, late)
        return self._observe(self._states[-1])


def samples_of(states: Sequence[State], cycles: Sequence[Telemetry] = ()) -> Dataset:
    columns = columns_of(State, states, STATES), columns_of(Telemetry, cycles, CYCLES)
    return dataset_from_columns(*columns, CAR, STEP_S)


def test_estimated_states_of_a_log_are_smoothed_and_their_noise_is_learned_with(
    tmp_path: Path,
) -> None:
    """A lost state ends a drive and begins another, whose steering angle the controller's first
    estimate in it says."""
    data = drive(dynamic(CAR), 240, seed=3)
    states = seen(data, 1)
    lost = [*states[:150], *states[151:]]
    assert samples_of(lost).dropped["no steering angle is known"] == 90
    estimate, deviation = (*data.x[160], 0.0, 0.0), (*[0.0] * 6, 0.004, 0.0, 0.0)
    cycle = structs.replace(telemetry(0, 160, 0), estimate=estimate, deviation=deviation)
    samples = samples_of(lost, [cycle])
    estimates = samples.estimates
    assert estimates is not None
    assert len(samples) > 200
    assert samples.dropped["gap"] == 1
    rows = np.array([0, 151])[estimates.origin[:, 0]] + estimates.origin[:, 1]
    assert np.abs(samples.x[:, 6] - data.x[rows, 6]).max() < 1e-9
    assert samples.deviation[:, 3] == pytest.approx(np.where(rows < 150, 0, 0.004))
    off = np.abs(samples.x[:, 3:6] - data.x[rows, 3:6])
    assert (np.sqrt((off**2).mean(axis=0)) < (0.02, 0.02, 0.2)).all()
    assert (samples.deviation[:, :3] > 0).all()
    write_npz(tmp_path / "a.npz", samples)
    again = dataset_from_npz(tmp_path / "a.npz")
    assert again.digest() == samples.settled().digest() != samples.digest()
    assert again.digest() != replace(samples, estimates=None).digest()
    made = fit(concatenate([samples, drive(dynamic(CAR), 60, seed=5)]), PREDICTION, QUICK)
    assert (made.samples.deviation[:, :3] < np.r_[samples.deviation, np.ones((60, 4))][:, :3]).all()
    settled = made.samples.settled().estimates
    assert settled is not None
    assert not settled.drives


def test_a_long_drive_is_smoothed_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """The next one begins with the steering angle at which the one before has ended."""
    data = drive(dynamic(CAR), 240, seed=3)
    whole = samples_of(seen(data, 1))
    monkeypatch.setattr("bayesrace.learning.estimates._LONGEST", 100)
    samples = samples_of(seen(data, 1))
    estimates = samples.estimates
    assert estimates is not None
    assert len(estimates.drives) == 3
    assert len(whole) - 4 <= len(samples) <= len(whole)
    rows = np.array([0, 99, 198])[estimates.origin[:, 0]] + estimates.origin[:, 1]
    assert np.abs(samples.x[:, 6] - data.x[rows, 6]).max() < 1e-9
    again = fit(samples, PREDICTION, QUICK).samples  # smoothed by the corrected model
    for one in (samples, again):
        off = np.abs(one.x[:, 3:6] - data.x[rows, 3:6])
        assert (np.sqrt((off**2).mean(axis=0)) < (0.02, 0.02, 0.2)).all()


def test_a_drive_whose_position_was_not_read_says_so() -> None:
    states = [structs.replace(one, readings=()) for one in seen(drive(dynamic(CAR), 60, seed=3), 1)]
    with pytest.raises(InputError, match=r"no position was read: .*does motion capture"):
        samples_of(states)


@pytest.mark.check
@pytest.mark.parametrize("seed", range(3))
def test_a_car_that_is_only_seen_learns_to_lap_as_one_whose_state_is_known(seed: int) -> None:
    """From a drive at racing speed that motion capture has seen; the true states are used nowhere.
    The first lap with it, and the one after an update."""
    race, training = racing(), prepared().training
    assert training is not None
    best_s, learned = race.driven.laps_s[1], samples_of(seen(training.samples, seed))
    settings = TrainingSettings(capacity=400)
    weights = fit(learned, PREDICTION, settings).weights
    first = Blind(race, weights, 10 + seed).drive()
    updated = fit(concatenate([learned, first.samples()]), PREDICTION, settings, weights).weights
    second = Blind(race, updated, 20 + seed).drive()
    for driven, most in ((first, 1.01), (second, 1.003)):
        assert (driven.off_track_m <= 0).all()
        assert driven.laps_s[1] <= most * best_s
