"""What is prepared once is not prepared again, and is said to come from the cache."""

import io
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from bayesrace.errors import InputError
from bayesrace.gp.weights import Weights, read_weights
from bayesrace.learning.dataset import Dataset, concatenate
from bayesrace.manifest import LIBRARY
from bayesrace.operation.closed_loop import Watch
from bayesrace.operation.preparation import Prepared, prepare
from bayesrace.operation.settings import PreparationSettings
from bayesrace.operation.terminal.terminal import stages_on
from bayesrace.plant.car import End
from bayesrace.raceline import RaceLineSettings
from bayesrace.tracks import Track
from tests.car_fmu import packed_car
from tests.conftest import offset_line

SETTINGS = PreparationSettings(train_track="random:2", collect_s=2.0, practice_laps=0)

Preparing = Callable[..., tuple[Prepared, list[str]]]


@pytest.fixture
def preparing(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    weights: Weights,
    kinematic_artefact: Path,
) -> Preparing:
    """Prepares in an empty cache, with these changes; what the console shows. A line and weights
    that take no time take the place of those computed; the controller is built already."""
    monkeypatch.setenv("BAYESRACE_CACHE", str(tmp_path / "cache"))
    shutil.copytree(kinematic_artefact, tmp_path / "cache" / kinematic_artefact.name)

    def compute(track: Track, *_: object) -> object:
        return offset_line(track, 0.01, 5.0, 2.5)

    monkeypatch.setattr("bayesrace.raceline.compute_raceline", compute)
    monkeypatch.setattr("bayesrace.learning.training.train", lambda *_: weights)

    def run(**changes: object) -> tuple[Prepared, list[str]]:
        console = Console(file=io.StringIO(), width=200)
        with stages_on(console) as stages:
            prepared = prepare(SETTINGS.model_copy(update=changes), ("random:1",), stages)
        assert isinstance(console.file, io.StringIO)
        lines = console.file.getvalue().splitlines()
        cached_stages = [line.split(":")[0] for line in lines if line.endswith(": from the cache")]
        return prepared, cached_stages

    return run


STAGES = [
    "racing line, random",
    "build the controllers",
    "training line, random",
    "training drive (pure pursuit)",
    "train the residual",
]


