"""The line's speeds as far as the weights know the car: controller/native/br_certainty.c."""

import functools
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from scipy.optimize import least_squares

from bayesrace.arrays import Floats
from bayesrace.controller.assembly import PathTable, compiled_controller, make_path_table
from bayesrace.controller.native_step import NativeStep
from bayesrace.controller.pure_pursuit import PurePursuitSettings
from bayesrace.controller.settings import MpcSettings
from bayesrace.gp.weights import pack_weights, read_weights
from bayesrace.operation.closed_loop import ClosedLoop
from bayesrace.operation.preparation import Prepared, prepare
from bayesrace.operation.settings import RaceSettings
from bayesrace.operation.terminal.terminal import stages_on
from bayesrace.tracks import Track, write_track
from tests.changed_cars import changed
from tests.conftest import CAUTIOUS
from tests.racing import racing
from tests.reference import reference_file

SPEED = 2  # column of the table


@functools.cache
def slowly_trained() -> tuple[Prepared, RaceSettings]:
    """A car that was driven at half of the line's speed in training."""
    settings = RaceSettings(
        track="harbour", pursuit=PurePursuitSettings(speed_scale=0.5), practice_laps=0
    )
    with stages_on(Console(quiet=True)) as stages:
        return prepare(settings, (settings.track,), stages), settings


@pytest.fixture
def table() -> PathTable:
    racer = racing()
    return make_path_table(racer.track, racer.line, racer.car.tuning.path.spacing_m)


@pytest.fixture
def unsure() -> NativeStep:
    files, settings = slowly_trained()
    on, weights = files.first, read_weights(files.weights)
    car, artefact = settings.car, files.artefacts[0]
    return compiled_controller(artefact, car, on.track, on.line, weights).native


def going_on(step: NativeStep, speed: float, gained: float, curvature: float) -> Floats:
    """State and input (9,) of a car that goes on as the line does, by SciPy."""
    car, period_s = racing().car, step.manifest.step_s
    bend = car.tuning.braking.understeer_s2pm * curvature * speed**2
    guess = np.array([0.0, np.arctan(car.wheelbase_m * curvature) + bend, 0.0])

    def state(free: Floats) -> Floats:
        return np.array([0, 0, 0, speed, free[0], speed * curvature, free[1], free[2], 0.0])

    def errors(free: Floats) -> Floats:
        v = state(free)
        ahead = step.evaluate(v, np.zeros(7))[0]
        change = ahead[3:6] - v[3:6] - period_s * gained * np.array([1.0, 0.0, curvature])
        return np.concatenate([change / [0.002, 0.002, 0.02], (free - guess) / [0.5, 0.2, 1.0]])

    most = np.array([speed, car.delta_max_rad, car.d_max])
    least = np.array([-speed, -car.delta_max_rad, car.d_min])
    begin = np.clip([-0.1 * curvature, *guess[1:]], least + 1e-6, most - 1e-6)
    return state(least_squares(errors, begin, bounds=(least, most), xtol=1e-10).x)


def off_line_m(step: NativeStep, v: Floats) -> float:
    """How far errors take the car before they are noticed."""
    variance, noise = step.variance(v)
    rates = np.sqrt(np.maximum(variance - noise, 0)) / step.manifest.step_s  # of vx, vy, omega
    time_s = racing().car.tuning.caution.notice_s
    sideways, turning = rates[1] * time_s**2 / 2, v[3] * rates[2] * time_s**3 / 6
    return CAUTIOUS.caution_sigmas * float(np.hypot(sideways, turning))


def bends(table: PathTable) -> Floats:
    """Curvatures at the table's rows (n,), by chords as long as the car's braking takes them."""
    rows = round(racing().car.tuning.braking.chord_m / 2 / table.spacing_m)
    xy = table.rows[:, :2]

    def heading(by: int) -> Floats:
        ahead = np.roll(xy, -by - rows, axis=0) - np.roll(xy, -by + rows, axis=0)
        return np.asarray(np.arctan2(ahead[:, 1], ahead[:, 0]))

    turned = np.remainder(heading(rows) - heading(-rows) + np.pi, 2 * np.pi) - np.pi
    return np.asarray(turned / (2 * rows * table.spacing_m))


