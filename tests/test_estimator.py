"""The state estimator in C against a textbook filter in NumPy, and on a learned car's own lap."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import block_diag

from bayesrace.arrays import Floats
from bayesrace.codegen.build import build
from bayesrace.codegen.settings import BuildSettings
from bayesrace.controller.estimator import Belief, Measurement
from bayesrace.controller.native_step import NativeStep
from bayesrace.errors import InputError
from bayesrace.gp.expression import mean_function
from bayesrace.gp.weights import Weights
from bayesrace.integrators import PREDICTION
from bayesrace.operation.closed_loop import ClosedLoop
from bayesrace.operation.settings import PreparationSettings
from bayesrace.operation.training_drives import drive_for_training
from bayesrace.raceline import compute_raceline
from bayesrace.sensors import Sensors, get_sensors
from bayesrace.tracks import load_track
from bayesrace.vehicles import Car, get_car
from bayesrace.vehicles.models import e_kinematic
from tests.conftest import SETTINGS, Make, smooth_drive
from tests.estimator import Estimator
from tests.instruments import FINE, ROUGH, mocap
from tests.racing import Racing, racing

TS = 0.02
POSE, GYRO, WHEEL, STEERING = range(4)
START = np.array([1, 1, 3, 0.5, 0.2, 1, 0.05, 0.1, 0.02])
DRIFT = np.array([0, 0, 0, 0.005, 0.005, 0.05, 0, 0, 0])
MODEL = np.zeros(3)
WALK = np.array([7, 7, 120])
"""Standard deviations of accelerations, which are estimated in place of the model ..."""
FADING_S = 0.2
"""... with this time constant."""
LAG_S, UNDERSTEER = 0.08, 0.008
"""Of the yaw rate behind the steering angle."""
WHEELBASE_M = get_car("orca").wheelbase_m
VARIANCE = np.array([4e-6, 9e-6, 4e-3])
NOISE = VARIANCE * (0.1, 0.4, 0.25)
NO_TERMS = np.zeros(10)
RESIDUAL = VARIANCE, NOISE, NO_TERMS
TERMS = np.r_[1, np.zeros(9)]
"""Of a mismatch that is the same everywhere."""
MISMATCH = np.array([1e-3, 3e-3, 0.05])
"""It is so large, ..."""
UNCERTAIN = MISMATCH / 3
"""... with these standard deviations."""
TURN, SHIFT = 0.05, 0.01
"""Offsets of yaw rate and steering angle as measured."""


def of_pose(time_s: float, x: Floats, mm: float = 0.5, degrees: float = 0.2) -> Measurement:
    deviation = (1e-3 * mm, 1e-3 * mm, np.deg2rad(degrees))
    return Measurement(time_s, POSE, (0, 1, 2), tuple(x[:3]), deviation)


def noisy(random: np.random.Generator, one: Measurement) -> Measurement:
    return one._replace(value=tuple(random.normal(one.value, one.deviation)))


@dataclass
class Textbook:
    """The same filter, dense and by inverses, with all events in order; it has no history."""

    step: NativeStep
    x: Floats
    p: Floats
    time_s: float
    acceleration: Floats
    mismatch: Floats
    uncertain: Floats
    """Standard deviations of the mismatch."""
    extra: Floats
    """How x errs with the mismatch (12, 3), which p does not know of."""
    squared: list[float] = field(default_factory=list)
    way: Floats = field(default_factory=lambda: np.zeros(7))
    """Since the beginning of the period, whose residual counts in all its parts."""

    @classmethod
    def begun(
        cls,
        step: NativeStep,
        first: Measurement,
        acceleration: Floats,
        mismatch: tuple[Floats, Floats],
    ) -> "Textbook":
        p = np.diag(np.r_[START, acceleration] ** 2)
        p[:3, :3] = np.diag(np.square(first.deviation))
        x = np.r_[first.value, np.zeros(9)]
        return cls(step, x, p, first.time_s, acceleration, *mismatch, np.zeros((12, 3)))

    def reach(self, time_s: float, u: Floats) -> None:
        if abs(np.remainder(self.time_s + TS / 2, TS) - TS / 2) < 1e-9:  # a period begins
            self.way = np.zeros(7)
        left = time_s - self.time_s
        while left > 1e-9:
            h = min(left, TS)
            n, x, left_of = len(self.x), self.x[:7].copy(), np.exp(-h / FADING_S)
            f, q = np.eye(n), np.zeros((n, n))
            lacking = self.acceleration**2 + 4 * (VARIANCE - 2 * NOISE) / TS**2
            q[range(12), range(12)] = np.r_[h * DRIFT**2, (1 - left_of**2) * lacking]
            if self.acceleration.any():
                go = partial(walked, u=u, h=h, speed=model_speed(self.step, x, u, h))
                added, f, self.x = np.zeros((7, 7)), derivatives(go, self.x), go(self.x)
            else:
                own = self.mismatch + np.array([0, 0, self.x[12:].sum()])
                beside = self.x[9:12] + own / TS
                after = self.step.propagate(x, u, h, 2 * NOISE, x - self.way, beside)
                self.x[:7], f[:7, :7], f[:7, 9:12], added = after
                f[:7, 12:] = after[2][:, 2:3] / TS
                self.x[9:12] *= left_of
                f[9:12] *= left_of
            self.way = self.way + self.x[:7] - x
            q[:7, :7] += added
            self.extra = f[:12, :12] @ self.extra
            if not self.acceleration.any():
                self.extra[:7] += after[2] / TS
            self.p = f @ self.p @ f.T + q
            left -= h
        self.time_s = time_s

    def take(self, m: Measurement) -> None:
        h = np.zeros((len(m.of), len(self.x)))
        h[range(len(m.of)), m.of] = 1
        h[:, 7] += h[:, 5]
        h[:, 8] += h[:, 6]
        new = np.asarray(m.value) - h @ self.x
        noise = np.diag(np.square(m.deviation))
        s = h @ self.p @ h.T + noise
        gain = self.p @ h.T @ np.linalg.inv(s)
        total = h[:, :12] @ self.all @ h[:, :12].T + noise
        self.squared.append(float(new @ np.linalg.solve(total, new)))
        self.x = self.x + gain @ new
        left = np.eye(len(self.x)) - gain @ h
        self.extra = left[:12, :12] @ self.extra
        self.p = left @ self.p @ left.T + gain @ noise @ gain.T

    @property
    def all(self) -> Floats:
        """The covariance with that of the mismatch."""
        return self.p[:12, :12] + self.extra @ np.diag(self.uncertain**2) @ self.extra.T


def model_speed(step: NativeStep, at: Floats, u: Floats, h: float) -> Callable[[Floats], Any]:
    """The model's speed after h, linearised in x (7,)."""
    ahead, slope, _, _ = step.propagate(at, u, h, VARIANCE)
    value, gradient = ahead[3], slope[3]
    return lambda x: value + gradient @ (x - at)


