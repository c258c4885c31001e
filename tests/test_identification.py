"""``identify``: the numbers of simulated cars from drives as instruments saw them."""

from pathlib import Path

import pytest

from bayesrace.learning.identification import Identified, identify
from bayesrace.learning.instruments import driven_car, read_runs
from bayesrace.vehicles import CarParameters, get_car, read_car, write_car
from bayesrace.vehicles.parts import DcMotor
from tests.cars import with_numbers
from tests.command_line import Cli, refused
from tests.identified import GYRO_NOISE, GYRO_OFFSET, TRIM, exact, plain, raced, seen

GUESS = {"cm1": 0.4, "cm2": 0.03, "cr0": 0.02, "cr2": 0.001, "friction": 0.5}
"""What a driver would write who knows the size of an orca only."""


def guess(car: CarParameters) -> CarParameters:
    """The car of a driver who has measured size and mass, and guesses the rest."""
    numbers = GUESS if isinstance(car.drive, DcMotor) else {"friction": 0.4}
    return with_numbers(car, numbers).model_copy(update={"tyres": None, "inertia_kgm2": None})


def found_in(log: Path, car: CarParameters | None = None) -> Identified:
    begun, name = driven_car([log], car, "")
    return identify(begun, *read_runs([log], name))


def near(found: Identified, name: str, true: float, share: float = 0.03) -> None:
    """Within three standard errors, and within a share of the true value."""
    one = next(one for one in found.values if one.name == name)
    assert abs(one.value - true) < 3 * one.error, one
    assert abs(one.value - true) < share * abs(true), one


@pytest.mark.parametrize("noise", [(0.5, 0.2), pytest.param((1.0, 0.5), marks=pytest.mark.check)])
def test_an_orca_is_found_from_poses(tmp_path: Path, noise: tuple[float, float]) -> None:
    """Beginning with guesses; poses come 20 ms late, with gaps and outliers."""
    driven = exact("orca", 30.0)
    found = found_in(seen(driven, tmp_path / "drive.mcap", *noise), guess(driven.car))
    for name in ("cm1", "cm2", "cr0"):
        near(found, name, driven.car.drive.numbers()[name])
    near(found, "cr2", driven.car.drive.numbers()["cr2"], 1.0)
    near(found, "steering offset", TRIM)
    near(found, "steering gain", 1.0)
    near(found, "friction", 0.751)
    assert found.limit


@pytest.mark.check
def test_a_delay_that_no_instrument_states_is_that_of_the_command(tmp_path: Path) -> None:
    driven = exact("orca", 30.0)
    found = found_in(seen(driven, tmp_path / "drive.mcap", 0.5, 0.2, stamped=False))
    near(found, "delay", 20.0)
    near(found, "cm1", driven.car.drive.numbers()["cm1"])


@pytest.mark.check
def test_an_f1tenth_is_found_from_poses(tmp_path: Path) -> None:
    """Its drive follows accelerations; its tyres have no limit that could be found."""
    driven = exact("f1tenth", 30.0)
    found = found_in(seen(driven, tmp_path / "drive.mcap", 0.5, 0.2), guess(driven.car))
    for name, true in (("drive gain", 1.0), ("steering offset", TRIM), ("steering gain", 1.0)):
        near(found, name, true)
    assert not found.limit


def test_whole_states_are_an_instrument_of_all_seven(tmp_path: Path) -> None:
    """Of 12 s without noise, of which the angle at the start is known."""
    driven = exact("orca", 12.0)
    found = found_in(plain(driven, tmp_path / "drive.mcap"))
    known = {one.name: one.value for one in found.values}
    assert known["cm1"] == pytest.approx(0.287, rel=0.01)
    assert abs(known["steering offset"]) < 1e-3
    assert known["state x"] < 1e-4


@pytest.mark.check
def test_a_gyro_is_compared_with_the_poses(tmp_path: Path) -> None:
    driven = exact("orca", 12.0)
    log = seen(driven, tmp_path / "drive.mcap", 0.5, 0.2, gyro=True)
    found = found_in(log)
    near(found, "gyro late", 20.0, 0.05)
    near(found, "yaw rate offset", GYRO_OFFSET, 0.1)
    near(found, "gyro omega", GYRO_NOISE, 0.1)


@pytest.mark.check
def test_a_race_with_the_identified_car_loses_no_time(tmp_path: Path) -> None:
    driven = exact("orca", 30.0)
    found = found_in(seen(driven, tmp_path / "drive.mcap", 1.0, 0.5), guess(driven.car))
    true, identified = (raced(driven.car, car, tmp_path) for car in (driven.car, found.car))
    assert (identified.off_track_m <= 0).all()
    assert identified.laps_s[1] < 1.005 * true.laps_s[1]


def test_the_command_writes_a_file_that_all_others_read(cli: Cli, tmp_path: Path) -> None:
    log = plain(exact("orca", 12.0), tmp_path / "drive.mcap")
    start = tmp_path / "mine.toml"
    write_car(start, guess(get_car("orca")))
    outcome = cli("identify", log, "--car", start, "--picture", "seen.png", "--wheelbase")
    assert outcome.code == 0, outcome.err
    for word in ("cm1", "std. error", "wheelbase", "state omega", "identified.toml"):
        assert word in outcome.out
    made = read_car(tmp_path / "identified.toml")
    assert made.tyres is None
    assert made.wheelbase_m == pytest.approx(0.062, rel=0.01)
    assert made.mass_kg == get_car("orca").mass_kg
    assert "# Identified by" in (tmp_path / "identified.toml").read_text()
    assert (tmp_path / "seen.png").stat().st_size > 1000
    assert cli("cars", "identified.toml").code == 0


def test_drives_that_do_not_suffice_are_refused(cli: Cli, tmp_path: Path) -> None:
    driven = exact("orca", 12.0)
    short = seen(driven, tmp_path / "short.mcap", 0.5, 0.2, count=100)
    refused(cli("identify", short), "of driving", "--duration")
    refused(cli("identify", short, "--car", "f1tenth"), "holds states of orca", "--car", "--name")
    refused(cli("identify"), "no log given", "bayesrace collect")
    blind = seen(driven, tmp_path / "blind.mcap", 0.5, 0.2, gyro=True, pose=False)
    refused(cli("identify", blind), "x, y and psi", "motion capture")
    held = plain(driven, tmp_path / "held.mcap", u=(0.4, 0.0))
    refused(cli("identify", held), "drive command hardly changes", "bayesrace collect")


@pytest.mark.check
def test_commands_that_do_not_move_the_car_are_refused(cli: Cli, tmp_path: Path) -> None:
    wrong = plain(exact("orca", 12.0), tmp_path / "wrong.mcap", u=None)
    refused(cli("identify", wrong), "no such car", "--car")
