"""Instruments: what they add to the truth, and when; how a file states them, and a car has them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from bayesrace.arrays import Floats
from bayesrace.errors import InputError
from bayesrace.messages import QUANTITIES, Reading
from bayesrace.operation.settings import RaceSettings
from bayesrace.plant.process_settings import PlantSettings
from bayesrace.plant.sensors import Motion, SensorPlayer
from bayesrace.plant.simulator import Simulator, plant_discretisation
from bayesrace.sensors import BUILT_IN, EXACT, FIELDS, Sensors, get_sensors, write_sensors
from bayesrace.vehicles import Car, default_car, read_car, write_car
from bayesrace.vehicles.models import dynamic
from tests.command_line import Cli, refused

TS = 0.02
POSE: dict[str, Any] = {"rate_hz": 50, "x_m": 0.001, "y_m": 0.002, "heading_rad": 0.004}
ALL = POSE | {
    "speed_mps": 0.05, "lateral_mps": 0.06, "yaw_rate_radps": 0.2, "steering_rad": 0.003,
}  # fmt: skip


def sensors(**instruments: Any) -> Sensors:
    return Sensors.model_validate(instruments)


def true(time_s: float) -> Floats:
    """A steady turn with a slip angle while the steering turns."""
    v, vy, omega = 1.5, 0.1, 3.0
    psi = 0.2 + omega * time_s
    x = (v * np.sin(psi) + vy * np.cos(psi)) / omega
    y = (vy * np.sin(psi) - v * np.cos(psi)) / omega
    return np.array([x, y, psi, v, vy, omega, 0.01 * time_s])


def played(
    which: Sensors, seconds: float, seed: int = 0, x: Callable[[float], Floats] = true
) -> list[tuple[float, Reading]]:
    """Readings with the times of the states that report them."""
    player = SensorPlayer(which, seed)
    times = [TS * k for k in range(round(seconds / TS) + 1)]
    return [(at, one) for at in times for one in player.report(at, x(at).tolist())]


def errors(readings: list[tuple[float, Reading]]) -> Floats:
    """Of each reading, what it adds to the truth, (n, measured)."""
    found = []
    for _, one in readings:
        right = true(one.time_s)
        off = {name: value - right[QUANTITIES.index(name)] for name, (value, _) in
               one.values.items()}  # fmt: skip
        if "psi" in off:
            off["psi"] = np.remainder(off["psi"] + np.pi, 2 * np.pi) - np.pi
        found.append(list(off.values()))
    return np.array(found)


def test_noise_has_the_deviations_that_are_stated() -> None:
    assert tuple(FIELDS) == QUANTITIES
    readings = played(sensors(all=ALL), 200)
    deviations = [ALL[name] for name in FIELDS.values()]
    off = errors(readings)
    assert len(off) == pytest.approx(10_000, abs=1)
    np.testing.assert_allclose(off.std(axis=0), deviations, rtol=0.04)
    assert (np.abs(off.mean(axis=0)) < 0.04 * np.array(deviations)).all()
    assert np.abs(np.corrcoef(off.T) - np.eye(7)).max() < 0.05
    assert np.abs(np.corrcoef(off[1:, 0], off[:-1, 0])[0, 1]) < 0.05
    for _, one in readings[:9]:
        assert [deviation for _, deviation in one.values.values()] == deviations
        assert abs(one.values["psi"][0]) <= np.pi


def test_offsets_steps_and_noise_that_grows_with_the_value() -> None:
    wheel = {
        "rate_hz": 50, "speed_mps": {"deviation": 0.001, "relative": 0.02},
        "yaw_rate_radps": {"deviation": 0.02, "offset": 0.05, "step": 0.25},
    }  # fmt: skip
    readings = [
        one for one in played(sensors(pose=POSE, wheel=wheel), 100) if "vx" in one[1].values
    ]
    off = errors(readings)
    assert off[:, 0].std() == pytest.approx(0.02 * 1.5, rel=0.04)
    value, deviation = readings[0][1].values["vx"]
    assert deviation == pytest.approx(0.02 * value)
    steps = np.array([one.values["omega"][0] for _, one in readings]) / 0.25
    assert (steps == np.round(steps)).all()
    assert off[:, 1].mean() == pytest.approx(0.0, abs=0.01)  # 3.05 is nearest to 3
    wheel["yaw_rate_radps"] = {"deviation": 0.02, "offset": 0.05}
    readings = [
        one for one in played(sensors(pose=POSE, wheel=wheel), 100) if "vx" in one[1].values
    ]
    assert errors(readings)[:, 1].mean() == pytest.approx(0.05, abs=0.002)


def test_readings_are_lost_fail_for_a_while_or_are_wrong() -> None:
    wrong = POSE | {"outliers": 0.1, "x_m": {"deviation": 0.001, "outlier": 0.5}}
    off = np.abs(errors(played(sensors(pose=wrong), 200)))
    far = off[:, 0] > 0.01
    assert far.mean() == pytest.approx(0.1, abs=0.01)
    assert off[far, 0].std() == pytest.approx(0.5 * np.sqrt(1 - 2 / np.pi), rel=0.1)
    assert off[:, 1].max() < 0.01
    lost = played(sensors(pose=POSE | {"lost": 0.2}), 200)
    assert len(lost) == pytest.approx(8_000, rel=0.03)
    gaps = played(sensors(pose=POSE | {"gap_s": 0.1, "gap_every_s": 2}), 200)
    times = np.array([one.time_s for _, one in gaps])
    assert len(gaps) == pytest.approx(9_500, rel=0.01)
    assert (times % 2 < 1.9).all()


@pytest.mark.parametrize("rate_hz", [7, 50, 120])
def test_a_reading_comes_with_the_first_state_after_its_delay(rate_hz: float) -> None:
    late = POSE | {"rate_hz": rate_hz, "delay_s": 0.033}
    readings = played(sensors(pose=late), 40)
    measured = np.array([one.time_s for _, one in readings])
    reported = np.array([at for at, _ in readings])
    assert (reported >= measured + 0.033 - 1e-9).all()
    assert (reported - TS < measured + 0.033).all()
    np.testing.assert_allclose(np.diff(measured), 1 / rate_hz)
    assert 0 < measured[0] <= 1 / rate_hz
    jittery = played(sensors(pose=late | {"jitter_s": 0.03}), 40)
    delays = np.array([at - one.time_s for at, one in jittery])
    assert 0.003 <= delays.min() < 0.013
    assert 0.063 < delays.max() <= 0.063 + TS


def test_no_state_has_more_than_16_and_what_does_not_fit_waits() -> None:
    bursts = {"rate_hz": 790, "gap_s": 0.01, "gap_every_s": 1, "speed_mps": 0.1}
    which = sensors(pose=POSE | {"rate_hz": 10}, wheel=bursts)
    player, counts, times = SensorPlayer(which), [], []
    for k in range(500):
        readings = player.report(TS * k, true(TS * k).tolist())
        counts.append(len(readings))
        times += [one.time_s for one in readings]
    assert counts[0] == 0
    assert max(counts) == 16
    assert times == sorted(times)
    assert len(times) == pytest.approx(500 * TS * (790 * 0.99 + 10), abs=25)


def test_the_same_seed_gives_the_same_readings() -> None:
    which, more = sensors(pose=POSE), sensors(pose=POSE, other=ALL)
    first = played(which, 5, seed=4)
    assert first == played(which, 5, seed=4) != played(which, 5, seed=5)
    assert first == [one for one in played(more, 5, seed=4) if one[1].instrument == "pose"]


def test_between_two_states_the_car_is_where_the_equations_have_it(car: Car) -> None:
    """A period of 20 ms against the same in steps of 2 ms, with steps of both inputs."""
    fine = Simulator(dynamic(car), plant_discretisation(500))
    fine.reset((0, 0, 0.3, 1.5, 0, 0, 0.1))
    random, off = np.random.default_rng(1), []
    for _ in range(200):
        d, angle = random.uniform((0.0, -0.05), (0.9, 0.25))
        u = d, float(np.clip((angle - fine.x[6]) / TS, -5, 5))
        states = [fine.x.copy()]
        for _ in range(10):
            fine.step(u)
            states.append(fine.x.copy())
        motion = Motion(states[0].tolist(), states[-1].tolist(), TS)
        off += [np.array(motion.at(k / 10)) - one for k, one in enumerate(states)]
    rmse = np.sqrt(np.mean(np.square(off), axis=0))
    assert (rmse < (1e-6, 1e-6, 2e-5, 1e-4, 1e-4, 3e-3, 1e-9)).all()


# Files -------------------------------------------------------------------------------------------


def test_a_car_has_its_own_sensors_and_an_option_overrides_them(tmp_path: Path) -> None:
    own = sensors(pose=ALL | {"outliers": 0.1, "x_m": {"deviation": 0.1, "outlier": 1.0}})
    car = default_car().model_copy(update={"sensors": own})
    write_car(tmp_path / "mine.toml", car)
    assert read_car(tmp_path / "mine.toml") == car
    assert car.identity == default_car().identity
    write_sensors(tmp_path / "sensors.toml", own)
    assert get_sensors(tmp_path / "sensors.toml") == own
    settings = RaceSettings.model_validate({"car": tmp_path / "mine.toml"})
    assert settings.instruments == own
    assert RaceSettings.model_validate_json(settings.model_dump_json()).instruments == own
    assert settings.model_copy(update={"sensors": EXACT}).instruments == EXACT
    given = RaceSettings.model_validate({"sensors": tmp_path / "sensors.toml"})
    assert given.instruments == own
    assert hash(given) != hash(RaceSettings())
    assert RaceSettings().instruments == EXACT
    assert [one.label for one in BUILT_IN.values()] == list(BUILT_IN)
    poses = [{"rate_hz": 50, "x_m": 1e-3, "y_m": 1e-3, "heading_rad": rad} for rad in (0.01, 0.02)]
    labels = [Sensors.model_validate({"pose": one}).label for one in poses]
    assert len(set(labels)) == 2
    assert all(one.startswith("pose 50 Hz (") and len(one) < 25 for one in labels)


def test_the_example_in_the_docs_is_read(tmp_path: Path) -> None:
    text = (Path(__file__).parents[1] / "docs/sensors.md").read_text()
    (tmp_path / "mine.toml").write_text(text.split("```toml\n")[1].split("```")[0])
    assert list(get_sensors(tmp_path / "mine.toml").root) == ["pose", "encoder"]


HEAD = "[sensors.pose]\n"
GOOD = f"{HEAD}rate_hz = 50\nx_m = 0.001\ny_m = 0.001\nheading_rad = 0.01\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ("sensors is missing",)),
        ("sensors = 3", ("sensors",)),
        (GOOD.replace("sensors", "sensor"), ("sensor", "did you mean 'sensors'?")),
        (HEAD + "rate_hz = 50", ("sensors.pose", "measures nothing", "x_m")),
        (GOOD.replace("50", "0"), ("sensors.pose.rate_hz = 0", "greater than", "[Hz]")),
        (GOOD.replace("y_m", "z_m"), ("sensors.pose.z_m", "did you mean")),
        (GOOD.replace("y_m = 0.001", ""), ("x_m, y_m and heading_rad together", "add them")),
        (GOOD.replace("x_m = 0.001", "x_m = -1"), ("sensors.pose.x_m.deviation = -1",)),
        (GOOD.replace("x_m = 0.001", "x_m = { step = 1 }"), ("x_m.deviation is missing",)),
        (GOOD + "delay_s = 0.01\njitter_s = 0.02", ("jitter_s 0.02", "raise the delay")),
        (GOOD + "gap_s = 1", ("gap_s 1, gap_every_s 0", "give both")),
        (GOOD + "outliers = 0.1", ("outliers need", "outlier = 0.3")),
        (GOOD.replace(".pose", '."my pose"'), ("my pose", "pattern")),
        (GOOD + "".join(GOOD.replace("pose", f"p{i}") for i in range(8)), ("at most 8",)),
        ("[sensors.pose", ("no TOML",)),
    ],
)
def test_a_file_that_cannot_be_is_refused_with_the_remedy(
    tmp_path: Path, text: str, words: tuple[str, ...]
) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(InputError) as refusal:
        get_sensors(path)
    for word in (str(path), *words):
        assert word in str(refusal.value)


def test_what_no_state_can_hold_is_refused(cli: Cli, tmp_path: Path) -> None:
    path = tmp_path / "fast.toml"
    path.write_text(GOOD.replace("50", "1000"))
    with pytest.raises(ValidationError, match="1000 readings in a second, and 50 states hold 16"):
        RaceSettings.model_validate({"sensors": path})
    assert PlantSettings.model_validate({"sensors": path, "rate_hz": 100}).instruments
    refused(cli("plant", "--sensors", path), "rate_hz", "800 Hz")
    refused(cli("race", "--sensors", "eyes"), "--sensors", "exact, mocap, odometry")
    refused(cli("race", "--sensors", tmp_path / "none.toml"), "--sensors", "none.toml")