def walked(x: Floats, u: Floats, h: float, speed: Callable[[Floats], Any]) -> Floats:
    """x (12,) with accelerations that are held; velocities are linear in time, and the position is
    by Simpson's rule."""
    begin, settled = x[3:6], x[3] * x[6] / (WHEELBASE_M + UNDERSTEER * x[3] ** 2)
    yaw_rate = settled + (x[5] - settled) * np.exp(-h / LAG_S)
    end = np.r_[speed(x[:7]), x[4], yaw_rate] + h * x[9:]
    yaw = x[2] + h * np.array([0, (3 * begin[2] + end[2]) / 8, (begin[2] + end[2]) / 2])
    rates = [
        (np.cos(psi) * vx - np.sin(psi) * vy, np.sin(psi) * vx + np.cos(psi) * vy)
        for psi, (vx, vy, _) in zip(yaw, (begin, (begin + end) / 2, end), strict=True)
    ]
    position = x[:2] + h / 6 * (np.array([1, 4, 1]) @ rates)
    fading = np.exp(-h / FADING_S)
    after: Floats = np.r_[position, yaw[2], end, x[6] + h * u[1], x[7:9], x[9:] * fading]
    return after


def derivatives(f: Callable[[Floats], Floats], x: Floats) -> Floats:
    """By complex steps, exact to rounding."""
    return np.column_stack([f(x + 1e-30j * one).imag / 1e-30 for one in np.eye(len(x))])