def test_a_second_preparation_computes_nothing_and_says_so(
    preparing: Preparing, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, stages = preparing()
    assert stages == ["build the controllers"]

    def never(*_: object) -> None:
        raise AssertionError("computed again")

    for name in (
        "bayesrace.raceline.compute_raceline", "bayesrace.operation.training_drives.collect",
        "bayesrace.learning.training.train",
    ):  # fmt: skip
        monkeypatch.setattr(name, never)
    again, stages = preparing()
    assert stages == STAGES
    assert again.arguments == first.arguments
    assert again.artefacts == first.artefacts
    assert first.training is not None
    assert again.training is not None
    assert again.training.log == first.training.log
    assert again.training.samples.digest() == first.training.samples.digest()
    assert len(again.training.samples) > 80


def test_a_cache_that_others_may_write_is_refused_before_all_else(
    preparing: Preparing, tmp_path: Path
) -> None:
    (tmp_path / "cache").chmod(0o777)
    with pytest.raises(InputError, match=r"cache is writable for other users.*chmod go-w"):
        preparing()
    assert len([*(tmp_path / "cache").iterdir()]) == 1  # the controller that was there


def test_a_controller_that_others_may_write_is_refused_before_all_else(
    kinematic_artefact: Path, tmp_path: Path
) -> None:
    artefact = tmp_path / "artefact"
    shutil.copytree(kinematic_artefact, artefact)
    (artefact / LIBRARY).chmod(0o666)
    with pytest.raises(InputError, match=f"{LIBRARY} is writable for other users"):
        prepare(SETTINGS, ("nowhere",), None, artefact=artefact)  # type: ignore[arg-type]


def test_the_training_drive_is_kept_for_all_that_shapes_it(preparing: Preparing) -> None:
    logs = set()
    for changes in (
        {},
        {"seed": 1},
        {"true_grip": 0.9},
        {"collect_s": 2.5},
        {"start_speed_mps": 0.2},
        {"train_track": "random:3"},
        {"car": SETTINGS.car.model_copy(update={"mass_kg": 0.05})},
        {"fmu": packed_car()},
    ):
        prepared, _ = preparing(**changes)
        assert prepared.training is not None
        logs.add(prepared.training.log)
    assert len(logs) == 8


def test_the_controller_learns_from_its_own_laps_of_the_training_track(
    preparing: Preparing, weights: Weights, monkeypatch: pytest.MonkeyPatch
) -> None:
    learned: list[tuple[Dataset, Weights | None]] = []

    def train(samples: Dataset, *more: Any) -> Weights:
        learned.append((samples, more[2]))
        return replace(weights, version=f"round {len(learned)}")

    monkeypatch.setattr("bayesrace.learning.training.train", train)
    prepared, _ = preparing(practice_laps=1)
    training, (practice,) = prepared.training, prepared.practices
    assert training is not None
    (driven, none), (samples, begun_with) = learned
    assert none is None
    assert begun_with is not None
    assert begun_with.version == "round 1"
    assert driven.digest() == training.samples.digest()
    assert samples.digest() == concatenate([driven, practice.samples]).digest()
    assert len(practice.samples) > 50
    assert read_weights(prepared.weights).version == "round 2"
    again, stages = preparing(practice_laps=1)
    assert "practice, random" in stages
    assert again.weights == prepared.weights
    assert len(learned) == 2
    without, _ = preparing(practice_laps=0)
    assert not without.practices
    assert without.training is not None
    assert without.training.log == training.log


def test_practice_is_kept_for_all_that_shapes_it(
    preparing: Preparing, weights: Weights, monkeypatch: pytest.MonkeyPatch
) -> None:
    logs = set()

    def practise(**changes: object) -> None:
        prepared, _ = preparing(**{"practice_laps": 1} | changes)
        logs.add(prepared.practices[0].log)

    for changes in ({}, {"practice_laps": 2}, {"start_speed_mps": 0.2}):
        practise(**changes)
    others = replace(weights, version="others")
    monkeypatch.setattr("bayesrace.learning.training.train", lambda *_: others)
    practise(collect_s=2.5)
    assert len(logs) == 4


def test_practice_that_says_nothing_is_left_out(
    preparing: Preparing, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def at_once(*_: object) -> Watch:
        return lambda _: End("stopped", "spins")

    monkeypatch.setattr("bayesrace.operation.collect._until_it_fails", at_once)
    prepared, _ = preparing(practice_laps=1)
    assert not prepared.practices
    assert prepared.training is not None
    assert prepared.samples == [prepared.training.samples]
    assert "the practice on random:2 is left out: no two states follow one another" in caplog.text


def test_a_track_without_the_room_is_trained_on_with_less(
    preparing: Preparing, monkeypatch: pytest.MonkeyPatch
) -> None:
    margins: list[float | None] = []

    def compute(track: Track, _: object, settings: RaceLineSettings) -> object:
        margins.append(settings.margin_m)
        if (settings.margin_m or 0.0) > 0.09:
            raise InputError("too narrow")
        return offset_line(track, 0.01, 5.0, 2.5)

    monkeypatch.setattr("bayesrace.raceline.compute_raceline", compute)
    prepared, _ = preparing()
    assert prepared.training is not None
    asked = [margin for margin in margins if margin is not None]
    assert len(asked) > 1
    assert asked[-1] <= 0.09 < asked[0]


def test_a_damaged_training_drive_is_driven_again(preparing: Preparing) -> None:
    prepared, _ = preparing()
    assert prepared.training is not None
    log = prepared.training.log
    whole = log.read_bytes()
    log.write_bytes(whole[: len(whole) // 2])
    again, stages = preparing()
    assert "training drive (pure pursuit)" not in stages
    assert again.training is not None
    assert again.training.samples.digest() == prepared.training.samples.digest()