def test_speeds_fall_to_where_errors_do_not_take_the_car_off_the_track(
    unsure: NativeStep, table: PathTable
) -> None:
    """By SciPy, at places of the line: what stays is known, what is the limit just so."""
    line, known = table.rows[:, SPEED], unsure.speeds()
    every = round(racing().car.wheelbase_m / table.spacing_m)
    share_of_room = racing().car.tuning.caution.share
    curvature, room = bends(table), share_of_room * (table.rows[:, 6] - table.rows[:, 5]) / 2
    ratios, kept = [], 0
    for row in range(0, len(line) - every, 8 * every):
        gained = (line[row + every] ** 2 - line[row] ** 2) / (2 * every * table.spacing_m)
        share = known[row] / line[row]
        v = going_on(unsure, known[row], gained * share**2, curvature[row])
        if abs(v[6]) > 0.99 * racing().car.delta_max_rad:
            continue  # a bend tighter than the car's: no state goes on so
        ratio = off_line_m(unsure, v) / room[row]
        assert ratio < 1.05
        ratios.append(ratio)
        kept += share == 1
    assert max(ratios) > 0.99, "a speed is as high as it may be"
    assert 0 < kept < len(ratios)


def test_the_car_can_drive_from_each_speed_to_the_next(
    unsure: NativeStep, table: PathTable
) -> None:
    """No faster than the line, and no harder on drive and brake than the line, or than the model is
    on a straight."""
    line, known = table.rows[:, SPEED], unsure.speeds()
    assert (known <= line).all()
    assert known.min() > 0
    assert (known < 0.9 * line).any()

    def rates(v: Floats) -> Floats:
        return np.asarray((np.roll(v, -1) ** 2 - v**2) / (2 * table.spacing_m))

    def straight(v: Floats, d: float) -> Floats:
        ahead = [
            unsure.predict(np.array([0, 0, 0, one, 0, 0, 0]), np.array([d, 0.0]), 0.02) for one in v
        ]
        return np.asarray((np.array(ahead)[:, 3] - v) / 0.02)

    car = racing().car
    drive, brake = straight(known, car.d_max), straight(np.roll(known, -1), car.d_min)
    assert (rates(known) <= np.maximum(rates(line), drive) + 1e-6).all()
    assert (rates(known) >= np.minimum(rates(line), brake) - 1e-6).all()


def test_what_is_known_or_not_asked_for_limits_nothing(
    unsure: NativeStep, table: PathTable
) -> None:
    """On a track that was learned for; without caution, without track, without weights."""
    racer, line = racing(), table.rows[:, SPEED]
    files, settings = slowly_trained()
    assert racer.controller().native.speeds().tobytes() == line.tobytes()
    assert racer.controller().native.unknown_s == 0
    limited = unsure.speeds()
    lost_s = table.spacing_m * np.sum(1 / limited - 1 / line)
    assert unsure.unknown_s == pytest.approx(lost_s)
    assert lost_s > 0.1
    for off in ({"caution": 0.0}, {"constraints": False}):
        unsure.set_parameters(racer.car, MpcSettings(**off))
        assert unsure.speeds().tobytes() == line.tobytes()
    unsure.set_parameters(racer.car, MpcSettings())
    assert unsure.speeds().tobytes() == limited.tobytes()
    unsure.load_weights(b"")
    assert unsure.speeds().tobytes() == line.tobytes()
    unsure.stage_weights(pack_weights(read_weights(files.weights)))
    unsure.set_path(table)
    unsure.adopt_weights()
    assert unsure.speeds().tobytes() == limited.tobytes(), "staged before the line was known"
    nominal = compiled_controller(files.artefacts[0], settings.car, racer.track, racer.line)
    nominal.native.set_weights(read_weights(files.weights))
    nominal.native.set_path(table)
    assert nominal.native.speeds().tobytes() == limited.tobytes(), "a line after its weights, too"


