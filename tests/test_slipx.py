"""slipx as the car: units and signs of what goes in and out, its limits, and a whole race."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("slipx", reason="there are no wheels of slipx for this Python")

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.operation.analysis.results import read_result
from bayesrace.operation.settings import RaceSettings
from bayesrace.plant.slipx_car import SlipxSimulator
from bayesrace.plant.vehicle import FmuFault, open_vehicle
from bayesrace.vehicles import get_car
from tests.command_line import Cli, refused
from tests.programs import Race

CAR = get_car("slipx")
START = [1.0, -2.0, 0.3, 3.0, 0.0, 0.0, 0.0]


def driven(
    car: SlipxSimulator, start: list[float], u: tuple[float, float] | None, count: int
) -> Floats:
    """States, from the start on, under one command."""
    car.reset(start)
    rows = [car.x.copy()]
    for _ in range(count):
        car.step(u)
        rows.append(car.x.copy())
    return np.array(rows)


def test_it_starts_where_it_is_put_and_rolls_ahead_along_its_heading() -> None:
    x = driven(SlipxSimulator(CAR), START, (0.0, 0.0), 50)
    np.testing.assert_array_equal(x[0], START)
    ahead = (x[-1, :2] - x[0, :2]) @ [np.cos(0.3), np.sin(0.3)]
    assert ahead == pytest.approx(3.0, abs=0.1)
    np.testing.assert_allclose(x[-1, [2, 4, 5, 6]], [0.3, 0.0, 0.0, 0.0], atol=1e-9)
    assert x[-1, 3] < 3.0  # it rolls with resistance


@pytest.mark.parametrize("d", [3.0, -2.0])
def test_the_drive_command_is_an_acceleration(d: float) -> None:
    """Less what the tyres resist."""
    x = driven(SlipxSimulator(CAR), START, (d, 0.0), 25)
    resistance = 3.0 - driven(SlipxSimulator(CAR), START, (0.0, 0.0), 25)[-1, 3]
    assert (x[-1, 3] - 3.0 + resistance) / 0.5 == pytest.approx(d, rel=0.03)


def test_the_car_file_has_what_the_motor_can_do_and_no_more() -> None:
    simulator = SlipxSimulator(CAR)
    full = driven(simulator, [*START[:3], 0.1, 0, 0, 0], (99.0, 0.0), 30)
    assert np.diff(full[5:, 3]).min() / 0.02 == pytest.approx(CAR.d_max, rel=0.05)
    brake = driven(simulator, [*START[:3], 6.0, 0, 0, 0], (-99.0, 0.0), 30)
    assert -np.diff(brake[5:, 3]).max() / 0.02 == pytest.approx(-CAR.d_min, rel=0.12)
    assert simulator.guard.counters.clipped == 60


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_wheels_follow_our_steering_rate_to_the_left_and_the_right(side: float) -> None:
    """A ramp lags by none in the mean; positive is to the left, in angle, yaw rate and place."""
    simulator = SlipxSimulator(CAR)
    x = driven(simulator, START, (0.0, 0.6 * side), 20)
    assert x[-1, 6] == pytest.approx(side * 0.24, abs=0.012)
    assert simulator.u_applied[1] == pytest.approx(0.6 * side, rel=0.02)
    assert side * x[-1, 5] == pytest.approx(3.0 * 0.2 / CAR.wheelbase_m, rel=0.35)
    assert side * (x[-1, 2] - 0.3) > 0.2
    left = np.array([-np.sin(0.3), np.cos(0.3)])
    assert side * ((x[-1, :2] - x[0, :2]) @ left) > 0.05
    held = driven(simulator, [*START[:6], 0.1 * side], (0.0, 0.0), 10)
    assert held[-1, 6] == pytest.approx(0.1 * side, abs=1e-3)


def test_what_acted_is_what_changed_and_runs_repeat_to_the_bit() -> None:
    """The rate that acted leads from one angle to the next, also where the command switches."""
    random = np.random.default_rng(1)
    commands = random.uniform([-3, -6], [6, 6], (60, 2))
    runs: list[Any] = []
    for _ in range(2):
        simulator = SlipxSimulator(CAR)
        simulator.reset(START)
        rows = []
        for k, command in enumerate(commands):
            before = float(simulator.x[6])
            simulator.step_switched([(k % 20, commands[k - 1]), (20 - k % 20, command)])
            changed = (float(simulator.x[6]) - before) / simulator.step_s
            assert simulator.u_applied[1] == pytest.approx(changed, abs=1e-9)
            rows.append(simulator.x.copy())
        runs.append(np.array(rows))
    np.testing.assert_array_equal(*runs)
    assert simulator.time_s == pytest.approx(1.2)


def test_without_commands_it_stops() -> None:
    x = driven(SlipxSimulator(CAR), START, None, 100)
    assert abs(x[-1, 3]) < 0.02
    assert x[-1, 0] > x[0, 0]


def test_only_its_own_car_is_simulated_and_by_one_simulator(cli: Cli, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"lf_m = 0\.16; the car 'orca' has 0\.029: .*--car slipx"):
        SlipxSimulator(get_car("orca"))
    refused(cli("race", "--simulator", "slipx", "--out", "out"), "orca", "--car slipx")
    refused(cli("plant", "--simulator", "slipx", "--car", "slipx", "--fmu", "a.fmu"), "only one")
    with pytest.raises(ValueError, match="true_grip"):
        RaceSettings(car=CAR, simulator="slipx", true_grip=0.9)


def test_races_do_not_maximise_progress_unless_asked() -> None:
    assert RaceSettings(car=CAR, simulator="slipx").progress_runs == 0
    assert RaceSettings(car=CAR, simulator="slipx", progress_drives=1).progress_runs == 1
    assert RaceSettings(car=CAR).progress_runs == 3


def test_a_state_that_is_no_number_is_a_fault_and_the_last_good_one_stays() -> None:
    with open_vehicle(CAR, simulator="slipx") as vehicle:
        assert isinstance(vehicle, SlipxSimulator)
        vehicle.reset(START)
        vehicle._state.rates = type(vehicle._state.rates)(0.0, 0.0, float("nan"))
        with pytest.raises(FmuFault, match=r"slipx 0\.2\.0 at 0\.00 s"):
            vehicle.step((0.0, 0.0))
        assert vehicle.x.tolist() == START


@pytest.mark.check
def test_a_race_on_it_learns_what_the_kinematic_model_lacks(tmp_path: Path) -> None:
    """Over Zenoh in lockstep. There is no BestCase: WorstCase and the line are the measure."""
    how = ("--car", "slipx", "--simulator", "slipx", "--laps", "1")
    race = Race.running(tmp_path / "race", *how)()
    result = read_result(race.out / "result.json")
    laps = {lap.controller: lap for lap in result.laps}
    assert list(laps) == ["worstcase", "bayesrace", "bayesrace-updated"]
    assert result.settings.fmu == "slipx"
    assert "car simulated by slipx" in race.process.stdout
    worst = laps.pop("worstcase")
    assert worst.off_track_samples > 100
    for lap in laps.values():
        assert lap.off_track_samples == lap.fallbacks == 0
        assert (lap.lap_time_s or 99.0) < 0.95 * (worst.lap_time_s or 99.0)
        assert "→" not in lap.weights_version, "rolled back"