@dataclass
class Drive:
    """States every millisecond, the input of each period, and measurements in it by instrument."""

    x: Floats
    u: Floats
    measured: list[list[Measurement]]


@pytest.fixture
def drive(car: Car, make: Make) -> Drive:
    """Pose at 50 Hz, gyro and wheel speed at 200 Hz, steering encoder at 30 Hz, all noisy; by the
    corrected model itself."""
    random, step = np.random.default_rng(3), make()
    _, u = smooth_drive(car, 60, 2)
    x, dense = np.array([0.3, -0.2, 3.0, 1.5, 0, 0, 0]), []
    for given in u:
        dense += [x, *(step.predict(x, given, 1e-3 * k) for k in range(1, 20))]
        x = step.predict(x, given, TS)
    states = np.array([*dense, x])
    measured: list[list[Measurement]] = [[] for _ in range(len(u))]
    for k in range(1, len(states)):
        time_s, true, period = 1e-3 * k, states[k], (k - 1) // 20
        found = []
        if k % 20 == 7:
            found.append(of_pose(time_s, true))
        if k % 5 == 0:
            found.append(Measurement(time_s, GYRO, (5,), (true[5] + TURN,), (0.02,)))
            found.append(Measurement(time_s, WHEEL, (3,), (true[3],), (0.01 * max(true[3], 0.1),)))
        if k % 33 == 0:
            found.append(Measurement(time_s, STEERING, (6,), (true[6] + SHIFT,), (0.002,)))
        measured[period] += [noisy(random, one) for one in found]
    return Drive(states, u, measured)


def estimated(
    estimator: Estimator,
    drive: Drive,
    late: int = 0,
    poses_first: bool = False,
    terms: Floats = NO_TERMS,
) -> Belief:
    """Poses but the first come so many periods late, with what the others measure then."""
    for k, u in enumerate(drive.u):
        here = [one for one in drive.measured[k] if one.instrument != POSE]
        then = drive.measured[max(k - late, 0)] if k in (0, *range(late + 1, len(drive.u))) else []
        poses = [one for one in then if one.instrument == POSE]
        measured = poses + here if poses_first else here + poses
        estimator.advance(TS * (k + 1), u, (VARIANCE, NOISE, terms), measured)
    return estimator.read()


def textbook(
    step: NativeStep,
    drive: Drive,
    late: int = 0,
    acceleration: Floats = MODEL,
    mismatch: tuple[Floats, Floats] = (np.zeros(3), np.zeros(3)),
    joint: tuple[float, float] | None = None,
) -> Textbook:
    """What has been measured by the end of the drive. ``joint``: mean and standard deviation
    of what the yaw rate's residual errs by, which is a state, too."""
    last = len(drive.u) - late
    events = [
        (one.time_s, k, one)
        for k, period in enumerate(drive.measured)
        for one in sorted(period, key=lambda one: one.instrument == POSE)
        if k < last or one.instrument != POSE
    ]
    events.sort(key=lambda event: event[0])
    first = next(one for _, _, one in events if one.instrument == POSE)
    made = Textbook.begun(step, first, acceleration, mismatch)
    if joint:
        made.x, made.p = np.r_[made.x, joint[0]], block_diag(made.p, joint[1] ** 2)
    for time_s, k, one in events:
        if time_s <= first.time_s:
            continue
        for period in range(int(made.time_s / TS + 1e-6), k):
            made.reach(TS * (period + 1), drive.u[period])
        made.reach(time_s, drive.u[k])
        made.take(one)
    made.reach(TS * len(drive.u), drive.u[-1])
    return made


