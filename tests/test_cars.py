"""Cars as files: what is read, what is refused and how, and what follows from a car's size."""

import re
from pathlib import Path

import numpy as np
import pytest

from bayesrace.codegen.build import problem_of
from bayesrace.codegen.problems.generate import c_header
from bayesrace.codegen.settings import BuildSettings
from bayesrace.errors import InputError
from bayesrace.integrators import PREDICTION
from bayesrace.operation.settings import RaceSettings
from bayesrace.raceline import RaceLine, compute_raceline
from bayesrace.tracks import load_track
from bayesrace.vehicles import (
    Car,
    Tuning,
    car_text,
    default_car,
    described_car,
    get_car,
    read_car,
    write_car,
)
from bayesrace.vehicles.models import e_kinematic
from bayesrace.vehicles.parameters import MODELS, SECTIONS
from bayesrace.vehicles.parts import Pacejka
from tests.command_line import Cli, refused

ORCA = Path(__file__).parents[1] / "bayesrace" / "cars" / "orca.toml"
EXTENDING = Path(__file__).parents[1] / "docs" / "extending.md"


def example() -> tuple[str, str]:
    """The car's file and the program of docs/extending.md, 'Add a car'."""
    part = EXTENDING.read_text().split("\n## ")[1]
    toml, program = re.findall(r"```\w+\n(.*?)```", part, re.DOTALL)
    assert len((toml + program).splitlines()) < 60
    return toml, program


def written(folder: Path, text: str) -> Path:
    path = folder / "car.toml"
    path.write_text(text)
    return path


def refusal(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        read_car(path)
    text = str(caught.value)
    assert text.startswith(str(path))
    assert "\n" not in text
    return text


def test_the_built_in_car_is_the_one_it_was() -> None:
    """Weights, manifests and logs name it by this digest."""
    assert default_car().identity == "orca-d463397c7fde"
    assert get_car("orca") is default_car()
    assert get_car(ORCA) == get_car(str(ORCA)) == default_car()


def test_a_car_survives_its_file_and_its_description(tmp_path: Path) -> None:
    stated = {"mass_kg": 1 / 3, "tuning": {"pursuit": {"lookahead_m": 0.1 + 0.2}}}
    car = described_car(
        default_car().model_dump() | stated | {"name": "mine", "race_track": '"🏁"'}
    )
    write_car(tmp_path / "mine.toml", car)
    again = read_car(tmp_path / "mine.toml")
    assert again == car == described_car(car_text(car))
    assert again.tuning.pursuit.lookahead_m == 0.1 + 0.2
    assert car_text(default_car()) == "orca"
    with pytest.raises(InputError, match="unknown car"):  # logs of others name no files to read
        described_car(str(tmp_path / "mine.toml"))


def unidentified(folder: Path) -> Path:
    """The built-in car's file without what a ruler and a scale do not tell."""
    text = re.sub(r"\[tyres\]\n(.+\n)+|inertia_kgm2.*\n", "", ORCA.read_text())
    return written(folder, text)


def test_a_car_that_nobody_simulates_needs_neither_tyres_nor_inertia(tmp_path: Path) -> None:
    car, known = read_car(unidentified(tmp_path)), default_car()
    assert not car.identified
    assert car.has_limit
    assert car.identity != known.identity
    write_car(tmp_path / "again.toml", car)
    assert read_car(tmp_path / "again.toml") == car
    track = load_track("paddock")
    line, same = (compute_raceline(track, one) for one in (car, known))
    assert np.array_equal(line.vx_mps, same.vx_mps)
    x, u = np.array([0.0, 0.0, 0.3, 1.5, 0.1, 2.0, 0.1]), np.array([0.4, 0.5])
    predicted, expected = (
        PREDICTION.discretise(e_kinematic(one))(x, u).full() for one in (car, known)
    )
    assert np.array_equal(predicted, expected)
    assert car.brake_numbers["brake_d"] == pytest.approx(  # half of what friction gives
        0.5 * car.friction * 9.81 * car.mass_kg / car.drive.numbers()["cm1"]
    )


def test_who_simulates_a_car_names_what_its_file_lacks(tmp_path: Path, cli: Cli) -> None:
    file = str(unidentified(tmp_path))
    lacks = "the car 'orca' has no tyres in its file"
    for command in (
        ("limit", "harbour"),
        ("plant", "--endpoint", "tcp/127.0.0.1:0"),
        ("race", "--out", str(tmp_path / "run")),
        ("fmu", "export", "--out", str(tmp_path / "car.fmu")),
        ("cars", "--tyres", "pacejka"),
    ):
        given = (*command, file) if command[0] == "cars" else (*command, "--car", file)
        refused(cli(*given), lacks)
    assert list((tmp_path / "run").glob("*.*")) == []


def test_every_value_of_a_car_has_its_place_in_the_file_and_a_unit() -> None:
    models = [form for one in MODELS.values() for form in one.values()]
    placed = [*MODELS, *(name for names in SECTIONS.values() for name in names)]
    assert sorted(placed) == sorted(set(Car.model_fields) - {"name", "tuning", "sensors"})
    forms = [
        Car,
        Pacejka,
        *models,
        *(field.annotation for field in Tuning.model_fields.values()),
    ]
    for form in forms:
        for name, field in form.model_fields.items():  # type: ignore[union-attr]
            apart = {"name", "tuning", "sensors", "tyres", "drive", "model", "front", "rear"}
            assert name in apart or re.search(r" \[[^]]+\]$", field.description or ""), name


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("mass_kg = 0.041", "mass_kg = -1", ("geometry.mass_kg = -1:", "greater than 0", "[kg]")),
        ("mass_kg = 0.041", 'mass_kg = "x"', ("geometry.mass_kg = 'x'", "number")),
        ("mass_kg = 0.041", "mass_kg = nan", ("geometry.mass_kg = nan", "finite")),
        ("lf_m = 0.029\n", "", ("geometry.lf_m is missing", "front axle [m]")),
        ("lf_m = 0.029", "lenght = 1", ("unknown setting 'geometry.lenght'", "length_m")),
        ('"pacejka"', '"magic"', ("tyres.model = 'magic' is unknown", "pacejka")),
        ('model = "dc_motor"\n', "", ("drive.model is missing", "dc_motor")),
        ("c = 1.2,", "c = 0,", ("tyres.front.c = 0", "shape factor")),
        ("friction = 0.75", "friction = 75", ("limits.friction = 75", "less than or equal to 5")),
        ('name = "orca"', 'name = "a/b"', ("name = 'a/b'", "letters")),
        ('name = "orca"', "name = ", ("no TOML", "line 3")),
        ("[limits]", "[limit]", ("unknown setting 'limit'", "'limits'")),
        (
            "[limits]",
            "[tuning.turn]\nslow_mps = 0\n[limits]",
            ("turn.slow_mps = 0:", "[m/s]"),
        ),
        (
            "mirrored_samples = true",
            "mirrored_samples = 1",
            ("learning.mirrored_samples = 1", "true or false"),
        ),
        ("[limits]", "[tuning.turn]\nslow = 1\n[limits]", ("tuning.turn.slow'", "slow_mps")),
    ],
)
def test_a_fault_is_reported_with_field_value_and_meaning(
    tmp_path: Path, before: str, after: str, words: tuple[str, ...]
) -> None:
    text = ORCA.read_text()
    assert before in text
    text = text.replace("brake_fade_mps = 0.1\n", "").replace(before, after)
    said = refusal(written(tmp_path, text))
    assert "brake_fade" not in said  # it only follows from others
    assert [word for word in words if word not in said] == []


