"""A car that stands beside its line, however it points, drives off along it again."""

import math

import numpy as np
import pytest

from bayesrace.arrays import Floats
from bayesrace.codegen.build import build
from bayesrace.codegen.settings import BuildSettings, ProblemName
from bayesrace.controller.assembly import make_path_table
from bayesrace.controller.interface import Environment
from bayesrace.controller.native_step import NativeStep
from bayesrace.tracks import Track
from bayesrace.vehicles import Car, default_car
from tests.conftest import SETTINGS, Circuit, offset_line
from tests.test_driver import Rig

HOPELESS = SETTINGS.model_copy(update={"iterations_cold": 1, "defect_max": 1e-12})
"""Iterations that lead to no plan which may be driven."""


def standing(
    circuit: Circuit, s_m: float, to_left_m: float, turned_rad: float, steering: float = 0.0
) -> Floats:
    """State of a car that stands beside the line and is turned away from it."""
    x = circuit.start(s_m, 0.0)
    x[:2] += to_left_m * np.array([-np.sin(x[2]), np.cos(x[2])])
    x[2] += turned_rad
    x[6] = steering
    return x


def rig_at(native: NativeStep, circuit: Circuit, pose: Floats) -> Rig:
    """A car that begins in this state."""
    rig = Rig(native, circuit)
    rig.x = pose
    return rig


def drive(rig: Rig, cycles: int) -> None:
    for _ in range(cycles):
        rig.cycle()


def where(rig: Rig) -> float:
    """Arc length of the car's place on the line."""
    output = rig.driver.output
    assert output is not None
    return output.numbers["s_ref_m"]


def test_a_car_drives_off_from_any_pose(native: NativeStep, circuit: Circuit) -> None:
    """Without turning round on purpose, an eighth of such poses end in standing for ever."""
    random = np.random.default_rng(3)
    for _ in range(12):
        bounds = np.array([(0, 6.3), (-0.4, 0.4), (-math.pi, math.pi), (-0.35, 0.35)]).T
        native.reset()
        rig = rig_at(native, circuit, standing(circuit, *random.uniform(*bounds)))
        pose = rig.x.round(3).tolist()
        drive(rig, 150)
        where_m = where(rig)
        drive(rig, 50)
        ahead = (where(rig) - where_m) % circuit.line.length_m
        assert 0.5 < ahead < circuit.line.length_m / 2, f"{ahead} m in a second from {pose}"


@pytest.mark.parametrize("to_left_m", [-0.1, 0.1])
@pytest.mark.parametrize("turned_rad", [math.pi - 0.2, math.pi + 0.2])
def test_it_turns_to_the_side_with_more_room(
    native: NativeStep, circuit: Circuit, to_left_m: float, turned_rad: float
) -> None:
    """Pointing the other way, its right is the line's left."""
    x = standing(circuit, 1.0, 0.0, turned_rad)
    on_track = circuit.track.project_points(x[:2])
    right, left = circuit.track.widths(on_track.s_m[0])
    middle = float((left - right) / 2 - on_track.n_m[0])
    x = standing(circuit, 1.0, middle + to_left_m, turned_rad)
    assert native.step(x, 0.0).usable
    assert np.sign(native.u[1]) == np.sign(to_left_m)


@pytest.mark.parametrize("turned_rad", [-0.85, 0.85])
def test_a_car_that_points_a_little_aside_does_not_turn_first(
    native: NativeStep, circuit: Circuit, turned_rad: float
) -> None:
    """At the pace of a turn the standing lap of ETHZMobil, whose line begins so, took 0.66 s
    longer."""
    rig = rig_at(native, circuit, standing(circuit, 1.0, 0.0, turned_rad))
    drive(rig, 15)
    assert rig.x[3] > 0.8


def test_a_start_in_a_tight_bend_is_no_turn(native: NativeStep) -> None:
    """The line ahead is far to one side there, for a car that follows it, too."""
    angle = np.linspace(0, 2 * np.pi, 80, endpoint=False)
    track = Track.from_points(
        "ring", 0.4 * np.column_stack([np.cos(angle), np.sin(angle)]), 0.16, 0.16
    )
    line = offset_line(track, offset_m=0.0, lateral_mps2=3.0, v_max=2.0)
    ring = Circuit(track, line, make_path_table(track, line, default_car().tuning.path.spacing_m))
    native.set_path(ring.table)
    rig = rig_at(native, ring, ring.start(1.0, 0.0))
    drive(rig, 25)
    assert rig.x[3] > 0.8


def fastest_in_turn(rig: Rig, cycles: int) -> float:
    """Highest speed while the car turns by 2.2 rad, which takes it fewer cycles than these."""
    begin_rad, fastest = rig.x[2], 0.0
    while abs(rig.x[2] - begin_rad) < 2.2:
        rig.cycle()
        fastest = max(fastest, rig.x[3])
        assert rig.seq < cycles
    return fastest


def test_a_speed_limit_is_kept_in_a_turn(native: NativeStep, circuit: Circuit) -> None:
    rig = rig_at(native, circuit, standing(circuit, 1.0, 0.0, math.pi))
    rig.environment = Environment(speed_limit_mps=0.3)
    assert 0.1 < fastest_in_turn(rig, 300) < 0.3