def settings(**changed: Any) -> dict[str, Any]:
    walk = {"acceleration": MODEL, "acceleration_s": FADING_S}
    walk |= {"yaw_lag_s": LAG_S, "understeer": UNDERSTEER}
    values = {"start": START, "drift": DRIFT, "gate": 0.0} | walk | changed
    return {name: np.asarray(one).tolist() for name, one in values.items()}


def estimator(step: NativeStep, gate: float = 0.0, acceleration: Floats = MODEL) -> Estimator:
    return Estimator(step, settings(gate=gate, acceleration=acceleration))


def test_the_transition_is_the_prediction_with_its_derivatives(
    make: Make, car: Car, weights: Weights
) -> None:
    step, e = make(), PREDICTION.corrected(e_kinematic(car))
    mu = mean_function(weights)
    states, inputs = smooth_drive(car, 40, 5)
    for x, u in zip(states[::6], inputs[::6], strict=True):
        if abs(x[6]) > car.delta_max_rad - 0.11:
            continue
        for duration_s in (0.003, TS):
            x_next, jacobian, by, covariance = step.propagate(x, u, duration_s, VARIANCE)
            assert np.array_equal(x_next, step.predict(x, u, duration_s))
            for i in range(7):
                h = 1e-6 * np.eye(7)[i]
                ahead, back = (step.predict(x + d, u, duration_s) for d in (h, -h))
                assert (ahead - back) / 2e-6 == pytest.approx(jacobian[:, i], abs=2e-6)
            for i, d in enumerate(1e-3 * np.eye(3)):
                ahead, back = (
                    step.propagate(x, u, duration_s, VARIANCE, disturbance=one)[0]
                    for one in (d, -d)
                )
                assert (ahead - back) / 2e-3 == pytest.approx(by[:, i], abs=1e-8)
        mean = np.asarray(mu(np.r_[x[3:], u])).ravel()
        spread = np.column_stack(
            [(np.array(e(x, u, mean + d)) - np.array(e(x, u, mean - d))).ravel() / 2
             for d in np.diag(np.sqrt(VARIANCE))]
        )  # fmt: skip
        assert spread @ spread.T == pytest.approx(covariance, rel=1e-3, abs=1e-12)


@pytest.mark.parametrize("acceleration", [MODEL, WALK], ids=["model", "walk"])
@pytest.mark.parametrize(("late", "poses_first"), [(0, False), (2, False), (2, True), (6, True)])
def test_it_is_the_textbook_filter_with_all_in_order(
    make: Make, drive: Drive, late: int, poses_first: bool, acceleration: Floats
) -> None:
    """Asynchronous instruments, offsets, and measurements that come late: as late as 64 events
    reach back, when what comes with them makes these the oldest. With the model, which errs by a
    mismatch that is known to some deviations, and without."""
    step = make()
    made = estimator(step, acceleration=acceleration)
    known = not acceleration.any()
    mismatch = (MISMATCH, UNCERTAIN) if known else (np.zeros(3), np.zeros(3))
    if known:
        made.correct(np.outer(MISMATCH, TERMS), np.array([v**2 * np.eye(10) for v in UNCERTAIN]))
    expected = textbook(step, drive, late, acceleration, mismatch)
    found = estimated(made, drive, late, poses_first, TERMS if known else NO_TERMS)
    assert made.instrument(POSE).lost == 0
    assert found.time_s == pytest.approx(TS * len(drive.u))
    assert found.x == pytest.approx(expected.x[:9], rel=1e-9, abs=1e-11)
    p = expected.all[:9, :9]
    scale = np.sqrt(np.outer(np.diag(p), np.diag(p)))
    assert np.abs((found.covariance - p) / scale).max() < 1e-8
    if known:
        assert np.abs((expected.p[:9, :9] - p) / scale).max() > 0.01
    if not late:
        squared = sum(made.instrument(number).squared for number in range(4))
        assert squared == pytest.approx(sum(expected.squared), rel=1e-8)


