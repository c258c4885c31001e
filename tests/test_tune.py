"""``bayesrace tune``: proposes within bounds, drives by the campaign's workers, judges, goes on."""

from pathlib import Path

import pytest

from bayesrace.vehicles import default_car, read_car, write_car
from tests.command_line import Cli, refused
from tests.programs import peanut, run

pytestmark = [pytest.mark.check, pytest.mark.unmeasured]


def test_a_study_finds_judges_writes_a_car_and_goes_on(tmp_path: Path) -> None:
    """On the shortest track, with a training drive of four seconds."""
    peanut(tmp_path / "peanut.csv")
    peanut(tmp_path / "other.csv")
    car = default_car()
    pursuit = car.tuning.pursuit.model_copy(update={"drive_s": 4.0})
    quick = car.model_copy(update={"tuning": car.tuning.model_copy(update={"pursuit": pursuit})})
    write_car(tmp_path / "quick.toml", quick)
    options = (
        "--car", tmp_path / "quick.toml", "--track", tmp_path / "peanut.csv",
        "--held-out", tmp_path / "other.csv", "--out", tmp_path / "tuned.toml",
        "--batch", "2", "--workers", "1",
    )  # fmt: skip
    done = run("tune", *options, "--trials", "1")
    assert done.returncode == 0, done.stderr
    assert read_car(tmp_path / "tuned.toml") == quick  # the first trial is the defaults
    assert "held-out tracks: +0.00 % faster" in done.stdout
    assert "the defaults win" in done.stdout
    done = run("tune", *options, "--trials", "3")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "tuned.sqlite").exists()
    tuned = read_car(tmp_path / "tuned.toml")
    assert tuned.identity == quick.identity  # weights fit both
    objective = tuned.tuning.objective
    assert objective.q_position == car.tuning.objective.q_position
    assert 0.8 * car.friction <= tuned.friction <= 1.2 * car.friction
    for name in ("r_duty", "margin_m", "horizon", "friction"):
        assert name in done.stdout
    assert "other" in done.stdout
    assert "held-out tracks: " in done.stdout


def test_a_track_cannot_tune_and_judge(cli: Cli) -> None:
    refused(cli("tune", "--track", "random:1..3", "--held-out", "random:3"), "random:3")
