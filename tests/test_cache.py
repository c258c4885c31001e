"""The cache of results that take seconds to compute: made once, never read damaged or half."""

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from bayesrace.cache import digest, kept
from bayesrace.errors import InputError
from bayesrace.gp.weights import Weights, read_weights, write_weights
from bayesrace.integrators import PREDICTION
from bayesrace.learning.settings import TrainingSettings
from bayesrace.operation import preparation
from bayesrace.raceline import RaceLine, RaceLineSettings, racing_line
from bayesrace.tracks import load_track
from bayesrace.vehicles import Car
from bayesrace.vehicles.models import dynamic
from tests.conftest import mirrored_weights, offset_line
from tests.driven import CAR, drive


def read(path: Path) -> str:
    """What these tests take for a usable file."""
    try:
        text = path.read_text()
    except OSError as error:
        raise InputError(str(error)) from error
    if not text.startswith("good"):
        raise InputError("damaged")
    return text


def test_a_result_is_made_once_and_again_if_it_is_damaged(tmp_path: Path) -> None:
    made = []

    def make(path: Path) -> None:
        made.append(1)
        path.write_text(f"good {len(made)}")

    path = tmp_path / "folder" / "result"
    path.parent.mkdir()
    assert [kept(path, make, read) for _ in range(2)] == ["good 1"] * 2
    path.write_text("spoilt")
    assert kept(path, make, read) == "good 2"


def test_of_several_that_need_it_at_once_one_makes_it(tmp_path: Path) -> None:
    started, made = threading.Barrier(4), []

    def make(path: Path) -> None:
        made.append(1)
        path.write_text("good")

    def need(_: int) -> str:
        started.wait(10)
        return kept(tmp_path / "result", make, read)

    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(need, range(4))) == ["good"] * 4
    assert made == [1]


def test_what_fails_leaves_nothing(tmp_path: Path) -> None:
    def make(path: Path) -> None:
        path.write_text("good, if it were whole")
        raise RuntimeError("no convergence")

    with pytest.raises(RuntimeError, match="no convergence"):
        kept(tmp_path / "result", make, read)
    assert [path.name for path in tmp_path.iterdir()] == [".locks"]


def test_parts_do_not_run_into_each_other() -> None:
    assert digest(["ab", "c"]) != digest(["a", "bc"])


def test_a_racing_line_is_kept_for_its_track_car_and_settings(
    tmp_path: Path, car: Car, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To the bit, as lockstep runs are compared to the bit."""
    monkeypatch.setenv("BAYESRACE_CACHE", str(tmp_path))
    track, computed = load_track("paddock", car.width_m), []

    def compute(*arguments: object) -> RaceLine:
        computed.append(arguments)
        return offset_line(track, 0.01 * len(computed), 5.0, 2.5)

    monkeypatch.setattr("bayesrace.raceline.compute_raceline", compute)
    first, again = (racing_line(track, car) for _ in range(2))
    expected = offset_line(track, 0.01, 5.0, 2.5)
    for line in (first, again):
        assert line.track_name == "paddock"
        for name in ("s_m", "x_m", "y_m", "psi_rad", "kappa_radpm", "vx_mps", "ax_mps2"):
            assert (getattr(line, name) == getattr(expected, name)).all()
    racing_line(track, car, RaceLineSettings(margin_m=0.01))
    racing_line(load_track("random:1", car.width_m), car)
    racing_line(track, car.model_copy(update={"mass_kg": 0.05}))
    with monkeypatch.context() as patch:
        patch.setattr("bayesrace.cache.version", lambda _: "9.9")
        racing_line(track, car)
    assert len(computed) == 5


def test_weights_are_kept_for_their_samples_settings_and_beginning(
    tmp_path: Path, weights: Weights, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("BAYESRACE_CACHE", str(tmp_path))
    trained: list[object] = []

    def train(*arguments: object) -> Weights:
        trained.append(arguments)
        return replace(weights, version=f"{len(trained)}")

    monkeypatch.setattr("bayesrace.learning.training.train", train)
    samples, settings = drive(dynamic(CAR), 30, seed=1), TrainingSettings()
    one_sided = CAR.model_copy(update={"mirrored_samples": False})

    def version(*changes: object) -> str:
        arguments: list[Any] = [samples, PREDICTION, settings, None]
        for position, change in zip(changes[::2], changes[1::2], strict=True):
            assert isinstance(position, int)
            if isinstance(change, Weights):
                write_weights(tmp_path / "first.bin", change)
                change = tmp_path / "first.bin"
            arguments[position] = change
        return read_weights(preparation.trained_weights(*arguments)).version

    assert version() == version() == "1"
    others = [
        version(0, drive(dynamic(CAR), 30, seed=2)),
        version(1, PREDICTION.model_copy(update={"substeps": 2})),
        version(2, TrainingSettings(seed=1)),
        version(3, weights),
        version(3, replace(weights, outputs=mirrored_weights(weights).outputs)),
        version(0, replace(samples, car=one_sided)),
    ]
    assert others == ["2", "3", "4", "5", "6", "7"]
    assert version(3, replace(weights, created_utc_ns=7)) == "5"
    assert version() == "1"


def test_a_cache_that_cannot_be_written_is_named_with_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"file.* cannot be made .*BAYESRACE_CACHE"):
        kept(tmp_path / "file" / "result", lambda _: None, read)
