"""What changes while a simulated car drives: plant/world.py."""

from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from bayesrace.errors import InputError
from bayesrace.operation.closed_loop import built_in_car
from bayesrace.operation.settings import RaceSettings
from bayesrace.plant.settings import CarSimulation
from bayesrace.plant.world import UNCHANGED, Change, World, get_world, write_world
from bayesrace.vehicles import Car, default_car, get_car
from tests.changed_cars import CHANGES

START = (0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.1)
GRIP = Change(what="grip", share=0.8, from_s=0.1)


def driven(
    car: Car, world: World = UNCHANGED, start: tuple[float, ...] = START
) -> list[list[float]]:
    """States after each of twenty periods in a bend."""
    vehicle = built_in_car(car, world)
    vehicle.reset(start)
    states = []
    for _ in range(20):
        vehicle.step((0.5, 0.2))
        states.append(vehicle.x.tolist())
    return states


@pytest.mark.parametrize(
    ("what", "share", "how"),
    [
        ("grip", 0.8, "grip 0.8"),
        ("mass", 1.2, "mass + 20 %"),
        ("motor", 0.9, "motor - 10 %"),
    ],
)
def test_a_changed_car_drives_as_one_with_these_numbers(what: str, share: float, how: str) -> None:
    """From the moment of the change on, and as before until then; again in each run."""
    car = default_car()
    world = World.model_validate([{"what": what, "share": share, "from_s": 0.1}])
    vehicle, other = built_in_car(car, world), built_in_car(CHANGES[how](car))
    for _ in range(2):
        vehicle.reset(START)
        for before in driven(car)[:5]:
            vehicle.step((0.5, 0.2))
            assert vehicle.x.tolist() == before
        other.reset(vehicle.x.tolist())
        for _ in range(10):
            vehicle.step((0.5, 0.2))
            other.step((0.5, 0.2))
            np.testing.assert_allclose(vehicle.x, other.x, rtol=0, atol=1e-12)


def test_a_place_counts_while_the_car_is_in_it() -> None:
    car, place = default_car(), {"x_m": 0.0, "y_m": 0.0, "radius_m": 0.1}
    world = World((GRIP.model_copy(update={"from_s": 0.0} | place),))
    plain, patch = driven(car), driven(car, world)
    assert patch[0] != plain[0]
    far = (5.0, *START[1:])
    assert driven(car, world, far) == driven(car, start=far)


def test_shares_grow_end_and_multiply() -> None:
    """Tyres that lose a tenth in 300 s, and a damp half minute."""
    worn = Change(what="grip", share=0.9, over_s=300)
    damp = Change(what="grip", share=0.5, from_s=60, until_s=90)
    world = World((worn, damp))
    at = {t: world.shares(t, 0, 0)[0] for t in (0, 30, 60, 89, 90, 300, 1000)}
    expected = {0: 1, 30: 0.99, 60: 0.49, 89: (1 - 0.1 * 89 / 300) / 2, 90: 0.97, 300: 0.9}
    assert at == pytest.approx(expected | {1000: 0.9})
    assert world.shares(60, 0, 0)[1:] == (1, 1)


def test_a_file_is_what_it_was_written_of(tmp_path: Path) -> None:
    world = World(
        (GRIP, Change(what="mass", share=1.1, x_m=1.0, y_m=-2.0, radius_m=0.5, until_s=7.0))
    )
    write_world(tmp_path / "world.toml", world)
    assert get_world(tmp_path / "world.toml") == world
    settings = RaceSettings.model_validate({"world": tmp_path / "world.toml"})
    assert settings.changes == world
    assert RaceSettings.model_validate_json(settings.model_dump_json()).changes == world


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("[[world]]\nwhat = 'wind'\nshare = 1", ("what", "grip")),
        ("[[world]]\nwhat = 'grip'\nshare = 0", ("share", "0.05")),
        ("[[world]]\nwhat = 'grip'\nshare = 1\nx_m = 3", ("radius_m", "all three")),
        ("[[world]]\nwhat = 'grip'\nshare = 1\nfrom_s = 3\nuntil_s = 2", ("until_s 2", "never")),
        ("[world]\nwhat = 'grip'", ("world",)),
        ("grip = 1", ("world",)),
        ("[[world]", ("docs/world.md",)),
    ],
)
def test_faulty_files_are_refused_by_name(
    tmp_path: Path, content: str, words: tuple[str, ...]
) -> None:
    path = tmp_path / "world.toml"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(InputError) as refused:
        get_world(path)
    for word in (*words, "world.toml"):
        assert word in str(refused.value)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"fmu": "car.fmu"}, "built-in car"),
        ({"simulator": "slipx", "car": get_car("slipx")}, "built-in car"),
    ],
)
def test_other_simulators_do_not_change(given: dict[str, object], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        CarSimulation.model_validate(given | {"world": [GRIP.model_dump()]})


def test_a_car_without_a_motor_has_none_that_changes() -> None:
    motor = Change(what="motor", share=0.9)
    with pytest.raises(ValidationError, match="by an acceleration"):
        CarSimulation(car=get_car("f1tenth"), world=World((motor,)))
    CarSimulation(car=get_car("f1tenth"), world=World((GRIP,)))