def test_a_mismatch_is_what_a_filter_of_state_and_mismatch_finds(make: Make, drive: Drive) -> None:
    """Whose states are those of both. It is learned from what is new in each measurement, and what
    was estimated before moves with it. To first order: the model is not linear."""
    step, wrong, deviation = make(), 0.1, 0.3
    made = estimator(step)
    made.correct(np.outer([0, 0, wrong], TERMS))
    information = error = 0.0
    for k, u in enumerate(drive.u):
        made.advance(TS * (k + 1), u, (VARIANCE, NOISE, TERMS), drive.measured[k])
        known, projection, squares, values = made.shown()
        information += known[2, 0, 0]
        error += projection[2, 0]
        assert known[2] == pytest.approx(known[2, 0, 0] * np.outer(TERMS, TERMS))
        assert k == 0 or values == sum(len(one.of) for one in drive.measured[k])
        assert (squares > 0).all()
    before = made.read()
    posterior = 1 / (information + deviation**-2)
    weight, covariance = np.zeros((3, 10)), np.array([1e-12 * np.eye(10)] * 3)
    weight[2, 0] = posterior * (error + wrong / deviation**2)
    covariance[2, 0, 0] = posterior
    made.correct(weight, covariance)
    found, joint = made.read(), textbook(step, drive, joint=(wrong, deviation))
    assert posterior < deviation**2 / 10
    assert weight[2, 0] == pytest.approx(joint.x[12], abs=0.03 * np.sqrt(posterior))
    assert posterior == pytest.approx(joint.p[12, 12], rel=0.06)
    moved = joint.x[:9] - before.x
    assert np.abs(found.x - joint.x[:9]).max() < 0.05 * np.abs(moved).max()


EVENTS = 64
"""BR_EVENTS in controller/native/bayesrace_estimator.h."""


def test_what_has_no_place_in_a_full_history_is_lost_and_changes_nothing(
    make: Make, drive: Drive
) -> None:
    """What is measured between the oldest event, which makes room, and the next one."""
    step = make()
    without, made = estimator(step), estimator(step)
    expected = estimated(without, drive)
    kept, lost = list[float](), 0
    for k, u in enumerate(drive.u):
        kept = sorted([*kept, TS * (k + 1)])[-EVENTS:]
        period = drive.measured[k]
        if len(kept) == EVENTS and kept[1] - kept[0] > 1e-6:
            wrong = Measurement(float(np.mean(kept[:2])), WHEEL, (3,), (9.0,), (0.01,))
            period = [wrong, *period]
            lost += 1
        made.advance(TS * (k + 1), u, RESIDUAL, period)
        kept = sorted([*kept, *(one.time_s for one in drive.measured[k])])[-EVENTS:]
    assert lost > 20
    assert made.instrument(WHEEL).lost == without.instrument(WHEEL).lost + lost
    assert made.read().x == pytest.approx(expected.x, abs=1e-12)


def test_it_finds_the_offsets_of_gyro_and_steering(make: Make, drive: Drive) -> None:
    found, error = estimated(estimator(make(), gate=1.0), drive), np.sqrt
    deviation = error(np.diag(found.covariance))
    assert abs(found.x[7] - TURN) < 3 * deviation[7] < 0.05
    assert abs(found.x[8] - SHIFT) < 3 * deviation[8] < 0.02
    off = np.abs(found.x[:7] - drive.x[-1])
    off[2] = abs(np.remainder(off[2] + np.pi, 2 * np.pi) - np.pi)
    assert (off < 4 * deviation[:7]).all()


