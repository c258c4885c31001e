"""Plans of campaigns: what varies, what is refused, and the keys and rows of single cases."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from bayesrace.errors import InputError
from bayesrace.gp.weights import Weights, read_weights, write_weights
from bayesrace.learning.dataset import Dataset
from bayesrace.operation.preparation import updated_weights
from bayesrace.operation.race import race
from bayesrace.operation.settings import RaceSettings
from bayesrace.operation.terminal.terminal import stages_on
from bayesrace.studies.campaign.case import FAILED, Case, factors, run_case
from bayesrace.studies.campaign.plan import Campaign, read_plan
from bayesrace.vehicles import Car, write_car
from bayesrace.vehicles.parts import PacejkaTyres
from tests.programs import peanut

Read = Callable[[str], Campaign]


@pytest.fixture
def read(tmp_path: Path, weights: Weights) -> Read:
    """Reads a plan that stands beside a track and weights."""
    peanut(tmp_path / "peanut.csv")
    write_weights(tmp_path / "weights.bin", weights)

    def call(text: str) -> Campaign:
        (tmp_path / "plan.toml").write_text(text)
        return read_plan(tmp_path / "plan.toml")

    return call


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("grid = [", ("is no TOML", "docs/campaigns.md")),
        ("", ("names no races", "docs/campaigns.md")),
        ("controllers = ['worstcase']\n[grid]", ("names no races", "[grid]")),
        ("laps = 2", ("unknown setting 'laps'", "there are controllers")),
        ('controllers = ["me"]', ("controllers.0 = 'me'", "bestcase")),
        ('controllers = ["bayesrace-updated"]', ("learns from the laps of 'bayesrace'",)),
        ('controllers = ["bayesrace-limit"]', ("learns from the laps of 'bayesrace'",)),
        (
            'controllers = ["bayesrace", "bayesrace-updated-twice"]',
            ("learns from the laps of 'bayesrace-updated'; add that",),
        ),
        (
            'controllers = ["bayesrace", "bayesrace-limit"]\n[grid]\ncar = "f1tenth"',
            ("progress_drives is 0, as by default on linear tyres", "leave the controller out"),
        ),
        ("draws = 0\n[random]\npoints = [20]", ("draws = 0", "greater than or equal to 1")),
        ("draws = 9", ("draws = 9", "add [random]")),
        ("[grid]\npoint = 3", ("grid.point = 3 is no setting", "points")),
        ("[grid]\nmode = 'realtime'", ("grid.mode", "no setting that can vary")),
        ("[grid]\nsensors = ['exact', 'eyes']", ("grid.sensors", "unknown 'eyes'", "mocap")),
        ("[grid]\npoints = [400, 5]", ("grid.points = 5", "greater than or equal to 20")),
        ("[grid]\nmpc.margin_m = -1", ("grid.mpc.margin_m = -1", "track edges")),
        ("[grid]\nmpc.margin = 1", ("grid.mpc.margin = 1", "mpc.margin_m")),
        ("[grid]\nseed = []", ("grid.seed = []", "leave it out")),
        ("[grid]\ntrack = 'nowhere'", ("grid.track", "nowhere", "random:SEED")),
        ("[grid]\ncar = 'nothing'", ("grid.car", "nothing", "orca")),
        ("[grid]\nseed = 0\n[random]\nseed = [1]", ("seed is in [grid] and in [random]",)),
        ("[random]\ntrue_grip = { low = 0.8 }", ("random.true_grip", "high", "log = true")),
        ("[random]\ntrue_grip = { low = 2, high = 1 }", ("random.true_grip", "below high")),
        ("[random]\ntrue_grip = { low = 1.0, high = 9.0 }", ("random.true_grip = 9", "equal to 3")),
        ("[grid]\nseed = '0..9999'\npoints = '20..999'", ("9800000 cases", "[random]")),
        ("weights = 'none.bin'\ncontrollers = ['bayesrace']", ("the weights", "none.bin")),
        ("weights = 'peanut.csv'\ncontrollers = ['bayesrace']", ("weights = 'peanut.csv'",)),
        ("weights = 'weights.bin'", ("bayesrace-updated", "leave it or the weights out")),
        (
            "weights = 'weights.bin'\ncontrollers = ['bayesrace', 'bayesrace-limit']",
            ("bayesrace-limit", "leave it or the weights out"),
        ),
        (
            "weights = 'weights.bin'\ncontrollers = ['bayesrace']\n[grid]\nseed = '0..3'",
            ("seed shapes what is learned", "leave it or the weights out"),
        ),
    ],
)
def test_what_cannot_be_is_refused_with_field_value_and_remedy(
    read: Read, text: str, words: tuple[str, ...]
) -> None:
    with pytest.raises(InputError) as refusal:
        read(text)
    assert "plan.toml" in str(refusal.value)
    assert len(str(refusal.value).splitlines()) == 1
    for word in words:
        assert word in str(refusal.value)


def test_controllers_drive_in_the_order_in_which_they_learn(read: Read) -> None:
    plan = 'controllers = ["bestcase", "bayesrace-limit", "bayesrace"]\n[grid]\nseed = 0'
    (case,) = read(plan).cases.values()
    assert case.controllers == ("bayesrace", "bayesrace-limit", "bestcase")


def test_two_cars_of_one_name_are_refused(read: Read, car: Car, tmp_path: Path) -> None:
    write_car(tmp_path / "heavy.toml", car.model_copy(update={"mass_kg": 0.05}))
    with pytest.raises(InputError, match="two cars have the name 'orca'"):
        read("[grid]\ncar = ['orca', 'heavy.toml']")


def test_a_grid_is_every_combination(read: Read) -> None:
    text = """
        [grid]
        track = ["harbour", "random:1..2", "random10:3", "peanut.csv"]
        seed = "0..1"
        kernels = [["rbf"], ["rbf", "matern25"]]
        mpc.q_position = 2
    """
    settings = [case.settings for case in read(text).cases.values()]
    assert len(settings) == 5 * 2 * 2
    assert {one.seed for one in settings} == {one.pursuit.seed for one in settings} == {0, 1}
    assert {Path(one.track).name for one in settings} == {
        "harbour", "random:1", "random:2", "random10:3", "peanut.csv",
    }  # fmt: skip
    assert {one.kernels for one in settings} == {("rbf",), ("rbf", "matern25")}
    assert {one.mpc.q_position for one in settings} == {2.0}


def test_draws_stay_what_they_are_when_a_plan_grows(read: Read) -> None:
    random = "[random]\ntrue_grip = { low = 0.8, high = 1.2 }\nhorizon = { low = 10, high = 30 }\n"
    small = read("draws = 3\n[grid]\ntrack = 'harbour'\n" + random).cases
    text = "draws = 4\n[grid]\ntrack = ['harbour', 'paddock']\n" + random
    large = read(text).cases
    assert (len(small), len(large)) == (3, 8)
    assert small.keys() < large.keys()
    drawn = [case.settings for case in large.values()]
    assert len({one.true_grip for one in drawn}) == 8
    assert all(0.8 <= one.true_grip <= 1.2 for one in drawn)
    assert all(isinstance(one.horizon, int) and 10 <= one.horizon <= 30 for one in drawn)
    assert not small.keys() & read("random_seed = 1\n" + text).cases.keys()


def test_a_key_changes_with_all_that_shapes_a_row(
    read: Read, tmp_path: Path, weights: Weights
) -> None:
    def key(text: str) -> str:
        (found,) = read(text).cases
        return found

    given = "controllers = ['bayesrace']\nweights = 'weights.bin'\n[grid]\ntrack = 'peanut.csv'\n"
    first = key(given)
    others = [key(given + line) for line in ("laps = 3", "true_grip = 0.9", "mpc.r_duty = 0.1")]
    assert key(given + "true_grip = 1.0") == key(given) == first
    (tmp_path / "peanut.csv").write_text((tmp_path / "peanut.csv").read_text() + "# wider\n")
    others.append(key(given))
    write_weights(tmp_path / "weights.bin", replace(weights, version="other"))
    others.append(key(given))
    others.append(key(given.replace("['bayesrace']", "['worstcase', 'bayesrace']")))
    assert len({first, *others}) == len(others) + 1
    settings = RaceSettings(threads=3)
    assert Case(settings).key == Case(RaceSettings()).key


def test_every_factor_does_something(car: Car, tmp_path: Path) -> None:
    """What a plan may name reaches the car, the controllers or the training."""
    names = set(factors())
    assert names >= {"delay_s", "sensors"}
    assert names >= {"true_grip", "horizon", "points", "kernels", "raceline.friction", "seed"}
    settings = RaceSettings(true_grip=0.5)
    tyres, true = car.tyres, settings.true_car.tyres
    assert isinstance(tyres, PacejkaTyres)
    assert isinstance(true, PacejkaTyres)
    assert (true.front.d, true.rear.d) == (0.5 * tyres.front.d, 0.5 * tyres.rear.d)
    assert settings.true_car.friction == car.friction
    assert settings.driven_car == car
    with stages_on(Console(quiet=True)) as stages, pytest.raises(InputError, match="for campaigns"):
        race(settings, tmp_path / "run", stages)
    assert not (tmp_path / "run").exists()


def test_a_case_travels_as_plain_data_and_for_its_own_software_alone(
    read: Read, monkeypatch: pytest.MonkeyPatch
) -> None:
    campaign = read("controllers = ['worstcase']\n[grid]\ntrack = 'peanut.csv'")
    (case,) = campaign.cases.values()
    task = case.task()
    assert set(json.loads(task)) == {"settings", "controllers", "weights", "software"}
    there = Case.of_task(task, campaign.files)
    assert Path(there.settings.track).read_bytes() in campaign.files.values()
    assert there.settings.threads == 1
    monkeypatch.setattr("bayesrace.studies.campaign.case.software_identity", lambda: "another")
    with pytest.raises(RuntimeError, match="another version"):
        Case.of_task(task, campaign.files)


def test_a_case_has_a_row_for_each_lap_and_for_each_failure(read: Read) -> None:
    text = """
        controllers = ["bayesrace"]
        weights = "weights.bin"
        [grid]
        track = "peanut.csv"
        laps = 2
        mpc.caution = 0.0
    """
    rows = only(read(text))
    assert [row["lap"] for row in rows] == [1, 2]
    assert all(row["ended"] == "laps" and row["reason"] == "" for row in rows)
    assert 2 < rows[1]["lap_time_s"] < rows[0]["lap_time_s"] < 5
    assert rows[0]["samples"] + rows[1]["samples"] == pytest.approx(
        50 * (rows[0]["lap_time_s"] + rows[1]["lap_time_s"]), abs=2
    )
    (slow,) = only(read(text + "time_limit = 1.001\nmpc.q_position = 1e-9"))[-1:]
    assert slow["lap_time_s"] is None
    assert slow["reason"]
    (failed,) = only(read(text + "raceline.margin_m = 0.5"))
    assert failed["ended"] == FAILED
    assert "RaceLine" in failed["reason"] or "InputError" in failed["reason"]
    assert "margin" in failed["reason"]


def test_each_update_learns_from_all_laps_before_it(
    read: Read, monkeypatch: pytest.MonkeyPatch
) -> None:
    learned: list[tuple[list[int], str, str]] = []

    def recorded(
        samples: list[Dataset], settings: RaceSettings, first: Path
    ) -> tuple[Path, Dataset]:
        made = updated_weights(samples, settings, first)
        before, after = (read_weights(one).version for one in (first, made[0]))
        learned.append(([len(one) for one in samples], before, after))
        return made

    monkeypatch.setattr("bayesrace.operation.preparation.updated_weights", recorded)
    text = """
        controllers = ["bayesrace-updated-twice", "bayesrace-updated", "bayesrace"]
        [grid]
        track = "peanut.csv"
        train_track = "peanut.csv"
        collect_s = 8
        practice_laps = 0
        points = 100
        kernels = ["rbf"]
    """
    rows = only(read(text))
    versions = [row["weights"] for row in rows if row["lap"] == 1]
    (once, begun_with, first), (twice, *after) = learned
    assert len(twice) == len(once) == 2
    assert twice[0] == sum(once)
    assert [begun_with, first, after[1]] == versions
    assert after[0] == first


def test_a_campaign_varies_the_world(read: Read, tmp_path: Path) -> None:
    """By files beside the plan; BestCase does not know it, and is slower with a payload."""
    (tmp_path / "heavy.toml").write_text("[[world]]\nwhat = 'mass'\nshare = 1.5\n")
    text = """
        controllers = ["bestcase"]
        weights = "weights.bin"
        [grid]
        laps = 1
        track = "peanut.csv"
        world = ["none", "heavy.toml"]
    """
    campaign = read(text)
    rows = [run_case(one.task(), campaign.files)[0] for one in campaign.cases.values()]
    labels = [one.columns["world"] for one in campaign.cases.values()]
    assert labels[0] == ""
    assert labels[1].startswith("mass (")
    assert rows[1]["lap_time_s"] > 1.02 * rows[0]["lap_time_s"]
    with pytest.raises(InputError, match=r"grid\.world"):
        read(text.replace("heavy.toml", "missing.toml"))


def only(campaign: Campaign) -> list[dict[str, Any]]:
    """The rows of the one case."""
    (case,) = campaign.cases.values()
    return run_case(case.task(), campaign.files)