def test_a_missing_file_is_refused_with_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="bayesrace cars orca --out"):
        get_car(str(tmp_path / "none.toml"))


def test_tuning_follows_from_the_cars_own_scales(tmp_path: Path) -> None:
    """Four times the wheelbase: lengths x 4, speeds and times x 2, yaw rates / 2."""
    small = default_car()
    stated = {"lf_m": 4 * small.lf_m, "lr_m": 4 * small.lr_m}
    apart = {"tuning", "brake_fade_mps"}
    large = described_car(small.model_dump(exclude=apart) | stated).tuning
    assert large.path.spacing_m == pytest.approx(4 * small.tuning.path.spacing_m)
    assert large.turn.pace_mps == pytest.approx(2 * small.tuning.turn.pace_mps)
    assert large.turn.throttle_spm == pytest.approx(small.tuning.turn.throttle_spm / 2)
    assert large.pursuit.lookahead_s == pytest.approx(2 * small.tuning.pursuit.lookahead_s)
    assert large.scale.yaw_rate_radps == pytest.approx(small.tuning.scale.yaw_rate_radps / 2)
    assert large.driving.stop_mps2 == small.tuning.driving.stop_mps2
    assert large.turn.away_rad == small.tuning.turn.away_rad
    text = ORCA.read_text() + "[tuning.turn]\npace_mps = 0.7\n"
    stated_one = read_car(written(tmp_path, text)).tuning
    pace = stated_one.turn.model_copy(update={"pace_mps": small.tuning.turn.pace_mps})
    assert stated_one.turn.pace_mps == 0.7
    assert stated_one.model_copy(update={"turn": pace}) == small.tuning


def test_the_planner_in_c_is_compiled_with_the_numbers_of_the_car(tmp_path: Path) -> None:
    toml, _ = example()
    car = read_car(written(tmp_path, toml))
    header = c_header(problem_of(BuildSettings(car=car)))
    turn, path, scale = car.tuning.turn, car.tuning.path, car.tuning.scale
    assert turn.pace_mps > 0.8  # 0.5 for the 1:43 car
    for line in (
        f"#define BR_TURN_PACE_MPS {turn.pace_mps!r}",
        f"#define BR_PATH_WINDOW_AHEAD_M {path.window_ahead_m!r}",
        f"{scale.speed_mps!r}, {scale.speed_mps!r}, {scale.yaw_rate_radps!r}",
    ):
        assert line in header


def test_settings_hold_the_whole_car(tmp_path: Path) -> None:
    toml, _ = example()
    settings = RaceSettings.model_validate({"car": written(tmp_path, toml)})
    (tmp_path / "car.toml").unlink()
    again = RaceSettings.model_validate_json(settings.model_dump_json())
    assert again.car == settings.car
    assert again.car.name == "tenth"
    assert RaceSettings().car == default_car()


def test_the_example_of_the_documentation_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cli: Cli
) -> None:
    toml, program = example()
    (tmp_path / "tenth.toml").write_text(toml)
    checked = cli("cars", "tenth.toml")
    assert checked.code == 0
    assert "tenth" in checked.out
    monkeypatch.chdir(tmp_path)
    values: dict[str, object] = {}
    exec(compile(program, str(EXTENDING), "exec"), values)  # noqa: S102
    made, states = values["line"], values["states"]
    assert isinstance(made, RaceLine)
    assert isinstance(states, np.ndarray)
    assert 8.0 < made.lap_time_s < 12.0
    assert float(str(values["deepest_m"])) < 0
    assert np.ptp(states[:, 0]) > 15.0  # around the track, not beside it