def test_what_cannot_be_is_refused_and_counted(make: Make, drive: Drive) -> None:
    step = make()
    expected = estimated(estimator(step, gate=1.0), drive)
    made, jump = estimator(step, gate=1.0), np.array([1.0, 0, np.pi])
    for k, u in enumerate(drive.u):
        bad = []
        if k % 10 == 5:
            pose = of_pose(TS * (k + 1), drive.x[20 * (k + 1), :3] + jump)
            bad = [
                pose,
                pose._replace(time_s=TS * (k + 1) + 0.1),
                pose._replace(time_s=-1.0),
                pose._replace(value=(np.nan, 0.0, 0.0)),
                pose._replace(of=(1, 1, 2)),
            ]
        made.advance(TS * (k + 1), u, RESIDUAL, [*drive.measured[k], *bad])
    assert made.read().x == pytest.approx(expected.x[:9], abs=1e-9)
    counts = made.instrument(POSE)
    assert (counts.used, counts.refused, counts.lost) == (59, 8, 24)  # it moves: two more
    assert counts.refused_in_row == 0


def test_it_begins_with_a_pose_from_standstill_and_not_before(
    kinematic_artefact: Path, car: Car
) -> None:
    made, x = estimator(NativeStep(kinematic_artefact, car, SETTINGS)), np.array([0.5, 0.2, 1.0])
    gyro = Measurement(TS, GYRO, (5,), (0.0,), (0.02,))
    assert not made.advance(TS, np.zeros(2), RESIDUAL, [gyro])
    with pytest.raises(InputError, match="estimator"):
        made.read()
    for k in range(1, 100):
        assert made.advance(TS * (k + 1), np.zeros(2), RESIDUAL, [of_pose(TS * (k + 1), x)])
    found = made.read()
    assert found.x[:3] == pytest.approx(x, abs=1e-4)
    assert np.abs(found.x[3:6]).max() < 0.02
    with pytest.raises(InputError, match="time"):
        made.advance(0.5, np.zeros(2), RESIDUAL, [])


def test_steering_stays_what_it_was_where_it_begins_anew_without_the_model(
    kinematic_artefact: Path, car: Car
) -> None:
    """Little says where the wheels are; the first of two poses is an outlier."""
    step = NativeStep(kinematic_artefact, car, SETTINGS)
    made, u = estimator(step, gate=1.0, acceleration=WALK), np.array([0.0, 1.0])
    for k in range(1, 8):
        pose = (2.0 * TS * k, 0.0, 0.0) if k != 2 else (0.5, 0.3, 0.4)
        made.advance(TS * k, u, RESIDUAL, [of_pose(TS * k, np.array(pose))])
    found, turned = made.read(), 6 * TS
    assert found.x[3] == pytest.approx(2.0, abs=0.3)  # it has begun anew, and moves
    assert found.x[6] == pytest.approx(turned, abs=0.02)
    assert 0.9 * START[6] ** 2 < found.covariance[6, 6] < 1.01 * START[6] ** 2


@pytest.mark.parametrize(
    "changes",
    [
        {"gate": -1.0},
        {"start": -START},
        {"drift": DRIFT * np.nan},
        {"acceleration": -WALK},
        {"acceleration_s": 0.0},
        {"acceleration": WALK, "yaw_lag_s": 0.0},
    ],
)
def test_unusable_settings_are_refused(make: Make, changes: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="estimator's settings"):
        Estimator(make(), settings(**changes))