def test_speeds_come_and_go_with_the_weights_and_the_reference_does_not_leap(
    unsure: NativeStep, table: PathTable
) -> None:
    racer, line, limited = racing(), table.rows[:, SPEED], unsure.speeds()
    shares = {nearest(table, x): x for x in racer.moments(60)}
    row, x = min(shares.items(), key=lambda one: limited[one[0]] / line[one[0]])
    share = limited[row] / line[row]
    assert share < 0.9
    unsure.step(x, (0.5, 0.0))
    pace = unsure.info.pace
    assert pace <= share
    unsure.stage_weights(pack_weights(racer.weights))
    assert unsure.speeds().tobytes() == limited.tobytes(), "staged weights are not in use"
    unsure.adopt_weights("known")
    assert unsure.speeds().tobytes() == line.tobytes()
    unsure.step(x, (0.5, 0.0), elapsed_s=0.02)
    assert unsure.info.pace <= pace * (1 + 0.02 * racer.car.tuning.caution.faster_ps) + 1e-9
    unsure.revert_weights()
    assert unsure.speeds().tobytes() == limited.tobytes()


def nearest(table: PathTable, x: Floats) -> int:
    return int(np.argmin(np.sum((table.rows[:, :2] - x[:2]) ** 2, axis=1)))


def deepest_m(files: Prepared, settings: RaceSettings, caution: float) -> float:
    """How far off the track two laps by first weights get; negative on it."""
    on, weights = files.first, read_weights(files.weights)
    mpc, artefact = MpcSettings(caution=caution), files.artefacts[0]
    controller = compiled_controller(artefact, settings.car, on.track, on.line, weights, mpc)
    driven = ClosedLoop(settings.car, on.track, on.line, controller).drive(2)
    assert len(driven.laps_s) == 2
    assert not caution or driven.laps_s[1] < 1.15 * on.line.lap_time_s
    return float(driven.off_track_m.max())


def test_first_laps_faster_than_all_training_stay_on_the_track() -> None:
    assert deepest_m(*slowly_trained(), 0.0) > 0.05
    assert deepest_m(*slowly_trained(), 0.95) <= 0


def fast_race(folder: Path, practice_laps: int) -> tuple[Prepared, RaceSettings]:
    """Spielberg at 1:43, the other way round: its fast bends are in no training drive."""
    rows = np.loadtxt(reference_file("tracks/f1tenth_spielberg_centerline.csv"), delimiter=",")
    x, y, right, left = (10 / 43 * rows[::-1]).T
    track = Track.from_points("fast", np.column_stack([x, y]), left, right)
    write_track(folder / "fast.csv", track)
    settings = RaceSettings(
        track=str(folder / "fast.csv"), practice_laps=practice_laps, practice_until=1.0
    )
    with stages_on(Console(quiet=True)) as stages:
        return prepare(settings, (settings.track,), stages), settings


@pytest.mark.check
def test_a_faster_track_than_that_of_the_training_is_not_left(tmp_path: Path) -> None:
    assert deepest_m(*fast_race(tmp_path, 0), 0.95) <= 0


@pytest.mark.check
def test_a_changed_car_does_not_follow_its_model_into_a_slide(tmp_path: Path) -> None:
    """Where nothing is known the corrected model lets sliding tyres pull the car, and plans for a
    car that has to be slower than its brakes allow slide: each of these cars has left this track.
    """
    files, settings = fast_race(tmp_path, 3)
    on, weights, laps_s = files.first, read_weights(files.weights), {}
    for how in ("as in the file", "trim 1 degree", "motor + 10 %", "mass + 20 %", "grip 0.9"):
        controller = compiled_controller(
            files.artefacts[0], settings.car, on.track, on.line, weights
        )
        car = changed(settings.car, how)
        driven = ClosedLoop(settings.car, on.track, on.line, controller, car).drive(2)
        assert driven.off_track_m.max() < 2e-3, how
        laps_s[how] = driven.laps_s
    slowest = np.max(list(laps_s.values()), axis=0) / laps_s["as in the file"]
    assert (slowest < 1.06).all()