def test_where_it_is_to_stop_a_car_that_points_away_keeps_its_plan(
    native: NativeStep, circuit: Circuit
) -> None:
    stop = Environment(speed_limit_mps=0.0)
    x = standing(circuit, 1.0, 0.0, math.pi)
    native.step(x, 0.0, environment=stop)
    assert native.info.shifts == -1
    for _ in range(3):
        assert native.step(x, 0.0, environment=stop).usable
        assert native.info.shifts == 1


@pytest.mark.parametrize("turned_rad", [-1.5, 1.5])
def test_it_turns_the_shorter_way(native: NativeStep, circuit: Circuit, turned_rad: float) -> None:
    assert native.step(standing(circuit, 1.0, 0.0, turned_rad), 0.0).usable
    assert np.sign(native.u[1]) == -np.sign(turned_rad)


def test_the_pace_is_kept_and_the_turn_ends_when_the_line_is_faced(
    native: NativeStep, circuit: Circuit
) -> None:
    rig = rig_at(native, circuit, standing(circuit, 1.0, 0.0, math.pi))
    assert fastest_in_turn(rig, 200) < 0.7
    drive(rig, 100)
    assert rig.x[3] > 1.0


def test_a_stop_on_command_ends_a_turn(native: NativeStep, circuit: Circuit) -> None:
    rig = rig_at(native, circuit, standing(circuit, 1.0, 0.0, math.pi))
    drive(rig, 20)
    assert rig.x[3] > 0.2
    rig.driver.stop()
    drive(rig, 100)
    assert abs(rig.x[3]) < 0.05


def test_what_has_failed_is_begun_otherwise_at_once(
    native: NativeStep, circuit: Circuit, car: Car
) -> None:
    """The same cold start over and over would fail for ever where the state does not change."""
    native.set_parameters(car, HOPELESS)
    x = circuit.start(1.0, 1.0)
    plans = []
    for _ in range(2):
        assert not native.step(x, 0.0).usable
        assert native.info.iterations == 5  # four guesses, and without soft rows
        plans.append(native.read_plan()[1].copy())
    native.set_parameters(car, SETTINGS)
    assert native.step(x, 0.0).usable
    native.reset()
    native.set_parameters(car, HOPELESS)
    native.step(x, 0.0)
    plans.append(native.read_plan()[1].copy())
    np.testing.assert_array_equal(plans[0], plans[1])
    np.testing.assert_array_equal(plans[0], plans[2])


@pytest.mark.parametrize("problem", ["tracking", "progress"])
def test_a_standing_car_creeps_along_its_line_where_no_optimisation_finds_a_plan(
    circuit: Circuit, car: Car, problem: ProblemName
) -> None:
    """Each cycle has the same problem: one start of 250 stood for ever."""
    step = NativeStep(build(BuildSettings(car=car, problem=problem))[0], car, HOPELESS)
    step.set_path(circuit.table)
    rig = rig_at(step, circuit, standing(circuit, 1.0, 0.02, 0.3))
    drive(rig, 15)
    crept = rig.driver.count("creeping")
    assert crept >= 1  # between, the fallback drives on by that plan
    assert rig.x[3] > 0.2
    assert 0.02 < (where(rig) - 1.0) % circuit.line.length_m < 0.5
    assert circuit.track.project_points(rig.x[None, :2]).off_track_m.max() < 0
    step.reset()
    rig.x[3] = 1.0
    rig.cycle()  # a car that rolls is braked by the fallback
    assert rig.driver.count("creeping") == crept
    step.set_parameters(car, SETTINGS)
    drive(rig, 50)
    assert rig.x[3] > 1.0
    assert rig.driver.count("creeping") == crept


def test_a_car_that_stands_for_long_creeps_off_unless_it_has_to_stop(
    native: NativeStep, circuit: Circuit
) -> None:
    """The best plan may be to stay, or to drive off later, in each cycle anew."""
    x = standing(circuit, 1.0, 0.02, 0.1)
    stop = Environment(speed_limit_mps=0.0, speed_limit_rate_mps2=0.0)
    for environment, creeps in (None, True), (stop, False):
        native.reset()
        kinds = []
        for _ in range(40):  # whatever it does, the car does not move
            assert native.step(x, 0.0, environment=environment, elapsed_s=0.02).usable
            kinds.append(native.info.second_start)
        assert (3 in kinds) == creeps
        if creeps:
            assert kinds.index(3) == pytest.approx(25, abs=1)
            assert set(kinds[kinds.index(3) :]) == {3}
            pace_mps = native.read_plan()[0][-1, 3]
            assert 0.5 < pace_mps / default_car().tuning.turn.pace_mps < 1.1
    x[3] = 0.3  # it rolls
    native.step(x, 0.0, elapsed_s=0.02)
    assert native.info.second_start != 3


@pytest.mark.parametrize("s_m", [0.0, 1.0, 2.2, 3.3, 4.4, 5.5])
def test_a_car_that_stands_on_its_line_creeps_along_it(
    native: NativeStep, circuit: Circuit, s_m: float
) -> None:
    """It is not led round where its line bends: the edges would not count."""
    native.reset()
    x = standing(circuit, s_m, 0.0, 0.0)
    for _ in range(40):
        native.step(x, 0.0, elapsed_s=0.02)
    assert native.info.second_start == 3
    plan, reference = native.read_plan()[0], native.read_reference()
    np.testing.assert_allclose(reference[:, 5] - reference[:, 4], 0.34, atol=1e-4)  # the track's
    off_track_m = circuit.track.project_path(plan[:, :2]).off_track_m
    assert off_track_m.max() <= max(off_track_m[0], 0) + 1e-3