def errors(
    race: Racing, seed: int, every: int, late: int, noise: tuple[float, float]
) -> tuple[Floats, Floats, Sequence[float]]:
    """Of a lap of the true car, by a learned model: errors (n, 6), NEES (n,), NIS sums."""
    step, random = race.controller().native, np.random.default_rng(seed)
    made = Estimator(step, race.car.tuning.estimation(nominal=False))
    x, u = race.driven.x, race.driven.u
    off: list[Floats] = []
    nees: list[float] = []
    for k in range(1, len(x)):
        measured = []
        if (then := k - late) >= 1 and then % every == 0:
            measured = [noisy(random, of_pose(TS * then, x[then], *noise))]
        known = np.r_[made.read().x[:7] if off else x[k - 1], u[k - 1]]
        if not made.advance(TS * k, u[k - 1], (*step.variance(known), NO_TERMS), measured):
            continue
        found = made.read()
        error = found.x[:6] - x[k, :6]
        error[2] = np.remainder(error[2] + np.pi, 2 * np.pi) - np.pi
        off.append(error)
        nees.append(float(error @ np.linalg.solve(found.covariance[:6, :6], error)))
    counts = made.instrument(POSE)
    assert counts.refused <= 0.01 * counts.used
    return np.array(off), np.array(nees), (counts.squared, counts.expected)


@pytest.mark.parametrize(
    ("every", "late", "noise"),
    [(1, 1, (0.5, 0.2)), (1, 1, (1.0, 0.5)), (2, 2, (0.5, 0.2)), (2, 1, (1.0, 0.5))],
)
def test_its_covariance_is_that_of_its_errors_on_a_learned_car(
    every: int, late: int, noise: tuple[float, float]
) -> None:
    """Normalised errors and innovations squared, over three seeds (Bar-Shalom et al., 5.4.2)."""
    race = racing()
    found = [errors(race, seed, every, late, noise) for seed in range(3)]
    nees = np.mean([one[1][50:].mean() for one in found]) / 6
    squared, expected = np.sum([one[2] for one in found], axis=0)
    rmse = np.sqrt(np.mean([(one[0][50:, 3:] ** 2).mean(axis=0) for one in found], axis=0))
    assert 0.5 < nees < 1.3  # its walk is for instruments that report within a period
    assert 0.8 < squared / expected < 1.2
    assert (rmse < (0.004, 0.007, 0.06)).all()


@pytest.mark.parametrize(
    "sensors",
    [mocap(FINE), mocap(ROUGH), get_sensors("odometry")],
    ids=["0.5 mm", "1 mm", "odometry"],
)
def test_a_car_that_instruments_measure_laps_as_if_its_state_were_known(sensors: Sensors) -> None:
    """Readings between states, by weights learned from true ones: the first lap loses the wait for
    the first pose, the flying one 0.15 % at most."""
    race = racing()
    controller = race.controller()
    driven = ClosedLoop(
        race.car, race.track, race.line, controller, seed=1, sensors=sensors
    ).drive()
    assert (driven.off_track_m <= 0).all()
    assert driven.laps_s[0] == pytest.approx(race.driven.laps_s[0] + 2 * TS, abs=0.04)
    assert driven.laps_s[1] == pytest.approx(race.driven.laps_s[1], rel=1.5e-3)


@pytest.mark.parametrize("name", ["orca", "f1tenth"])
@pytest.mark.parametrize("noise", [FINE, ROUGH])
def test_a_training_drive_by_motion_capture_stays_on_its_track(
    name: str, noise: tuple[float, float], tmp_path: Path
) -> None:
    """Its estimates are those of the model without weights."""
    car, sensors = get_car(name), mocap(noise)
    track = load_track(car.train_track, car.width_m)
    line = compute_raceline(track, car)
    settings = PreparationSettings(car=car, sensors=sensors)
    artefact, _ = build(BuildSettings(car=car))
    *_, driven = drive_for_training(settings, track, line, car, artefact, tmp_path / "drive.mcap")
    assert track.project_path(driven.x[:, :2]).off_track_m.max() < 0
    assert driven.x[:, 3].mean() > 1.5
    assert np.mean(driven.levels == 0) > 0.9
